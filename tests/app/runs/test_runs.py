"""A run's data are never lost nor mixed: its scene is known again, and whatever ends a training leaves it whole."""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref import load_ply, memory
from minisplat_ref.app.cli import main
from minisplat_ref.app.runs import checkpoints, fingerprint, run, run_folder
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene, read_image, write_image
from minisplat_ref.io.checkpoint import load_checkpoint, save_checkpoint
from minisplat_ref.io.viewpoints import scene_viewpoints, to_json
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training import interruption
from minisplat_ref.training.schedule import action_name
from run_commands import (  # noqa: F401  (a fixture)
    ITERATIONS,
    OPTIONS,
    RECIPE,
    SCENE,
    contents,
    interrupt_at,
    photograph,
    read_json,
    refused,
    write_room,
)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A scene; tests copy it before they change it."""
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def finished(original, tmp_path_factory):
    """A finished training; tests copy it before they change it."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def scene(original, tmp_path):
    return shutil.copytree(original, tmp_path / "nook")


@pytest.fixture
def done(scene, tmp_path):
    """A finished training on its own scene, which may be changed."""
    assert main(["train", str(scene), *OPTIONS, "--out", str(tmp_path / "run")]) == 0
    return tmp_path / "run"


def change_photograph(scene, name="view_0002"):
    path = photograph(scene, name)
    image = read_image(path)
    image[3, 5, 1] ^= 1  # the smallest change there is
    write_image(path, image)


def stopped_run(scene, folder, step=12):
    """A training that Ctrl-C has ended."""
    with pytest.MonkeyPatch.context() as patch:
        interrupt_at(step, patch)
        assert main(["train", str(scene), *OPTIONS, "--out", str(folder)]) == 130
    return folder


# --- which scene a run belongs to ---


def test_eval_of_another_scene_is_refused_and_changes_nothing(done, tmp_path, refused):
    write_room(tmp_path / "other", "glossy", **SCENE)
    before = contents(done)
    line = refused("eval", done, "--scene", tmp_path / "other")
    assert f"{tmp_path / 'other'} is not the scene of {done}: " in line
    assert "8 views (view_0001, view_0002, view_0003, ...) have other photographs" in line
    assert "--out DIR measures on this one all the same" in line
    assert contents(done) == before


def test_a_changed_pixel_is_another_scene_for_eval_and_resume(done, scene, refused):
    change_photograph(scene)
    before = contents(done)
    for command in (["eval", done], ["train", "--resume", done, "--iterations", 25]):
        assert "1 view (view_0002) has another photograph" in refused(*command)
    assert contents(done) == before


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda entries: entries[1].update(position=[9.0, 9, 9]), "1 view (b) has moved"),
        (lambda entries: entries[1].update(fx=9.5), "1 view (b) has moved"),
        (lambda entries: entries[1].update(time=0.5), "1 view (b) has moved"),
        (lambda entries: entries[1].update(optics=["brown", 0.2]), "1 view (b) has moved"),
        (lambda entries: entries[3].update(optics=["brown", 0.3]), "1 view (d) has moved"),
        (lambda entries: entries[3].update(optics=["fisheye", 0.2]), "1 view (d) has moved"),
        (lambda entries: entries[3].pop("optics"), "1 view (d) has moved"),
        (lambda entries: entries[0].update(width=9), "1 view (a) has another size"),
        (lambda entries: entries[2].update(photograph="0"), "1 view (c) has another photograph"),
        (lambda entries: entries.pop(), "1 view (e) is missing"),
        (lambda entries: entries.append({**entries[0], "img_name": "f"}), "1 view (f) is new"),
        (lambda entries: [e.update(photograph="0") for e in entries], "5 views (a, b, c, ...) have other photographs"),
        (lambda entries: [e.update(img_name=e["img_name"] * 2) for e in entries], "no view has the name of one of the"),
        (lambda entries: (entries.pop(0), entries[0].update(fy=1.0)), "1 view (a) is missing, 1 view (b) has moved"),
    ],
)
def test_what_differs_is_said(change, expected):
    entries = [
        {
            "img_name": name,
            "split": "train",
            "width": 8,
            "height": 6,
            "position": [0.1, 2.0, 3e4],
            "rotation": np.eye(3).tolist(),
            **dict.fromkeys(("fx", "fy", "cx", "cy", "time"), 0.25),
            "photograph": name,
            **({"optics": ["brown", 0.2]} if name == "d" else {}),
        }
        for name in "abcde"
    ]
    others = json.loads(json.dumps(entries))
    assert fingerprint.difference(entries, others) == ""
    others[0]["position"][0] += 1e-12  # another machine's rounding
    others[3]["optics"][1] += 1e-12
    assert fingerprint.difference(entries, others) == ""
    change(others)
    assert fingerprint.difference(entries, others).startswith(expected)


