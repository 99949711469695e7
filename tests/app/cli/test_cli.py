"""The command line from end to end: what each command leaves, how it is continued and interrupted, its help."""

import html
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import minisplat_ref
from browser import check_page
from minisplat_ref import InputError, load_ply, load_scene, save_ply
from minisplat_ref.app.cli import GROUPS, build_parser, demo, main
from minisplat_ref.app.reports.images import GAP, error_image, to_8_bits
from minisplat_ref.app.runs.progress import LOG_EVERY, Progress, read_log
from minisplat_ref.datasets.synthetic import SCENE_NAMES
from minisplat_ref.interface.arguments import BACKENDS as BACKEND_CHOICES
from minisplat_ref.interface.arguments import SYNTHETIC_SCENES
from minisplat_ref.io import read_image
from minisplat_ref.methods import RECIPES
from minisplat_ref.metrics import evaluate, psnr
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.rendering.backends import BACKENDS, CPU
from run_commands import write_room
from tolerances import PSNR_FLOAT32

WIDTH, HEIGHT = 32, 24
N_TRAIN, N_TEST = 6, 2
ITERATIONS = 20
HELP_LINES_MAX, HELP_COLUMNS_MAX = 45, 80
SETTINGS = {"n_views": N_TRAIN, "width": WIDTH, "height": HEIGHT, "n_points": 60, "test_every": 4}
RUN_FILES = {
    "cameras.json",
    "checkpoint.npz",
    "checkpoint-previous.npz",
    "config.json",
    "log.jsonl",
    "events.jsonl",
    "metrics.json",
    "point_cloud.ply",
    "renders",
    "report.html",
}


def commands():
    """The names of all commands, from the parser itself."""
    (choices,) = (action.choices for action in build_parser()._actions if isinstance(action.choices, dict))
    return list(choices)


def read_json(path):
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SETTINGS)


