"""Golden vectors: scenes that test something, gradients that are those of the renderer, a folder that is checked."""

import hashlib
import json
import shutil

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.constants import Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden import files
from minisplat_ref.oracle.golden.files import MANIFEST, README, export, load
from minisplat_ref.oracle.golden.format import SPECS, STAGE_COTANGENTS, STAGE_INPUTS, convention_words
from minisplat_ref.oracle.golden.running import projection_of, reference_bins
from minisplat_ref.oracle.golden.scenes import RECIPES, golden_scenes, inputs, truth
from minisplat_ref.oracle.thresholds import thresholds
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.pinhole import slope_limits
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Gaussians
from tolerances import COVERAGE_MIN, GRADIENT_FLOOR, PARITY_FLOAT64

NAMES = [recipe.name for recipe in RECIPES]
FOLDER_SIZE_MAX = 5_000_000  # bytes


@pytest.fixture(scope="module")
def scenes():
    return golden_scenes()


@pytest.fixture(scope="module")
def exported(scenes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("oracle") / "golden"
    export(folder, scenes)
    return folder


@pytest.fixture
def copy(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "copy")


@pytest.mark.parametrize("name", NAMES)
def test_no_scene_is_vacuous(scenes, name):
    scene = scenes[name]
    a, shown = scene.arrays, scene.arrays["radii"][:, 0] > 0
    assert set(a) == set(SPECS)
    assert shown.sum() > (10 if scene.is_exact else 50) and (a["alpha"] > 0.05).mean() > COVERAGE_MIN
    assert scene.is_exact or (a["colors"][shown] == 0).any(), "no colour is clamped at zero"
    for spec in SPECS.values():
        assert np.isfinite(a[spec.name]).all(), spec.name
        if spec.role == "gradient":
            assert np.abs(a[spec.name]).max() > GRADIENT_FLOOR, f"{spec.name} is zero"


def hits_of(scene):
    return list(
        tile_hits(
            projection_of(scene.arrays), reference_bins(scene.arrays, scene.conventions, (16, 16)), scene.conventions
        )
    )


@pytest.mark.parametrize("name", ["ordinary", "inria", "off-centre", "sh3", "odd-size"])
def test_alpha_is_clamped_somewhere(scenes, name):
    assert any((tile.is_clamped & (tile.alphas > 0)).any() for tile in hits_of(scenes[name]))


@pytest.mark.parametrize("name", ["ordinary", "off-centre", "sh3", "odd-size"])
def test_pixels_are_finished_somewhere(scenes, name):
    scene = scenes[name]
    endless = scene._replace(conventions=scene.conventions._replace(transmittance_min=0.0))
    n_hits = [sum(int((tile.alphas > 0).sum()) for tile in hits_of(s)) for s in (scene, endless)]
    assert n_hits[0] < n_hits[1]


def test_what_each_scene_is_for(scenes):
    odd = scenes["odd-size"]
    means_cam = odd.arrays["means"] @ odd.camera.cam_from_world_R.T + odd.camera.cam_from_world_t
    slopes = means_cam[:, :2] / means_cam[:, 2:]
    low, high = slope_limits(odd.camera, odd.conventions, np.dtype(float))
    shown = odd.arrays["radii"][:, 0] > 0
    assert ((slopes < low) | (slopes > high)).any(axis=1)[shown].sum() >= 5 and not shown.all()
    assert all(size % 16 for size in odd.arrays["image_size"])
    thin = scenes["antialiased"].arrays
    ratios = (thin["opacities2d"] / thin["opacities"])[thin["radii"][:, 0] > 0]
    assert ratios.min() < 0.2 and ratios.max() > 0.8
    assert scenes["sh3"].sh_degree == 3
    assert abs(scenes["off-centre"].camera.cx / 48 - 0.5) > 0.3
    assert not scenes["inria"].conventions.has_full_support


def test_planes_has_gaussians_on_every_side(scenes):
    scene = scenes["planes"]
    a, camera, c = scene.arrays, scene.camera, scene.conventions
    x = a["means"] @ camera.cam_from_world_R.T + camera.cam_from_world_t
    z, shown = x[:, 2], a["radii"][:, 0] > 0
    pixels = x[:, :2] / x[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    is_inside = ((pixels > 0) & (pixels < a["image_size"])).all(axis=1)
    for is_culled in (z < 0, (0 < z) & (z < c.near_plane), z > c.far_plane):  # whoever forgets this side shows them
        assert not shown[is_culled].any() and (is_culled & is_inside).sum() >= 3
    assert (shown & (z < 1.5 * c.near_plane)).sum() >= 2


def test_values_equal_their_thresholds(scenes):
    """By hand: two of the pile's hits leave 1/4, and the third would leave 1/8, which is where a pixel stops."""
    open_, stops = scenes["equality-inria"].arrays, scenes["equality"].arrays
    assert stops["alpha"][5, 6] == 0.75 and open_["alpha"][5, 6] == 0.875
    assert stops["median_depth"][5, 6] == open_["median_depth"][5, 6] == 1  # T = 1/2 is not below one half
    assert stops["alpha"][5, 17] == open_["alpha"][5, 17] == 1 - 0.25 * 0.75
    assert open_["alpha"][12, 6] == 1 - (1 - 2.0**-8) * 0.75 and open_["hit_count"][9] == 1
    assert stops["dominant_ids"][12, 17] == 6 and len(set(stops["depths"][6:9])) == 1  # the first of one depth
    for a in (open_, stops):
        assert (a["radii"][11:, 0] > 0).tolist() == [False, True, True, False, True, False]
    assert stops["opacities2d"][9] == 0  # alpha_min itself reaches nothing, by the rule of full support


@pytest.mark.parametrize("name", ["equality", "equality-inria"])
def test_nothing_but_what_is_meant_is_near_a_threshold(scenes, name):
    """The piles' middles are; anywhere else rounding would decide after all."""
    scene = scenes[name]
    bins = reference_bins(scene.arrays, scene.conventions, (16, 16))
    near = thresholds(projection_of(scene.arrays), bins, scene.conventions).is_near
    meant = {(5, 6), (5, 17), (12, 6)} | {(int(y), int(x)) for y, x in np.argwhere(scene.arrays["dominant_ids"] == 6)}
    found = {(int(y), int(x)) for y, x in np.argwhere(near)}
    assert (5, 6) in found and (5, 17) in found
    assert {pixel for pixel in found if abs(pixel[0] - 12) > 3 or abs(pixel[1] - 17) > 3} <= meant


@pytest.mark.parametrize("name", ["ordinary", "antialiased", "inria"])
def test_totals_are_the_gradient_of_the_whole_render(name):
    scene = truth(inputs(next(recipe for recipe in RECIPES if recipe.name == name)), zeros=("v_depths",))
    a = scene.arrays
    with np.errstate(divide="ignore"):
        logits = np.log(a["opacities"]) - np.log1p(-a["opacities"])
    gaussians = Gaussians(a["means"], a["quats"], np.log(a["scales"]), logits, a["sh_dc"], a["sh_rest"])
    settings = {"background": a["background"], "conventions": scene.conventions, "backend": REFERENCE}
    output, tape = render(gaussians, scene.camera, **settings)
    v = render_vjp(tape, a["v_image"], a["v_alpha"])
    pairs = {
        "image": output.image,
        "v_means": v.gaussians.means,
        "v_quats": v.gaussians.quats,
        "v_sh_rest": v.gaussians.sh_rest,
        "v_R": v.cam_from_world_R,
        "v_t": v.cam_from_world_t,
    }
    for key, array in pairs.items():
        np.testing.assert_allclose(array, a[key], atol=PARITY_FLOAT64 * np.abs(a[key]).max(), rtol=0, err_msg=key)
    assert not a["v_depths"].any()


def test_numbers_are_those_of_float32_and_rounding_decides_nothing(scenes):
    for scene in scenes.values():
        if scene.is_exact:
            continue
        for spec in SPECS.values():
            if spec.role in ("input", "cotangent") and spec.kind == "float64" and spec.name != "cam_from_world_R":
                array = scene.arrays[spec.name]
                assert np.array_equal(array, array.astype(np.float32)), spec.name
        bins = reference_bins(scene.arrays, scene.conventions, (16, 16))
        may_flip = thresholds(projection_of(scene.arrays), bins, scene.conventions).jumps
        assert not scene.arrays["v_image"][may_flip].any() and not scene.arrays["v_alpha"][may_flip].any()
        depths = np.sort(scene.arrays["depths"][scene.arrays["radii"][:, 0] > 0].astype(np.float32))
        assert (np.diff(depths) > 0).all(), "two depths are equal in float32"


def test_a_folder_comes_back_bit_by_bit(exported, scenes):
    again = load(exported)
    assert list(again) == NAMES
    for name, scene in again.items():
        assert scene.conventions == scenes[name].conventions and scene.what == scenes[name].what
        for key, array in scene.arrays.items():
            assert array.dtype == scenes[name].arrays[key].dtype
            assert np.array_equal(array, scenes[name].arrays[key])
    assert sum(file.stat().st_size for file in exported.rglob("*") if file.is_file()) < FOLDER_SIZE_MAX


def test_the_manifest_is_enough_to_read_everything(exported):
    """With JSON, zip and SHA-256 alone, as another language would."""
    manifest = json.loads((exported / MANIFEST).read_text())
    assert set(manifest["arrays"]) == set(SPECS)
    for name, about in manifest["arrays"].items():
        assert {"file", "role", "shape", "dtype", "unit", "meaning", "tolerance"} <= set(about), name
        assert about["tolerance"]["reason"] and about["tolerance"]["float64"] <= about["tolerance"]["float32"]
    named = {name for stage in manifest["stages"].values() for names in stage.values() for name in names}
    assert named == set(SPECS)
    for scene, entry in manifest["scenes"].items():
        assert set(entry["conventions"]) == set(Conventions._fields)
        for file, about in entry["files"].items():
            path = exported / scene / file
            assert hashlib.sha256(path.read_bytes()).hexdigest() == about["sha256"]
            with np.load(path) as archive:
                for key, promised in about["arrays"].items():
                    array = archive[key]
                    assert list(array.shape) == promised["shape"] and array.dtype == promised["dtype"]
                    assert array.flags.c_contiguous and array.dtype.byteorder in "=<|"
                    assert manifest["arrays"][key]["file"] == file
    fields = {name.strip() for names in manifest["conventions"] for name in names.split(",")}
    assert fields == set(Conventions._fields) == {n.strip() for names in convention_words() for n in names.split(",")}


def test_the_readme_explains_every_array_and_stage(exported):
    text = (exported / README).read_text()
    for name in (*SPECS, *STAGE_INPUTS, *NAMES):
        assert f"`{name}`" in text or f"| {name} |" in text, name
    assert "minisplat-ref oracle compare" in text


def test_stages_read_what_exists():
    for stage in STAGE_INPUTS:
        for name in (*STAGE_INPUTS[stage], *STAGE_COTANGENTS[stage]):
            assert name in SPECS


def change_byte(folder):
    path = folder / "ordinary" / "project.npz"
    content = bytearray(path.read_bytes())
    content[1000] ^= 1
    path.write_bytes(content)


def change_manifest(folder, change):
    manifest = json.loads((folder / MANIFEST).read_text())
    change(manifest)
    (folder / MANIFEST).write_text(json.dumps(manifest))


def rewrite(folder, **changes):
    """Replace arrays of a file, and its hash, too: what is left to find are the arrays themselves."""
    path = folder / "ordinary" / "project.npz"
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    change_manifest(folder, lambda m: m["scenes"]["ordinary"]["files"]["project.npz"].update(sha256=digest))


DAMAGE = {
    "a changed byte": (change_byte, "SHA-256 differs"),
    "a missing file": (lambda f: (f / "sh3" / "loss.npz").unlink(), "loss.npz is missing"),
    "no manifest": (lambda f: (f / MANIFEST).unlink(), "does not exist"),
    "half a manifest": (lambda f: (f / MANIFEST).write_text('{"format"'), "not valid JSON"),
    "another version": (lambda f: change_manifest(f, lambda m: m.update(version=1)), "version 1, this reads"),
    "another format": (lambda f: change_manifest(f, lambda m: m.update(format="x")), "is 'x'"),
    "no conventions": (lambda f: change_manifest(f, lambda m: m["scenes"]["sh3"].pop("conventions")), "lacks"),
    "another shape": (lambda f: rewrite(f, depths=np.zeros(3)), "depths is float64[3], not as"),
    "another dtype": (lambda f: rewrite(f, radii=np.zeros((150, 2))), "radii is float64[150, 2]"),
    "a missing array": (lambda f: rewrite(f, conics=None), "lacks conics"),
    "an unknown array": (lambda f: rewrite(f, colours=np.zeros(2)), "colours is float64[2], not as"),
    "words": (lambda f: rewrite(f, depths=np.array(["a"])), "only floating point and integers"),
    "objects": (lambda f: rewrite(f, depths=np.array([None])), "not an .npz of plain arrays"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_found_and_named_in_one_line(copy, damage):
    change, message = DAMAGE[damage]
    change(copy)
    with pytest.raises(InputError) as caught:
        load(copy)
    assert message in str(caught.value)
    assert str(copy) in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_is_there_whole_or_not_at_all(scenes, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("disk full")

    monkeypatch.setattr(files, "readme", fail)  # the last thing that is written
    with pytest.raises(RuntimeError):
        export(tmp_path / "golden", {"sh3": scenes["sh3"]})
    assert not list(tmp_path.iterdir())


def test_the_command_writes_what_load_reads(tmp_path, capsys):
    assert main(["oracle", "export", str(tmp_path / "golden")]) == 0
    assert "9 scenes" in capsys.readouterr().out
    assert list(load(tmp_path / "golden")) == NAMES
    assert main(["oracle", "export", str(tmp_path / "golden")]) == 2
    assert "already there" in capsys.readouterr().err