def test_the_hash_is_of_the_pixels_and_the_mask_not_of_the_file(original):
    view = load_scene(original, test_every=0).train_views[0]
    scene = load_scene(original, test_every=0)

    def hash_of(changed):
        return fingerprint.take_fingerprint(scene._replace(train_views=(changed,)))[0]["photograph"]

    plain = hash_of(view)
    assert hash_of(view._replace(image=view.image.copy(order="F"))) == plain  # the same pixels otherwise in memory
    mask = np.ones(view.image.shape[:2], bool)
    assert hash_of(view._replace(mask=mask)) not in (plain, hash_of(view._replace(mask=~mask)))
    assert hash_of(view._replace(image=view.image.reshape(32, 24, 3))) != plain


def test_a_moved_scene_is_found_with_its_new_place(finished, original, tmp_path):
    folder, moved = tmp_path / "run", tmp_path / "elsewhere"
    scene = shutil.copytree(original, tmp_path / "nook")
    stopped_run(scene, folder)
    scene.rename(moved)
    assert main(["eval", str(folder)]) == 2
    assert main(["eval", str(folder), "--scene", str(moved)]) == 0
    assert main(["train", "--resume", str(folder)]) == 2
    assert main(["train", "--resume", str(folder), "--scene", str(moved)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()
    assert read_json(folder / "config.json")["settings"]["scene"] == str(moved)
    assert main(["eval", str(folder)]) == 0  # from now on without


def test_resume_on_another_scene_is_refused_and_changes_nothing(original, tmp_path, refused):
    folder = stopped_run(original, tmp_path / "run")
    other = shutil.copytree(original, tmp_path / "other")
    change_photograph(other)
    before = contents(folder)
    line = refused("train", "--resume", folder, "--scene", other)
    assert f"{other} is not the scene of {folder}: 1 view (view_0002) has another photograph" in line
    assert contents(folder) == before


def test_measuring_other_views_leaves_the_run_s_measures_alone(done, capsys):
    before = contents(done)
    assert main(["eval", str(done), "--test-every", "2"]) == 0
    captured = capsys.readouterr()
    assert "2 of the 4 views were trained on, which flatters the measures" in captured.err
    own = done / "eval-test-every-2"
    assert str(own) in captured.out
    now = contents(done)
    assert {name: content for name, content in now.items() if not name.startswith(own.name)} == before
    metrics = read_json(own / "metrics.json")
    assert len(metrics["per_view"]) == 4 and (metrics["test_every"], metrics["iterations"]) == (2, ITERATIONS)
    assert len(list((own / "renders").iterdir())) == 4
    shared = {view["name"]: view for view in metrics["per_view"]}
    for view in read_json(done / "metrics.json")["per_view"]:
        assert shared[view["name"]] == view  # the same views measured the same


def test_measuring_other_photographs_needs_a_place_for_it(done, scene, tmp_path, refused, capfd):
    change_photograph(scene, "view_0004")
    before = contents(done)
    out = tmp_path / "elsewhere"
    assert main(["eval", str(done), "--out", str(out)]) == 0
    assert "not the scene that it was trained on: 1 view (view_0004) has another photograph" in capfd.readouterr().err
    assert contents(done) == before
    assert read_json(out / "metrics.json")["notes"] and len(list((out / "renders").iterdir())) == 2
    assert main(["eval", str(done), "--out", str(out)]) == 0  # an earlier evaluation is replaced
    (out / "letters.txt").write_text("")
    assert f"{out} holds something other than an evaluation" in refused("eval", done, "--out", out)


def test_images_of_views_that_are_no_more_do_not_stay(done):
    write_image(done / "renders" / "of_long_ago.png", np.zeros((4, 4, 3), np.uint8))
    assert main(["eval", str(done)]) == 0
    assert {path.stem for path in (done / "renders").iterdir()} == {"view_0000", "view_0004"}


def make_old(folder, scene):
    """Take away what runs of earlier versions did not have."""
    views = scene_viewpoints(load_scene(scene, test_every=4))
    (folder / "cameras.json").write_text(json.dumps(to_json(views)))
    config = read_json(folder / "config.json")
    del config["settings"]["drop_bad_steps"]
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "checkpoint-previous.npz").unlink()


def test_runs_of_earlier_versions_are_read_and_a_line_says_what_is_not_checked(done, scene, refused, capfd):
    make_old(done, scene)
    change_photograph(scene)
    assert main(["eval", str(done)]) == 0
    line = "kept no hashes of photographs: only the cameras have been compared"
    assert capfd.readouterr().err.count(line) == 1
    assert main(["train", "--resume", str(done), "--iterations", "22"]) == 0
    assert capfd.readouterr().err.count(line) == 1
    assert main(["eval", str(done)]) == 0
    assert line not in capfd.readouterr().err  # it has hashes now
    make_old(done, scene)
    entries = read_json(done / "cameras.json")
    entries[0]["position"][0] += 1
    (done / "cameras.json").write_text(json.dumps(entries))
    assert "1 view (view_0001) has moved" in refused("eval", done)
    (done / "cameras.json").unlink()
    assert main(["eval", str(done)]) == 0
    assert f"{done} has no cameras.json: whether the scene is its own cannot be checked" in capfd.readouterr().err


# --- a budget is a ceiling ---


@pytest.mark.parametrize("choose", ["sampling", "rank", "merging"])
def test_a_budget_above_the_candidates_keeps_them_all(original, tmp_path, capfd, choose):
    options = ["--recipe", "mini-splatting", "--iterations", "40", "--test-every", "4", "--simplify", choose]
    folder = tmp_path / "out"
    assert main(["train", str(original), *options, "--budget", "100000", "--out", str(folder)]) == 0
    (line,) = re.findall("simplification keeps all .*", capfd.readouterr().err)
    n = int(re.match(r"simplification keeps all (\d+) Gaussians that matter", line)[1])
    assert line.endswith("fewer than the budget of 100,000")
    assert 0 < len(load_ply(folder / "point_cloud.ply").means) <= n


# --- however it ends ---


def test_a_folder_without_work_can_be_started_again(original, finished, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.json", "cameras.json"):
        shutil.copy(finished / name, folder / name)
    (folder / ".checkpoint.npz.999999999.part").write_bytes(b"half")
    for arguments in (["train", str(original), *OPTIONS, "--out"], ["train", "--resume"]):
        copy = shutil.copytree(folder, tmp_path / f"run{len(arguments)}")
        assert main([*arguments, str(copy)]) == 0
        assert contents(copy).keys() == contents(finished).keys()
        assert (copy / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def test_a_failure_before_the_first_step_takes_away_its_own_files_only(original, tmp_path, refused, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_text("{}")  # of a run that has not begun
    (folder / "notes.txt").write_text("mine")
    monkeypatch.setattr(run, "get_backend", lambda name: replace(CPU, adam_update=failing_adam(1)))
    assert refused("train", original, *OPTIONS, "--out", folder).endswith("too much")
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]


def test_sigterm_saves_like_ctrl_c(original, finished, tmp_path, monkeypatch, capfd):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        interrupt_at(12, patch, signal.SIGTERM)
        assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 130
    assert "stopped after 12 of 20 iterations, all saved; to continue" in capfd.readouterr().err
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def test_ctrl_c_while_views_are_measured_says_that_all_is_saved(original, finished, tmp_path, monkeypatch, capfd):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(run, "score", lambda *_: signal.raise_signal(signal.SIGINT))
        assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 130
    line = capfd.readouterr().err.splitlines()[-1]
    assert "stopped after 20 of 20 iterations, all saved but not measured; to continue" in line
    assert main(["info", str(folder)]) == 0
    assert f"trained, but not measured: minisplat-ref train --resume {folder}" in capfd.readouterr().out
    assert main(["train", "--resume", str(folder)]) == 0
    assert {path.name for path in folder.iterdir()} == {path.name for path in finished.iterdir()}
    assert read_json(folder / "metrics.json")["psnr"] == read_json(finished / "metrics.json")["psnr"]


def test_info_says_whether_a_run_has_ended(finished, original, tmp_path, capsys):
    assert main(["info", str(finished)]) == 0
    assert re.search(r"^state +complete after 20 iterations$", capsys.readouterr().out, re.MULTILINE)
    folder = stopped_run(original, tmp_path / "run")
    assert main(["info", str(folder)]) == 0
    expected = f"incomplete, 12 of 20 iterations are saved: minisplat-ref train --resume {folder}"
    assert expected in capsys.readouterr().out
    for name in (*run_folder.WORK, run_folder.CURVE):
        (folder / name).unlink(missing_ok=True)
    assert main(["info", str(folder)]) == 0
    assert f"has not begun: minisplat-ref train --resume {folder}" in capsys.readouterr().out


@pytest.fixture
def killed(original, tmp_path, monkeypatch):
    """A training of which only the checkpoint of iteration 15 is left, and an older result."""
    folder = tmp_path / "killed"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "SECONDS", -1.0)
        interrupt_at(15, patch)
        assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 130
    (folder / "metrics.json").unlink()
    (folder / "point_cloud.ply").rename(tmp_path / "expected.ply")
    return folder


def test_images_and_a_ply_of_a_killed_run(killed, tmp_path, capfd):
    assert main(["render", str(killed), "--out", str(tmp_path / "views")]) == 0
    assert f"{killed} has not ended: this is its checkpoint of iteration 15" in capfd.readouterr().err
    expected = ["render", str(tmp_path / "expected.ply"), "--cameras", str(killed / "cameras.json")]
    assert main([*expected, "--out", str(tmp_path / "expected")]) == 0
    for path in (tmp_path / "views").glob("*.png"):
        assert path.read_bytes() == (tmp_path / "expected" / path.name).read_bytes()

    for source in (killed, killed / "checkpoint.npz"):
        assert main(["convert", str(source), str(tmp_path / "out.ply")]) == 0
        assert "of iteration 15 in" in capfd.readouterr().out
        assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "expected.ply").read_bytes()


def test_a_killed_run_is_measured_in_a_folder_of_its_own(killed, capsys):
    assert main(["eval", str(killed)]) == 0
    assert not (killed / "metrics.json").exists()
    assert read_json(killed / "eval-iteration-15" / "metrics.json")["iterations"] == 15


def test_a_result_that_is_older_than_the_checkpoint_is_not_shown_for_it(done, monkeypatch, tmp_path, capfd):
    """Continued and killed: result and measures are of iteration 20, the checkpoint of 25."""
    result = contents(done)
    with monkeypatch.context() as patch:
        interrupt_at(25, patch)
        assert main(["train", "--resume", str(done), "--iterations", "30"]) == 130
    newer = (done / "point_cloud.ply").read_bytes()
    for name in ("point_cloud.ply", "metrics.json"):
        (done / name).write_bytes(result[name])
    assert main(["convert", str(done), str(tmp_path / "out.ply")]) == 0
    assert (tmp_path / "out.ply").read_bytes() == newer != result["point_cloud.ply"]


def test_convert_of_a_finished_run_and_of_what_is_none(finished, tmp_path, refused, capfd):
    assert main(["convert", str(finished), str(tmp_path / "out.ply")]) == 0
    assert (tmp_path / "out.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()
    assert "the run's result" in capfd.readouterr().out
    assert "nothing.npz does not exist" in refused("convert", tmp_path / "nothing.npz", tmp_path / "a.ply")
    assert "not named like a PLY" in refused("convert", finished, tmp_path / "a.npz")
    empty = shutil.copytree(finished, tmp_path / "empty")
    for name in run_folder.WORK:
        (empty / name).unlink()
    assert f"{empty} has no Gaussians yet" in refused("convert", empty, tmp_path / "a.ply")


def test_two_trainings_do_not_write_into_one_folder(original, tmp_path, refused):
    folder = stopped_run(original, tmp_path / "run")
    before = contents(folder)
    with run_folder.hold_folder(folder):
        for command in (["train", "--resume", folder], ["eval", folder]):
            assert f"another process is writing into {folder}" in refused(*command)
    assert contents(folder) == before
    assert main(["eval", str(folder)]) == 0


def test_a_failure_in_the_middle_of_an_iteration_keeps_the_last_checkpoint(original, finished, tmp_path, refused):
    """An event that fails half-way: what is saved is whole, and the run continues from there."""
    folder = tmp_path / "run"
    get_backend = run.get_backend
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoints, "SECONDS", -1.0)
        patch.setattr(run, "get_backend", lambda name: replace(get_backend(name), adam_update=failing_adam(6 * 13 + 2)))
        line = refused("train", original, *OPTIONS, "--out", folder)
    assert line.endswith(f"too much; iteration 13 is saved; to continue: minisplat-ref train --resume {folder}")
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def failing_adam(call):
    calls = []

    def adam_update(*args):
        calls.append(None)
        if len(calls) == call:
            raise InputError("too much")
        CPU.adam_update(*args)

    return adam_update


# --- disks ---


def limited(n_bytes):
    """For a child process: no file may be larger."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, n_bytes))


def test_a_full_disk_is_one_line_and_what_was_saved_stays(original, finished, tmp_path):
    """The system's own refusal: the checkpoint of the beginning fits, the last one (with its moments) does not."""
    folder = tmp_path / "run"
    limit = (finished / "checkpoint.npz").stat().st_size - 100
    code = "import sys; from minisplat_ref.app.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, "train", str(original), *OPTIONS, "--out", str(folder)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limited(limit),
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f"minisplat-ref: error: {folder / 'checkpoint.npz'} cannot be written (File too large): ")
    assert not [path for path in contents(folder) if path.endswith(".part")]
    assert not folder.exists() or load_checkpoint(folder / "checkpoint.npz")