@pytest.fixture(scope="module")
def run_folder(scene_folder, tmp_path_factory):
    """A finished training; tests copy it before they change it."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    assert main(["train", str(scene_folder), *train_options(), "--out", str(folder)]) == 0
    return folder


def train_options(iterations=ITERATIONS):
    return ["--recipe", "3dgs-accel", "--iterations", str(iterations), "--test-every", "4", "--seed", "3"]


# train


def test_train_leaves_a_complete_folder(run_folder, scene_folder):
    assert {path.name for path in run_folder.iterdir()} == RUN_FILES

    gaussians = load_ply(run_folder / "point_cloud.ply")
    metrics = read_json(run_folder / "metrics.json")
    assert metrics["iterations"] == ITERATIONS
    assert metrics["n_gaussians"] == len(gaussians.means) > 0
    assert metrics["lpips"] is None and metrics["lpips_reason"]
    assert metrics["train_seconds"] > 0 and metrics["peak_rss_mb"] > 1
    assert [view["name"] for view in metrics["per_view"]] == ["view_0000", "view_0004"]
    scene = load_scene(scene_folder, test_every=4)
    expected = evaluate(gaussians, scene.test_views, RenderSettings(scene.background, backend=CPU))
    assert (metrics["psnr"], metrics["ssim"]) == (expected.psnr, expected.ssim)

    config = read_json(run_folder / "config.json")
    assert not metrics["has_ended_early"]
    assert config["settings"] == {
        "scene": str(scene_folder.resolve()),
        "downscale": 1,
        "test_every": 4,
        "undistort": False,
        "recipe": "3dgs-accel",
        "schedule_iterations": ITERATIONS,
        "iterations": ITERATIONS,
        "seed": 3,
        "profile": "GSPLAT_MAIN",
        "backend": "cpu",
        "simplify": None,
        "extension": None,
        "set": {},
        "budget": None,
        "scene_type": None,
        "eval_every": 0,
        "drop_bad_steps": False,
        "lpips_weights": None,
        "minutes": None,
        "max_drop": None,
        "max_bytes": None,
        "init": None,
        "background": None,
        "block": None,
        "whole_iterations": None,
        "fold": 0,
        "model": None,
    }
    assert config["recipe"]["iterations"] == ITERATIONS and config["versions"]["numba"]


def test_a_run_is_repeated_from_its_config(run_folder, tmp_path):
    """The same bytes; what the command line gives takes the place of what the file says."""
    config, again, other = run_folder / "config.json", tmp_path / "again", tmp_path / "other"
    assert main(["train", "--config", str(config), "--out", str(again)]) == 0
    assert (again / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()
    assert read_json(again / "config.json")["settings"] == read_json(config)["settings"]
    changed = ["--iterations", "2", "--set", "exposure=learned", "--out", str(other)]
    assert main(["train", "--config", str(run_folder), *changed]) == 0  # the folder will do, too
    settings = read_json(other / "config.json")["settings"]
    assert (settings["iterations"], settings["seed"], settings["set"]) == (2, 3, {"exposure": "learned"})


def test_train_logs_every_few_steps(run_folder):
    log = read_log(run_folder / "log.jsonl")
    assert [record["step"] for record in log] == list(range(LOG_EVERY, ITERATIONS + 1, LOG_EVERY))
    for record in log:
        assert set(record) == {"step", "loss", "psnr", "n_gaussians", "model_mb", "seconds", "cpu_seconds", "its/s"}
        assert record["model_mb"] == pytest.approx(record["n_gaussians"] * 59 * 4 / 1e6)  # 59 float32 at SH degree 3
        assert record["its/s"] == pytest.approx(record["step"] / record["seconds"])
    assert np.all(np.diff([record["seconds"] for record in log]) > 0)
    assert log[-1]["n_gaussians"] == len(load_ply(run_folder / "point_cloud.ply").means)


def test_renders_are_truth_render_error_side_by_side(run_folder, scene_folder):
    scene = load_scene(scene_folder, test_every=4)
    assert {path.stem for path in (run_folder / "renders").iterdir()} == {view.name for view in scene.test_views}
    view = scene.test_views[1]
    strip = read_image(run_folder / "renders" / f"{view.name}.png")
    assert strip.shape == (HEIGHT, 3 * WIDTH + 2 * GAP, 3)
    truth, shown, error = (strip[:, start : start + WIDTH] for start in range(0, 3 * WIDTH, WIDTH + GAP))
    output, _ = render(load_ply(run_folder / "point_cloud.ply"), view.camera, backend=CPU)
    np.testing.assert_array_equal(truth, view.image)
    np.testing.assert_array_equal(shown, to_8_bits(output.image))
    np.testing.assert_array_equal(error, error_image(view.image, shown))


def test_interrupted_then_resumed_gives_the_bytes_of_an_uninterrupted_run(
    scene_folder, run_folder, tmp_path, capfd, monkeypatch
):
    report_step = Progress.__call__

    def press_ctrl_c(progress, report):
        report_step(progress, report)
        if report.step == 12:
            signal.raise_signal(signal.SIGINT)

    folder = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "__call__", press_ctrl_c)
        assert main(["train", str(scene_folder), *train_options(), "--out", str(folder)]) == 130
    last_line = capfd.readouterr().err.splitlines()[-1]
    assert "stopped after 12 of 20 iterations" in last_line and f"train --resume {folder}" in last_line
    assert {path.name for path in folder.iterdir()} == RUN_FILES
    assert read_json(folder / "metrics.json")["iterations"] == 12
    assert [record["step"] for record in read_log(folder / "log.jsonl")] == [5, 10]

    assert main(["train", "--resume", str(folder)]) == 0
    assert (folder / "point_cloud.ply").read_bytes() == (run_folder / "point_cloud.ply").read_bytes()
    assert read_json(folder / "metrics.json")["psnr"] == read_json(run_folder / "metrics.json")["psnr"]
    assert [record["step"] for record in read_log(folder / "log.jsonl")] == [5, 10, 15, 20]


def test_resume_with_more_iterations_keeps_the_schedule(scene_folder, tmp_path, capfd):
    folder = tmp_path / "run"
    assert main(["train", str(scene_folder), *train_options(10), "--out", str(folder)]) == 0
    assert main(["train", "--resume", str(folder)]) == 2
    assert "--iterations above 10" in capfd.readouterr().err
    assert main(["train", "--resume", str(folder), "--iterations", "15"]) == 0
    settings = read_json(folder / "config.json")["settings"]
    assert (settings["schedule_iterations"], settings["iterations"]) == (10, 15)
    assert read_json(folder / "metrics.json")["iterations"] == 15
    assert main(["train", "--resume", str(folder), "--iterations", "16"]) == 0  # of a run that was made longer once


def test_log_after_a_crash_goes_back_to_the_checkpoint(tmp_path):
    records = [{"step": step, "seconds": 0.5 * step, "psnr": 20.0, "loss": 0.1} for step in (5, 10, 15)]
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    with Progress(path, first_step=12, last_step=20) as progress:
        assert progress.seconds == pytest.approx(5.0, abs=1.0)
        assert progress.clock.cpu_seconds is None  # the earlier part was not measured
    assert read_log(path) == records[:2]


def test_clocks_of_a_continued_training_count_neither_waiting_nor_what_is_not_training(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text(json.dumps({"step": 10, "seconds": 5.0, "cpu_seconds": 7.0, "psnr": 20.0, "loss": 0.1}) + "\n")
    with Progress(path, first_step=10, last_step=20) as progress:
        with progress.paused():
            sum(range(3_000_000))
        time.sleep(0.2)
        seconds, cpu_seconds = progress.clock
    assert seconds - 5.0 >= 0.2 and 0 <= cpu_seconds - 7.0 < 0.2


# render, eval, info


def test_render_test_views_with_depth(run_folder, scene_folder, tmp_path):
    assert main(["render", str(run_folder), "--depth", "--out", str(tmp_path / "views")]) == 0
    scene = load_scene(scene_folder, test_every=4)
    names = {view.name for view in scene.test_views}
    expected = {f"{name}{end}" for name in names for end in (".png", "_depth.npy", "_depth.png")}
    assert {path.name for path in (tmp_path / "views").iterdir()} == expected | {"pictures.json"}
    view = scene.test_views[0]
    output, _ = render(load_ply(run_folder / "point_cloud.ply"), view.camera, backend=CPU, with_depth=True)
    np.testing.assert_array_equal(read_image(tmp_path / "views" / f"{view.name}.png"), to_8_bits(output.image[..., :3]))
    depth = np.load(tmp_path / "views" / f"{view.name}_depth.npy")
    is_hit = output.alpha > 0
    assert is_hit.any()
    np.testing.assert_array_equal(depth[is_hit], output.image[..., 3][is_hit] / output.alpha[is_hit])


def test_render_from_a_camera_file_equals_the_run_s_own(run_folder, tmp_path):
    """cameras.json holds poses as position and rotation: the way there and back must not move the images."""
    cameras = run_folder / "cameras.json"
    assert main(["render", str(run_folder), "--cameras", "all", "--out", str(tmp_path / "own")]) == 0
    ply = str(run_folder / "point_cloud.ply")
    assert main(["render", ply, "--cameras", str(cameras), "--out", str(tmp_path / "file")]) == 0
    own = {path.name: path.read_bytes() for path in (tmp_path / "own").glob("*.png")}
    assert own == {path.name: path.read_bytes() for path in (tmp_path / "file").glob("*.png")}
    assert len(own) == N_TRAIN + N_TEST


def test_render_by_workers_is_render(run_folder, tmp_path, monkeypatch, capsys):
    """With commands carried out here in place of workers' processes."""
    from minisplat_ref.app.cli import render
    from minisplat_ref.app.runs import cluster

    def carry_out_all(workers, jobs, folder, inputs):
        assert workers.n == 2 and inputs == [run_folder]
        assert [job.name for job in jobs] == ["images 0:4", "images 4:8"]
        return max(main(job.choose(*job.arguments)) for job in jobs)

    monkeypatch.setattr(cluster, "carry_out_all", carry_out_all)
    monkeypatch.setattr(render, "PART", 4)
    for name, workers in (("here", "0"), ("there", "2")):
        film = tmp_path / f"{name}.gif"
        options = ["--cameras", "orbit", "--frames", "8", "--size", "32x24", "--film", str(film)]
        assert main(["render", str(run_folder), *options, "--out", str(tmp_path / name), "--workers", workers]) == 0
    here, there = ({path.name: path.read_bytes() for path in (tmp_path / n).iterdir()} for n in ("here", "there"))
    assert here == there and len(here) == 9
    assert (tmp_path / "here.gif").read_bytes() == (tmp_path / "there.gif").read_bytes()
    assert capsys.readouterr().out.count("8 images in") == 2


