"""Files that say who draws them, end to end: each extension, each format, each command that reads them."""

import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from compact import refused_line
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs.model_file import choose_owner, find_label, read_model
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.extensions.extension import CORE, Extension, load_extension
from minisplat_ref.io.images import read_image
from minisplat_ref.io.label import NO_LABEL, Label
from minisplat_ref.io.ply import load_ply, read_label, save_ply
from run_commands import write_room

SCENE = {"n_views": 4, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
DRAWN = ("rays", "analytic", "antialiasing", "vr", "pixel-order", "fans")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    write_room(folder / "nook", **SCENE)
    return folder / "nook"


def train(scene, name, *options):
    folder = scene.parent / name
    given = ["--iterations", "3", "--test-every", "4", "--out", str(folder), *options]
    assert main(["train", str(scene), *given]) == 0
    return folder


@pytest.fixture(scope="module")
def run_of(scene):
    """Train each recipe once."""
    runs = {}

    def find(name):
        if name not in runs:
            runs[name] = train(scene, name, "--recipe", name)
        return runs[name]

    return find


@pytest.fixture(scope="module")
def skies(scene):
    """A run with all that no file holds, drawn by an extension."""
    return train(scene, "skies", "--recipe", "rays", "--set", "sky=true", "--set", "antialiasing=true")


def images(path, out, *options):
    """Render; return the bytes of each image."""
    assert main(["render", str(path), "--out", str(out), *map(str, options)]) == 0
    return {file.name: file.read_bytes() for file in sorted(out.glob("*.png"))}


def convert(*arguments):
    assert main(["convert", *map(str, arguments)]) == 0


@pytest.mark.parametrize("name", DRAWN)
def test_a_ply_is_drawn_like_its_run(name, run_of, tmp_path, capfd):
    run = run_of(name)
    expected = images(run, tmp_path / "run", "--cameras", "all")
    capfd.readouterr()
    assert images(run / "point_cloud.ply", tmp_path / "ply", "--cameras", run / "cameras.json") == expected
    assert "warning" not in capfd.readouterr().err
    assert len(expected) == len(json.loads((run / "cameras.json").read_text())) >= SCENE["n_views"]
    assert main(["info", str(run / "point_cloud.ply")]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert ["drawn", "by", "extension", name] in [line.split() for line in lines]
    convert(run / "point_cloud.ply", tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()
    if name != "fans":  # of which 3DGS knows nothing
        plain = images(
            run / "point_cloud.ply", tmp_path / "3dgs", "--cameras", run / "cameras.json", "--extension", "core"
        )
        assert plain != expected


def test_fans_are_described(run_of, capfd):
    run = run_of("fans")
    capfd.readouterr()
    assert main(["info", str(run / "point_cloud.ply")]) == 0
    rows = dict(line.split(maxsplit=1) for line in capfd.readouterr().out.splitlines())
    assert rows["primitives"] == "60" and "rims [60, 1, 8, 3]" in rows["further"]


def test_what_3dgs_draws_says_nothing(scene):
    run = train(scene, "plain", "--recipe", "3dgs-accel")
    gaussians = load_ply(run / "point_cloud.ply")
    save_ply(run.parent / "same.ply", gaussians)
    assert (run / "point_cloud.ply").read_bytes() == (run.parent / "same.ply").read_bytes()
    for name in ("micro", "geometry", "omg", "compression"):  # they train, and 3DGS draws
        assert load_extension(name).label == NO_LABEL
    assert CORE.label == NO_LABEL and load_extension("multi-scale").label == Label("multi-scale")


@pytest.mark.parametrize(
    ("name", "given", "recorded"),
    [("pixel-order", "buffer_size= 1", "buffer_size=1"), ("fans", "max_layers=1", "max_layers=1")],
)
def test_a_setting_of_the_renderer_is_recorded(name, given, recorded, scene, tmp_path, capfd):
    """But not one of the training."""
    run = train(scene, f"{name}-1", "--recipe", name, "--set", given, "--set", "pose=false")
    ply, camera = run / "point_cloud.ply", ["--cameras", run / "cameras.json"]
    assert read_label(ply) == Label(name, (), (recorded,))
    expected = images(run, tmp_path / "run", "--cameras", "all")
    assert images(ply, tmp_path / "ply", *camera) == expected
    assert images(ply, tmp_path / "given", *camera, "--extension", name) == expected
    convert(ply, tmp_path / "again.ply")
    convert(run, tmp_path / "run.ply")
    assert (tmp_path / "again.ply").read_bytes() == ply.read_bytes() == (tmp_path / "run.ply").read_bytes()
    other = tmp_path / "other.ply"
    other.write_bytes(ply.read_bytes().replace(f"comment minisplat_ref set {recorded}\n".encode(), b""))
    assert images(other, tmp_path / "other", *camera) != expected
    capfd.readouterr()
    assert main(["info", str(ply)]) == 0
    assert f"{name}, with {recorded}\n" in capfd.readouterr().out
    for setting, named in (("size=1", "has no size to set"), (f"{recorded[:-1]}x", "is not a number")):
        other.write_bytes(ply.read_bytes().replace(recorded.encode(), setting.encode()))
        line = refused_line(capfd, tmp_path, "render", other, "--out", tmp_path / "views")
        assert f"{other} was made for another version of extension {name}: " in line and named in line


@pytest.mark.parametrize("suffix", [".msz", ".omg", ".spz"])
def test_compact_files_say_it_too(suffix, run_of, tmp_path, capfd):
    run, file = run_of("rays"), tmp_path / f"a{suffix}"
    convert(run, file, "--level", 0)
    assert find_label(file) == Label("rays") and (tmp_path / "a.spz.json").exists() == (suffix == ".spz")
    camera = ["--cameras", run / "cameras.json"]
    drawn = images(file, tmp_path / "drawn", *camera)
    if suffix == ".msz":  # whose level 0 loses nothing
        assert drawn == images(run, tmp_path / "run", "--cameras", "all")
    assert drawn != images(file, tmp_path / "plain", *camera, "--extension", "core")
    convert(file, tmp_path / "back.ply")
    assert read_label(tmp_path / "back.ply") == Label("rays")
    assert images(tmp_path / "back.ply", tmp_path / "back", *camera) == drawn
    convert(tmp_path / "back.ply", tmp_path / f"again{suffix}", "--level", 0)
    assert find_label(tmp_path / f"again{suffix}") == Label("rays")
    capfd.readouterr()
    assert main(["info", str(file)]) == 0
    out = capfd.readouterr().out
    assert "drawn by extension" in out and " rays\n" in out


def test_a_size_includes_the_label(run_of, tmp_path):
    run = run_of("rays")
    convert(run, tmp_path / "a.msz", "--level", 3)
    size = (tmp_path / "a.msz").stat().st_size
    convert(run, tmp_path / "b.msz", "--max-bytes", size)
    assert (tmp_path / "b.msz").read_bytes() == (tmp_path / "a.msz").read_bytes()
    convert(run, tmp_path / "c.msz", "--max-bytes", size - 1)
    assert (tmp_path / "c.msz").stat().st_size < size - 20  # another level


def test_what_a_file_lacks_of_its_run(skies, tmp_path, capfd):
    """The header says it; on reading the file alone one line does, and a copy says it again."""
    ply, label = skies / "point_cloud.ply", Label("rays", ("sky", "compensation"))
    assert read_label(ply) == label
    convert(skies, tmp_path / "run.msz")
    convert(ply, tmp_path / "ply.spz")
    assert find_label(tmp_path / "run.msz") == label == find_label(tmp_path / "ply.spz")
    for file in (ply, tmp_path / "run.msz", tmp_path / "ply.spz"):
        capfd.readouterr()
        images(file, tmp_path / f"{file.stem}-views", "--cameras", skies / "cameras.json")
        lines = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
        assert (
            len(lines) == 1 and f"{file} does not hold the sky and the compensation of opacities of its run" in lines[0]
        )
        assert main(["info", str(file)]) == 0
        assert "the sky and the compensation of opacities of its run" in capfd.readouterr().out
    images(skies, tmp_path / "run")
    assert main(["eval", str(skies), "--model", str(ply), "--out", str(tmp_path / "eval")]) == 0
    assert "does not hold" not in capfd.readouterr().err  # with the run it has all
    measured = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert measured["psnr"] == json.loads((skies / "metrics.json").read_text())["psnr"]


def test_the_user_s_word_counts(run_of, tmp_path, capfd):
    run = run_of("rays")
    ply, camera = run / "point_cloud.ply", ["--cameras", run / "cameras.json"]
    unlabelled = tmp_path / "plain.ply"
    save_ply(unlabelled, load_ply(ply))
    for name in ("analytic", "core"):
        expected = images(unlabelled, tmp_path / f"{name}-1", *camera, "--extension", name)
        capfd.readouterr()
        assert images(ply, tmp_path / f"{name}-2", *camera, "--extension", name) == expected
        warnings = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
        assert len(warnings) == 1
        assert f"says that extension rays draws it: --extension {name} draws it otherwise" in warnings[0]
    images(ply, tmp_path / "same", *camera, "--extension", "rays")
    assert "warning" not in capfd.readouterr().err
    convert(ply, tmp_path / "a.ply", "--extension", "core")
    assert (tmp_path / "a.ply").read_bytes() == unlabelled.read_bytes()
    convert(ply, tmp_path / "a.msz", "--extension", "analytic")
    assert find_label(tmp_path / "a.msz") == Label("analytic")
    capfd.readouterr()
    assert main(["eval", str(run), "--model", str(tmp_path / "a.msz"), "--out", str(tmp_path / "eval")]) == 0
    assert f"says that extension analytic draws it: run {run} draws it otherwise" in capfd.readouterr().err


def test_an_extension_that_is_not_there(tmp_path, capfd, run_of):
    file = tmp_path / "strange.ply"
    save_ply(file, load_ply(run_of("rays") / "point_cloud.ply"), Label("strange"))
    for command in (["render", file, "--out", tmp_path / "views"], ["convert", file, tmp_path / "a.msz"]):
        line = refused_line(capfd, tmp_path, *command)
        assert f"{file} is drawn by extension strange, which is not installed" in line and "--extension core" in line
    assert main(["render", str(file), "--out", str(tmp_path / "views"), "--frames", "1", "--extension", "core"]) == 0
    capfd.readouterr()
    assert main(["info", str(file)]) == 0
    captured = capfd.readouterr()
    assert captured.err.count("\n") == 1 and "which is not installed" in captured.err
    assert "strange" in captured.out and "Gaussians" in captured.out


def test_damaged_labels_are_refused_in_one_line(run_of, tmp_path, capfd):
    run = run_of("rays")
    convert(run, tmp_path / "a.spz")
    (tmp_path / "a.spz.json").write_text("{")
    ply = tmp_path / "a.ply"
    ply.write_bytes((run / "point_cloud.ply").read_bytes().replace(b"extension rays", b"extension r/ys"))
    for file, named in ((tmp_path / "a.spz", "a.spz.json: not valid JSON"), (ply, "a.ply: damaged, ")):
        for command in (
            ["render", file, "--out", tmp_path / "views"],
            ["info", file],
            ["convert", file, tmp_path / "b.ply"],
            ["eval", run, "--model", file, "--out", tmp_path / "eval"],
        ):
            assert named in refused_line(capfd, tmp_path, *command)


def test_an_edit_keeps_who_draws_it(run_of, skies, tmp_path):
    """But not where it leaves out what that needs."""
    edit = ["--scale", "2", "--about", "0", "0", "0"]
    for run, expected in (
        (run_of("rays"), Label("rays")),
        (skies, Label("rays", ("sky", "compensation"))),
        (run_of("antialiasing"), NO_LABEL),
    ):
        assert main(["proxies", "edit", str(run), str(tmp_path / "edited.ply"), *edit]) == 0
        assert read_label(tmp_path / "edited.ply") == expected


def test_commands_that_draw_themselves_say_so(run_of, tmp_path, capfd):
    (tmp_path / "lights.json").write_text('{"lights": [[0, 0, -2]]}')
    trace = ["--scene", tmp_path / "lights.json", "--cameras", run_of("rays") / "cameras.json"]
    gaze = ["--gaze", "10,10"]
    for name, other, command, options in (
        ("rays", "analytic", "rays render", trace),
        ("vr", "analytic", "vr render", gaze),
        ("vr", "antialiasing", "vr render", gaze),
    ):
        for drawn_by in (name, other):
            ply, out = run_of(drawn_by) / "point_cloud.ply", tmp_path / f"{command}-{drawn_by}"
            capfd.readouterr()
            assert main([*command.split(), str(ply), *map(str, options), "--out", str(out)]) == 0
            warnings = [line for line in capfd.readouterr().err.splitlines() if "warning" in line]
            says = f"says that extension {other} draws it: {command} draws it otherwise"
            assert len(warnings) == (drawn_by == other) and all(says in line for line in warnings)
            shutil.rmtree(out)


def test_a_choice_by_hand(tmp_path, recwarn):
    rays, path = load_extension("rays"), tmp_path / "a.ply"
    assert choose_owner(path, NO_LABEL, None, "") is CORE
    assert choose_owner(path, Label("rays"), None, "") is rays
    assert choose_owner(path, NO_LABEL, rays, "") is rays and choose_owner(path, Label("rays"), rays, "") is rays
    assert not recwarn
    with pytest.warns(InputWarning, match="extension rays draws it: word draws it otherwise"):
        assert choose_owner(path, Label("rays"), CORE, "word") is CORE


def test_an_unlabelled_file_of_further_fields_says_what_is_left_out(run_of, tmp_path):
    """As earlier versions wrote it; with the extension once given, a copy is labelled."""
    from minisplat_ref.extensions.antialiasing.model import FilteredGaussians

    ours = run_of("antialiasing") / "point_cloud.ply"
    old = tmp_path / "old.ply"
    save_ply(old, load_ply(ours, FilteredGaussians))
    with pytest.warns(InputWarning, match=r"not drawn are filter_sigmas \(unknown here\)"):
        assert read_model(old).owner is CORE
    convert(old, tmp_path / "new.ply", "--extension", "antialiasing")
    assert (tmp_path / "new.ply").read_bytes() == ours.read_bytes()
    read = read_model(tmp_path / "new.ply")
    assert_array_equal(read.population.filter_sigmas, load_ply(old, FilteredGaussians).filter_sigmas)


def test_an_extension_whose_save_knows_no_label(tmp_path, monkeypatch):
    """It is refused before a training, not after it."""
    folder = tmp_path / "old_one"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "from minisplat_ref.extensions.extension import Extension\n"
        "def save(path, population): pass\n"
        'EXTENSION = Extension("old-one", save=save)\n'
    )
    monkeypatch.setattr("minisplat_ref.extensions.__path__", [str(tmp_path)])
    with pytest.raises(InputError, match=r"old-one in .*: save does not take a path, a population and a label"):
        load_extension("old-one")
    assert Extension("a").save is save_ply


# Fused filters


def test_fuse(run_of, tmp_path, capfd):
    """Six fields for any viewer, with s' = sqrt(s^2 + f^2) and o' = o prod s / s' worked out here."""
    from minisplat_ref.extensions.antialiasing.model import FilteredGaussians

    run, out = run_of("antialiasing"), tmp_path / "fused.ply"
    assert main(["antialiasing", "fuse", str(run), str(out)]) == 0
    before, after = load_ply(run / "point_cloud.ply", FilteredGaussians), load_ply(out)
    scales, f = np.exp(before.log_scales.astype(float)), before.filter_sigmas.astype(float)[:, None]
    larger = np.sqrt(scales**2 + f**2)
    opacities = np.prod(scales / larger, axis=1) / (1 + np.exp(-before.opacity_logits.astype(float)))
    assert (f > 0).all()
    np.testing.assert_allclose(np.exp(after.log_scales.astype(float)), larger, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-after.opacity_logits.astype(float))), opacities, rtol=1e-5)
    for name in ("means", "quats", "sh_dc", "sh_rest"):
        assert_array_equal(getattr(after, name), getattr(before, name))
    assert read_label(out) == NO_LABEL and "60 Gaussians in" in capfd.readouterr().out
    again = tmp_path / "again.ply"
    assert main(["antialiasing", "fuse", str(run / "point_cloud.ply"), str(again)]) == 0
    assert again.read_bytes() == out.read_bytes()