def test_a_log_that_cannot_be_written_stops_with_all_saved(original, finished, tmp_path, refused, monkeypatch):
    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        opened = []

        def no_space(path, mode="r", **named):
            opened.extend([path] * (path.name == "log.jsonl"))
            if len(opened) == 3:
                raise OSError(28, "No space left on device", str(path))
            return open(path, mode, **named)

        patch.setattr("minisplat_ref.app.runs.progress.open", no_space, raising=False)
        line = refused("train", original, *OPTIONS, "--out", folder)
    assert f"{folder / 'log.jsonl'} cannot be written (No space left on device): make room" in line
    assert line.endswith(f"iteration 15 is saved; to continue: minisplat-ref train --resume {folder}")
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def test_a_line_of_the_log_that_was_cut_off_does_not_count(tmp_path):
    path = tmp_path / "log.jsonl"
    record = {"step": 5, "seconds": 0.5, "psnr": 20.0}
    path.write_text(json.dumps(record) + "\n" + '{"step": 10, "sec')
    assert read_log(path) == [record]
    path.write_text('{"step": 10, "sec\n' + json.dumps(record) + "\n")
    with pytest.raises(ValueError, match="line 1 is not a record"):
        read_log(path)


@pytest.mark.parametrize("damage", ["torn", "gone", "another's", "whole but wrong"])
def test_a_damaged_checkpoint_is_passed_over_and_a_line_says_so(original, finished, tmp_path, damage, capfd):
    folder = stopped_run(original, tmp_path / "run")
    path = folder / "checkpoint.npz"
    content = path.read_bytes()
    if damage == "torn":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "gone":
        path.unlink()
    elif damage == "whole but wrong":
        arrays, metadata = load_checkpoint(path)
        save_checkpoint(path, {**arrays, "first.means": arrays["first.means"][1:]}, metadata)
    else:
        with np.load(path) as mine, np.load(finished / "checkpoint.npz") as other:
            np.savez(path, **{**mine, "gaussians.means": other["gaussians.means"]})
    capfd.readouterr()
    assert main(["train", "--resume", str(folder)]) == 0
    captured = capfd.readouterr()
    warnings = [line for line in captured.err.splitlines() if "taking" in line]
    how = "is missing" if damage == "gone" else "is damaged"
    assert warnings == [
        f"minisplat-ref: warning: {path} {how}: taking {folder / 'checkpoint-previous.npz'}, the one before"
    ]
    assert "going on from iteration 0 to 20" in captured.out  # of the one before
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def test_two_damaged_checkpoints_are_refused_by_name(original, tmp_path, refused):
    folder = stopped_run(original, tmp_path / "run")
    for name in ("checkpoint.npz", "checkpoint-previous.npz"):
        (folder / name).write_bytes(b"PK")
    before = contents(folder)
    line = refused("train", "--resume", folder)
    assert f"{folder / 'checkpoint.npz'} is not an .npz of plain arrays, or is damaged" in line
    assert contents(folder) == before