def test_render_orbit_of_a_ply_beside_it(run_folder, tmp_path):
    ply = tmp_path / "thing.ply"
    ply.write_bytes((run_folder / "point_cloud.ply").read_bytes())
    assert main(["render", str(ply), "--frames", "3", "--size", "20x10", "--background", "255,0,0"]) == 0
    images = sorted((tmp_path / "thing-views").glob("*.png"))
    assert [path.name for path in images] == ["orbit_000.png", "orbit_001.png", "orbit_002.png"]
    assert all(read_image(path).shape == (10, 20, 3) for path in images)
    assert len({path.read_bytes() for path in images}) == 3


def test_zero_gaussians_render_the_background(run_folder, tmp_path):
    empty = tmp_path / "empty.ply"
    save_ply(empty, type(g := load_ply(run_folder / "point_cloud.ply"))(*(field[:0] for field in g)))
    assert main(["render", str(empty), "--frames", "1", "--size", "8x6", "--background", "10,20,30", "--depth"]) == 0
    assert main(["info", str(empty)]) == 0
    np.testing.assert_array_equal(
        read_image(tmp_path / "empty-views" / "orbit_000.png"), np.full((6, 8, 3), (10, 20, 30), np.uint8)
    )
    assert not np.load(tmp_path / "empty-views" / "orbit_000_depth.npy").any()