def test_fused_gaussians_are_nearer_to_the_rendering_of_the_extension(run_of, tmp_path):
    """Than those without filters, where filters are large: seen from 3 times as near, they are 3 times as large."""
    run = run_of("antialiasing")
    assert main(["antialiasing", "fuse", str(run), str(tmp_path / "fused.ply")]) == 0
    cameras = json.loads((run / "cameras.json").read_text())[:1]
    for camera in cameras:
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            camera[name] *= 3
    (tmp_path / "near.json").write_text(json.dumps(cameras))
    near = ["--cameras", tmp_path / "near.json"]
    ply = run / "point_cloud.ply"
    for path, name, options in (
        (ply, "own", []),
        (ply, "left-out", ["--extension", "core"]),
        (tmp_path / "fused.ply", "fused", []),
    ):
        images(path, tmp_path / name, *near, *options)
    name = next((tmp_path / "own").glob("*.png")).name
    own, left_out, fused = (
        read_image(tmp_path / folder / name).astype(float) for folder in ("own", "left-out", "fused")
    )
    assert np.mean((fused - own) ** 2) < 0.5 * np.mean((left_out - own) ** 2)


def test_what_fuse_refuses(run_of, tmp_path, capfd):
    run, rays = run_of("antialiasing"), run_of("rays")
    line = refused_line(capfd, tmp_path, "antialiasing", "fuse", rays, tmp_path / "a.ply")
    assert f"{rays / 'point_cloud.ply'} has no filters: give a run of recipe antialiasing" in line
    line = refused_line(capfd, tmp_path, "antialiasing", "fuse", run, tmp_path / "a.spz")
    assert "a.spz is not named like a PLY" in line
    ply = run / "point_cloud.ply"
    assert "would lose its filters" in refused_line(capfd, tmp_path, "antialiasing", "fuse", run, ply)
    assert "cannot be opened" in refused_line(capfd, tmp_path, "antialiasing", "fuse", tmp_path, tmp_path / "a.ply")