# --- compiling ---


def test_ctrl_c_while_compiling_is_heard_at_once(original, tmp_path):
    """Sent after the first stage: what is being compiled, on at least one more processor, is given up.

    Nothing is timed. Processes that were left to finish what they had begun would each save a kernel at least.
    """
    kernels = tmp_path / "kernels"
    command = [sys.executable, "-m", "minisplat_ref", "train", str(original), *OPTIONS, "--out", str(tmp_path / "run")]
    with subprocess.Popen(
        command,
        env=os.environ | {"NUMBA_CACHE_DIR": str(kernels)},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    ) as process:
        seen = b""
        while not seen.endswith(b"once."):
            byte = process.stderr.read(1)
            assert byte, seen
            seen += byte
        n_before = len(list(kernels.rglob("*.nbc")))
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read().decode()
    assert process.returncode == 130
    assert rest.splitlines()[-1] == "minisplat-ref: interrupted"
    assert len(list(kernels.rglob("*.nbc"))) - n_before <= 1  # which was just being saved
    assert not (tmp_path / "run").exists()


# --- images ---


def test_images_of_an_earlier_rendering_do_not_stay(done, capsys):
    for frames in (5, 2):
        options = ["--cameras", "orbit", "--frames", str(frames), "--size", "8x6", "--depth"]
        assert main(["render", str(done), *options]) == 0
        assert len(list((done / "views").glob("orbit_*"))) == 3 * frames
    assert main(["render", str(done)]) == 0
    names = {path.name for path in (done / "views").iterdir()}
    assert names == {"view_0000.png", "view_0004.png", "pictures.json"}