def test_eval_measures_what_is_there_now(run_folder, scene_folder, tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.json", "metrics.json", "point_cloud.ply"):
        (folder / name).write_bytes((run_folder / name).read_bytes())
    before = read_json(folder / "metrics.json")
    assert main(["eval", str(folder)]) == 0
    assert read_json(folder / "metrics.json") == before
    assert f"PSNR {before['psnr']:.2f} dB" in capsys.readouterr().out

    gaussians = load_ply(folder / "point_cloud.ply")
    save_ply(folder / "point_cloud.ply", gaussians._replace(opacity_logits=np.full_like(gaussians.opacity_logits, -9)))
    assert main(["eval", str(folder)]) == 0
    after = read_json(folder / "metrics.json")
    scene = load_scene(scene_folder, test_every=4)
    black = np.mean([psnr(np.zeros(view.image.shape), view.image / 255) for view in scene.test_views])
    assert after["psnr"] == pytest.approx(black, rel=PSNR_FLOAT32) and after["psnr"] != before["psnr"]
    assert after["train_seconds"] == before["train_seconds"]


def test_info_names_counts(run_folder, scene_folder, capsys):
    n = len(load_ply(run_folder / "point_cloud.ply").means)
    for path, facts in (
        (run_folder / "point_cloud.ply", [f"Gaussians  {n}", "SH degree  3"]),
        (run_folder / "checkpoint.npz", ["iteration   20", f"Gaussians   {n}", "3dgs-accel for 20 iterations"]),
        (run_folder, [str(scene_folder), "psnr", f"{n}"]),
        (scene_folder, ["8: 7 training, 1 test", "32 x 24", "60"]),
    ):
        assert main(["info", str(path)]) == 0
        output = capsys.readouterr().out
        missing = [fact for fact in facts if fact not in output]
        assert not missing, (missing, output)


# demo


@pytest.fixture(scope="module")
def demo_folder(tmp_path_factory):
    """What a demo leaves, in a folder whose name a shell would take apart."""
    place = tmp_path_factory.mktemp("a demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo, "SCENE", {**demo.SCENE, **SETTINGS})
        patch.chdir(place)
        assert main(["demo", "--iterations", "10"]) == 0
    return place / "minisplat-demo"


def test_demo_does_not_touch_another(demo_folder, monkeypatch, capsys):
    monkeypatch.setattr(demo, "SCENE", {**demo.SCENE, **SETTINGS})
    monkeypatch.chdir(demo_folder.parent)
    before = (demo_folder / "metrics.json").read_bytes()
    assert main(["demo", "--iterations", "5"]) == 0
    assert (demo_folder / "metrics.json").read_bytes() == before
    assert str(demo_folder.parent / "minisplat-demo-2" / "report.html") in capsys.readouterr().out


def test_demo_writes_a_self_contained_report(demo_folder):
    folder = demo_folder
    assert {path.name for path in folder.iterdir()} == RUN_FILES | {"scene", "scene.html", "film.gif", "views"}
    page = (folder / "report.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    inside = ("data:image/png;base64,", "data:image/webp;base64,", "#")
    (scene,) = [link for link in links if not link.startswith(inside)]
    assert scene == "scene.html", "beside the report, which needs nothing else"
    assert not re.search(r"url\((?!#)|@import|<script src|<link", page)
    assert page.count("data:image/png") == 3 * 2 * N_TEST and page.count("<svg") == 3
    assert f"{read_json(folder / 'metrics.json')['psnr']:.2f} dB" in page


def test_the_commands_of_a_demo_run_from_anywhere(demo_folder, tmp_path):
    """The first of them, in a shell that finds the program, in another folder."""
    page = html.unescape((demo_folder / "report.html").read_text())
    line = re.search(r"<pre[^>]*>(.*render .*)</pre>", page)[1]
    assert shlex.quote(str(demo_folder)) in line
    environment = {**os.environ, "PATH": f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(f"{line} --frames 1", shell=True, cwd=tmp_path, check=True, env=environment)
    assert not any(tmp_path.iterdir()) and any(demo_folder.rglob("*orbit*"))


def test_the_report_of_a_demo_in_a_browser(demo_folder, browser):
    check_page(browser, demo_folder / "report.html")


def test_the_report_of_a_training_in_a_browser(run_folder, browser):
    check_page(browser, run_folder / "report.html")


def test_the_report_of_a_training_shows_it(run_folder):
    page, metrics = (run_folder / "report.html").read_text(), read_json(run_folder / "metrics.json")
    worst = min(metrics["per_view"], key=lambda view: view["psnr"])
    assert f"{metrics['psnr']:.2f} dB" in page and f"PSNR of the worst, {worst['name']}" in page
    assert page.count("data:image/png") == 3 * N_TEST and page.count('class="slider"') == N_TEST
    assert page.count("<svg") == 3 and "What was decided" not in page


# help


@pytest.mark.parametrize("command", ["", *commands()])
def test_help_fits_a_screen(command, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(HELP_COLUMNS_MAX))
    with pytest.raises(SystemExit) as exit_info:
        main([*command.split(), "--help"])
    assert exit_info.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= HELP_LINES_MAX
    assert max(map(len, lines)) <= HELP_COLUMNS_MAX


def test_help_loads_nothing_heavy():
    """Measured in modules, not in seconds, so that a busy machine cannot fail it."""
    code = f"""
import sys
from minisplat_ref.app.cli import main
for command in {["", *commands()]!r}:
    try:
        main([*command.split(), "--help"])
    except SystemExit:
        pass
print("LOADED", {{"numba", "numpy", "scipy", "pycolmap", "matplotlib", "PIL", "tqdm"}} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "LOADED set()"


def spelled_out(word):
    """Return what a word with parts in brackets stands for: a[-b] for a and a-b."""
    before, bracket, rest = word.partition("[")
    part, _, after = rest.partition("]")
    return spelled_out(before + part + after) | spelled_out(before + after) if bracket else {word}


def test_help_names_all_that_there_is(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    text = capsys.readouterr().out
    assert set(RECIPES) <= {name for word in text.split() for name in spelled_out(word.strip(","))}
    assert set(BACKEND_CHOICES) == set(BACKENDS)
    assert SYNTHETIC_SCENES == SCENE_NAMES
    with pytest.raises(SystemExit):
        main(["synthetic", "--help"])
    text = capsys.readouterr().out
    assert all(re.search(rf"^  {name} +[a-z]", text, re.MULTILINE) for name in SCENE_NAMES)


def test_a_shell_completes_commands_and_options(capsys, monkeypatch):
    with pytest.raises(SystemExit, match="0"):
        main(["--completion", "bash"])
    script = capsys.readouterr().out
    complete = "COMP_WORDS=(minisplat-ref {0}); COMP_CWORD={1}; _shtab_minisplat_ref; echo ${{COMPREPLY[@]}}"
    for words, cursor, expected in (("tr", 1, "train"), ("train --downs", 2, "--downscale")):
        done = subprocess.run(
            ["bash", "-c", f"{script}\n{complete.format(words, cursor)}"], capture_output=True, text=True, check=True
        )
        assert done.stdout.split() == [expected]
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["--completion", "zsh"]) == 2
    assert "pip install 'minisplat_ref[completion]'" in capsys.readouterr().err


def test_every_command_module_is_a_command(capsys):
    """And stands under a heading of the help, with a line that says what it does."""
    assert len(commands()) == sum(map(len, GROUPS.values()))
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    listed = [line.split()[0] for line in lines if re.match(r"  [a-z]+ +[a-z]", line)]
    assert listed == commands()
    assert all(f"{title}:" in lines for title in GROUPS)


def test_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "minisplat_ref", "train"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("minisplat-ref: error: give a SCENE")


def test_a_reader_that_has_seen_enough_is_no_error(run_folder):
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "minisplat_ref", "info", str(run_folder)]
    done = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (0, "")


def test_public_names_are_all_there():
    assert set(minisplat_ref.__all__) == set(minisplat_ref._MODULE_OF)
    assert all(getattr(minisplat_ref, name) is not None for name in minisplat_ref.__all__)
    assert minisplat_ref.InputError is InputError
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = minisplat_ref.nothing