def test_images_of_somebody_else_are_not_touched(done, tmp_path, refused):
    out = tmp_path / "holidays"
    out.mkdir()
    (out / "beach.png").write_bytes(b"")
    (out / "notes.txt").write_text("")
    line = refused("render", done, "--out", out)
    assert f"{out} holds images other than those of a rendering, such as beach.png" in line
    assert {path.name for path in out.iterdir()} == {"beach.png", "notes.txt"}
    (out / "beach.png").unlink()
    (out / "pictures.json").write_text('{"pictures": ["../../run/checkpoint", "../x"]}')
    (tmp_path / "x.png").write_bytes(b"")
    assert main(["render", str(done), "--out", str(out)]) == 0
    assert (tmp_path / "x.png").exists() and (out / "notes.txt").exists()


def test_a_image_that_does_not_fit_into_memory_is_foreseen(done, refused):
    line = refused("render", done, "--cameras", "orbit", "--size", "1000000x1000000")
    assert "an image of 1000000x1000000 takes about 65000.0 GB" in line and re.search(r"\d+x\d+ fits", line)
    assert not (done / "views").exists()


def test_a_training_that_does_not_fit_into_memory_is_foreseen(original, tmp_path, monkeypatch, refused, capfd):
    out = tmp_path / "run"
    monkeypatch.setattr(memory, "free_bytes", lambda: 10_000.0)
    assert "to read a photograph of 0.0 megapixels takes" in refused("train", original, *OPTIONS, "--out", out)
    monkeypatch.setattr(memory, "check_photograph", lambda *_: None)
    assert "training begins with about" in refused("train", original, *OPTIONS, "--out", out)
    assert not out.exists()
    monkeypatch.setattr(memory, "free_bytes", lambda: 1e9)
    assert main(["train", str(original), *OPTIONS, "--out", str(out)]) == 0
    line = r"^memory: about \d+ kB for the first 60 Gaussians, 1.0 GB are free: room for some [\d,]+$"
    assert re.search(line, capfd.readouterr().out, re.MULTILINE)


def test_densification_that_does_not_fit_stops_with_all_saved(original, tmp_path, monkeypatch, refused):
    """There is a checkpoint of the iteration before, since it was known that room was short."""
    options = [*RECIPE, "--iterations", "240", "--test-every", "4"]
    monkeypatch.setattr(memory, "free_bytes", lambda: 1.5 * 60 * 236 * 3)  # room for the new arrays of 90 Gaussians
    monkeypatch.setattr(memory, "check_start", lambda *_: "")
    monkeypatch.setattr(memory, "check_photograph", lambda *_: None)
    out = tmp_path / "run"
    line = refused("train", original, *options, "--set", "threshold=0", "--out", out)
    assert "there is no memory for 120 Gaussians, only for some 90: train on smaller photographs" in line
    step = int(re.search(r"iteration (\d+) is saved; to continue: ", line)[1])
    recipe = get_recipe("3dgs-accel", 240)
    densify = next(event for event in recipe.events if action_name(event) == "clone_and_split")
    assert densify.is_due(step + 1) and not any(densify.is_due(earlier) for earlier in range(1, step + 1))
    assert load_checkpoint(out / "checkpoint.npz")[1]["step"] == step
    monkeypatch.undo()
    assert main(["train", "--resume", str(out)]) == 0


# --- longer than planned ---


def test_a_longer_run_says_by_which_schedule_it_goes_on(done, capsys):
    assert main(["train", "--resume", str(done), "--iterations", "24"]) == 0
    expected = "going on from iteration 20 to 24 by the schedule of 20, which is over: rates stay at their last"
    assert expected in capsys.readouterr().out
    assert read_json(done / "config.json")["settings"]["schedule_iterations"] == ITERATIONS


def test_a_schedule_is_stretched_where_that_is_asked_for(done, capsys):
    assert main(["train", "--resume", str(done), "--iterations", "40", "--rescale"]) == 0
    assert "going on from iteration 20 to 40 by the schedule of 40, to which it has been" in capsys.readouterr().out
    config = read_json(done / "config.json")
    assert (config["settings"]["schedule_iterations"], config["recipe"]["iterations"]) == (40, 40)
    assert load_checkpoint(done / "checkpoint.npz")[1]["recipe"] == config["recipe"]
    assert main(["train", "--resume", str(done), "--iterations", "45"]) == 0
    assert "by the schedule of 40" in capsys.readouterr().out


def test_killed_between_the_settings_and_the_checkpoint_of_a_stretched_schedule(done, tmp_path, capsys):
    """config.json says 40 already, the checkpoint still 20: it continues as was asked."""
    straight = shutil.copytree(done, tmp_path / "straight")
    assert main(["train", "--resume", str(straight), "--iterations", "40", "--rescale"]) == 0
    config = read_json(done / "config.json")
    config["settings"].update(iterations=40, schedule_iterations=40)
    (done / "config.json").write_text(json.dumps(config))
    assert main(["train", "--resume", str(done)]) == 0
    assert (done / "point_cloud.ply").read_bytes() == (straight / "point_cloud.ply").read_bytes()


@pytest.mark.parametrize("option", [["--rescale"], ["--scene", "elsewhere"]])
def test_options_of_a_continued_run_are_refused_for_a_new_one(original, tmp_path, refused, option):
    assert f"{option[0]} is for a run that is continued" in refused("train", original, *option, "--out", tmp_path / "a")


# --- numbers that are not finite ---


def test_a_nan_stops_the_run_with_all_saved_and_can_be_dropped(original, tmp_path, refused, capfd, monkeypatch):
    folder, get_backend, drawn = tmp_path / "run", run.get_backend, []

    def broken(*args, **named):
        v = CPU.project_vjp(*args, **named)
        drawn.append(None)
        if len(drawn) in (10, 11):  # of the tenth iteration, and when it is looked at
            v.quats[5] = np.nan
        return v

    with monkeypatch.context() as patch:
        patch.setattr(run, "get_backend", lambda name: replace(get_backend(name), project_vjp=broken))
        line = refused("train", original, *OPTIONS, "--out", folder)
        path = folder / "bad-numbers-10.npz"
        assert re.search(r"iteration 10, view view_000\d, project_vjp: v_quats is nan in row 5 of 60; ", line)
        assert f"minisplat-ref oracle replay {path} shows it" in line
        assert line.endswith(f"iteration 9 is saved; to continue: minisplat-ref train --resume {folder}")
        drawn[:] = [None] * 9
        assert main(["train", "--resume", str(folder), "--drop-bad-steps"]) == 0
    assert "v_quats is nan in row 5 of 60; step left out" in capfd.readouterr().err
    assert read_json(folder / "config.json")["settings"]["drop_bad_steps"] is True
    assert main(["oracle", "replay", str(path)]) == 0  # the kernels themselves are not broken
    assert f"iteration 10, view {line.split('view ')[1].split(',')[0]}" in capfd.readouterr().out


def test_who_does_not_wait_for_an_iteration_is_told_what_is_saved(original, finished, tmp_path, capfd):
    """Ctrl-C twice, two seconds apart, in the middle of an Adam step of iteration 14."""
    folder, times, calls = tmp_path / "run", [0.0], []

    def adam_update(*args):
        calls.append(None)
        if len(calls) == 6 * 13 + 2:
            signal.raise_signal(signal.SIGINT)
            times[0] += 2.0
            signal.raise_signal(signal.SIGINT)
        CPU.adam_update(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interruption.time, "monotonic", lambda: times[0])
        patch.setattr(run, "get_backend", lambda name: replace(CPU, adam_update=adam_update))
        assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 130
    expected = f"stopped in the middle of iteration 14, saved is 0; to continue: minisplat-ref train --resume {folder}"
    assert expected in capfd.readouterr().err
    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()


def test_an_error_of_the_program_keeps_its_traceback_and_the_work(original, tmp_path):
    """Not in one line: somebody has to mend it."""

    def failing(*args, **named):
        raise ZeroDivisionError

    folder = stopped_run(original, tmp_path / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "get_backend", lambda name: replace(CPU, composite_vjp=failing))
        with pytest.raises(ZeroDivisionError) as caught:
            main(["train", "--resume", str(folder)])
    (note,) = caught.value.__notes__
    assert note == f"minisplat-ref: stopped; iteration 12 is saved; to continue: minisplat-ref train --resume {folder}"
    assert main(["train", "--resume", str(folder)]) == 0


def test_the_peak_is_of_this_process_alone():
    """Linux hands what getrusage says down to a process that a large one starts."""
    held = np.ones(50_000_000)  # 400 MB
    code = "from minisplat_ref.app.runs.run import peak_rss_mb; print(peak_rss_mb())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 20 < float(done.stdout) < held.nbytes / 1e6
    assert run.peak_rss_mb() > held.nbytes / 1e6
