"""Speed against error: everyone is judged, the wrong get no time, and the files are there. No time is asserted."""

import json
from importlib.util import find_spec
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from browser import check_page
from minisplat_ref.app.cli import main
from minisplat_ref.bench import benchmark, contenders, interleaving, opensplat, profiling, training_time, workloads
from minisplat_ref.bench.exponentials import EXPONENTIALS, relative_errors
from minisplat_ref.bench.passes import RASTERIZATION
from minisplat_ref.bench.peers import make_peers
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.io.images import read_image
from minisplat_ref.oracle.planted import plant
from minisplat_ref.oracle.thresholds import thresholds_of_view
from minisplat_ref.oracle.tolerances import (
    BENCH_FLOAT32_GRADIENT,
    BENCH_FLOAT32_IMAGE,
    BENCH_FLOAT64,
)
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.training.state import StepReport
from minisplat_ref.types import Gaussians
from tiny_bench import tiny, tiny_workloads, with_pixel  # noqa: F401
from tolerances import BENCH_ROOM_FOR_EXPONENTIAL, ROUNDED_TO_FLOAT32

NAMES = (
    "reference-f64",
    "cpu-f64",
    "cpu-f32",
    "rasterization-f32",
    "cpu-f32-exp3",
    "cpu-f32-3-sigma",
    "textbook-f32",
)
pytestmark = pytest.mark.usefixtures("tiny_workloads")


@pytest.fixture(scope="module")
def cases():
    return {case.name: case for case in benchmark.benchmark(tiny(), contenders.choose(NAMES), repeats=2)}


def test_everyone_is_judged_and_timed(cases):
    assert list(cases) == [f"synth/{name}" for name in NAMES]
    assert all(case.passed for case in cases.values()), cases
    for case in cases.values():
        assert case.figures["turns"] == (1 if case.name == "synth/reference-f64" else 2)
        assert case.figures["forward ms"] > 0 and case.figures["both ms"] > case.figures["least forward ms"]


def test_errors_are_those_of_the_precision(cases):
    assert 0 < cases["synth/cpu-f64"].figures["image max"] < BENCH_FLOAT64
    assert 0 < cases["synth/cpu-f64"].figures["gradient, no flips"] < BENCH_FLOAT64
    for name in ("cpu-f32", "rasterization-f32", "textbook-f32"):
        figures = cases[f"synth/{name}"].figures
        assert 1e-8 < figures["image max, no flips"] < BENCH_FLOAT32_IMAGE
        assert 1e-8 < figures["gradient, no flips"] < BENCH_FLOAT32_GRADIENT
        assert figures["image RMS"] < figures["image max"]
    cubic = cases["synth/cpu-f32-exp3"].figures
    assert cubic["image max, no flips"] > BENCH_FLOAT32_IMAGE
    assert 1e-5 < cubic["gradient, no flips"] < BENCH_FLOAT32_GRADIENT
    assert cases["synth/cpu-f32-3-sigma"].figures["image max"] > 1e-3
    assert cases["synth/cpu-f32-3-sigma"].figures["flips"] is None


def test_ratios_are_of_the_least_times(cases):
    figures, textbook = cases["synth/rasterization-f32"].figures, cases["synth/textbook-f32"].figures
    for ratio, time in (("x textbook", "least both ms"), ("x textbook, forward", "least forward ms")):
        assert textbook[ratio] == 1
        assert figures[ratio] == pytest.approx(textbook[time] / figures[time])
    [reference] = benchmark.benchmark(tiny(), contenders.choose(()), repeats=1)  # and no baseline
    assert reference.figures["x textbook"] is None and reference.figures["x textbook, forward"] is None


@pytest.mark.parametrize("backend", [CPU, plant("half-off-diagonal")], ids=["right", "half-off-diagonal"])
def test_rasterization_is_judged_as_render_is(backend):
    """In float64 its image and gradient are the reference's, activations included, or it gets no time."""
    bounds = BENCH_FLOAT64, BENCH_FLOAT64
    contender = contenders.Contender("rasterization", backend, np.float64, *bounds, passes=RASTERIZATION)
    [_, case] = benchmark.benchmark(tiny(), [*contenders.choose(()), contender], repeats=1)
    assert case.passed == (backend is CPU) and (case.figures["both ms"] is None) == (backend is not CPU)
    assert ("gradient of" in case.note) == (backend is not CPU)


@pytest.mark.parametrize(
    ("backend", "reason"),
    [(plant("half-off-diagonal"), "gradient of"), (with_pixel(1.001), "1 pixels"), (with_pixel(np.nan), "1 pixels")],
    ids=["half-off-diagonal", "pixel", "nan"],
)
def test_a_wrong_backend_gets_no_time(backend, reason):
    wrong = contenders.Contender("wrong", backend, np.float32)
    [_, case] = benchmark.benchmark(tiny(), [*contenders.choose(()), wrong], repeats=2)
    assert not case.passed and reason in case.note
    assert case.figures["turns"] == 0 and case.figures["both ms"] is None


def test_flips_are_explained_and_nothing_else():
    """A hit just below and one just above 1/255: the image differs by a whole hit, exactly where it is allowed to."""
    camera = workloads.synth(1, width=16, height=16, focal=20.0).camera
    base = Gaussians(
        means=np.array([[0.02, 0.01, 2.0], [-0.3, 0.2, 2.5]]),
        quats=np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]]),
        log_scales=np.log(np.full((2, 3), 0.2)),
        opacity_logits=np.zeros(2),
        sh_dc=np.ones((2, 3)),
        sh_rest=np.zeros((2, 0, 3)),
    )
    output, tape = render(base, camera, backend=REFERENCE)
    assert (thresholds_of_view(tape.splats).allowance == 0).mean() > 0.99
    projection = tape.projection
    center = np.array([4.5, 5.5]) - projection.means2d[0]
    a, b, c = projection.conics[0]
    sigma = 0.5 * (a * center[0] ** 2 + c * center[1] ** 2) + b * center[0] * center[1]
    images, allowances = [], []
    for factor in (1 - 1e-5, 1 + 1e-5):
        alpha = factor / 255 * np.exp(sigma)  # opacity that gives alpha = 1/255 at pixel (5, 4)
        logits = np.array([np.log(alpha / (1 - alpha)), 0.0])
        output, tape = render(base._replace(opacity_logits=logits), camera, backend=REFERENCE)
        images.append(output.image)
        allowances.append(thresholds_of_view(tape.splats).allowance)
    changed = np.abs(images[0] - images[1]).max(axis=2)
    assert changed[5, 4] > 1e-3
    for allowance in allowances:
        assert changed[5, 4] <= allowance[5, 4] < 3 * changed[5, 4]
        assert allowance[8, 12] == 0
        assert (changed <= allowance + 1e-6).all()


def test_exponentials_get_better_with_their_degree():
    xs = np.linspace(-6, 0, 601, dtype=np.float32)
    errors = [relative_errors(EXPONENTIALS[degree], xs).max() for degree in (3, 4, 5)]
    assert errors[0] > 10 * errors[1] > 50 * errors[2]
    # Chebyshev's remainder: 2 (ln 2 / 4)^(d + 1) / (d + 1)!
    assert errors[0] == pytest.approx(2 * (np.log(2) / 4) ** 4 / 24, rel=BENCH_ROOM_FOR_EXPONENTIAL)
    assert errors[1] == pytest.approx(2 * (np.log(2) / 4) ** 5 / 120, rel=BENCH_ROOM_FOR_EXPONENTIAL)


def opaque_stack(logit, last_logit):
    """Three opaque Gaussians, one behind the other in the middle of the image, and a faint one behind them."""
    camera = workloads.synth(1, width=16, height=16, focal=20.0).camera
    gaussians = Gaussians(
        means=np.array([[0, 0, 2.0], [0, 0, 2.1], [0, 0, 2.2], [0, 0, 2.5]]),
        quats=np.tile([1.0, 0, 0, 0], (4, 1)),
        log_scales=np.log(np.full((4, 3), 500.0)),  # flat over the image
        opacity_logits=np.array([logit, logit, logit, last_logit]),
        sh_dc=np.ones((4, 3)),
        sh_rest=np.zeros((4, 0, 3)),
    )
    return render(gaussians, camera, backend=REFERENCE)[1].splats


def test_what_lies_behind_the_stop_does_not_count():
    faint = float(np.log(1 / 254))  # opacity 1/255
    assert (thresholds_of_view(opaque_stack(-3.0, faint)).allowance[6:10, 6:10] > 0).all()
    assert not thresholds_of_view(opaque_stack(4.5, faint)).is_near[6:10, 6:10].any()


def test_transmittance_at_the_stop_is_a_threshold():
    opacity = 1 - 1e-4 ** (1 / 3)  # three of them leave the least transmittance
    near, far = (thresholds_of_view(opaque_stack(np.log(o / (1 - o)), -9.0)) for o in (opacity, opacity + 1e-3))
    middle = np.s_[7:9, 7:9]
    assert (near.allowance[middle] > 1e-3).all() and not far.is_near[middle].any()
    farther = opaque_stack(np.log(opacity / (1 - opacity)) + 0.01, -9.0)
    assert thresholds_of_view(farther, slack=0.01).is_near[middle].all()


def test_workloads_are_fixed():
    first = workloads.synth().gaussians
    doubled = workloads.synth5k().gaussians
    assert np.allclose(np.exp(doubled.log_scales), 2 * np.exp(first.log_scales[:5000]), rtol=ROUNDED_TO_FLOAT32)
    assert np.array_equal(doubled.means, first.means[:5000])
    for make, n, size in ((workloads.synth, 50_000, (480, 270)), (workloads.synth5k, 5_000, (240, 135))):
        first, second = make(), make()
        assert len(first.gaussians.means) == n and (first.camera.width, first.camera.height) == size
        for a, b in zip(first.gaussians, second.gaussians, strict=True):
            assert np.array_equal(a, b) and np.array_equal(a, a.astype(np.float32))


def test_garden_is_the_published_workload(shared_data):
    garden = workloads.get_workload("garden", shared_data / "gsplat_garden")
    assert len(garden.gaussians.means) == 101_201
    subset = workloads.get_workload("garden20k", shared_data / "gsplat_garden" / "test_garden.npz")
    assert len(subset.gaussians.means) == 20_000 and subset.name == "garden20k"
    assert np.isin(subset.gaussians.means[:, 0], garden.gaussians.means[:, 0]).all()


@pytest.fixture(scope="module")
def bench_folder(tmp_path_factory):
    """What the command writes of two tiny workloads."""
    folder = tmp_path_factory.mktemp("benches") / "new" / "bench"
    args = ["bench", "--workloads", "synth,synth5k", "--backends", "cpu-f32,textbook-f32", "--repeats", "1"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(workloads.FREE, "synth", tiny)
        patch.setitem(workloads.FREE, "synth5k", lambda: tiny()._replace(name="synth5k"))
        assert main([*args, "--out", str(folder)]) == 0
    return folder


def test_command_writes_json_table_figure_and_page(bench_folder):
    report = json.loads((bench_folder / "bench.json").read_text())
    expected = [f"{w}/{c}" for w in ("synth", "synth5k") for c in ("reference-f64", "cpu-f32", "textbook-f32")]
    assert [case["name"] for case in report["cases"]] == expected
    assert all(case["passed"] and case["both ms"] > 0 for case in report["cases"])
    assert report["settings"]["repeats"] == 1 and report["settings"]["processor"]
    table, page = ((bench_folder / name).read_text() for name in ("bench.md", "report.html"))
    for text in (table, page):
        assert all(name in text for name in expected)
    image = read_image(bench_folder / "bench.png")
    assert image.shape[1] > 800 and len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 20
    assert page.count("<svg") == 4 and "6 of 6" in page


def test_the_page_in_a_browser(bench_folder, browser):
    check_page(browser, bench_folder / "report.html")


def test_command_fails_with_a_wrong_backend(monkeypatch, tmp_path, capsys):
    listed = contenders.all_contenders()
    wrong = {**listed, "cpu-f32": listed["cpu-f32"]._replace(backend=plant("half-off-diagonal"))}
    monkeypatch.setattr(contenders, "all_contenders", lambda: wrong)
    file = tmp_path / "bench.json"
    args = ["bench", "--workloads", "synth", "--backends", "cpu-f32", "--repeats", "1", "--json", str(file)]
    assert main(args) == 1
    case = json.loads(file.read_text())["cases"][-1]
    assert case["name"] == "synth/cpu-f32" and not case["passed"] and case["both ms"] is None
    assert "1 of 2 cases failed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workloads", "nothing"], ["nothing", "synth5k"]),
        (["--workloads", "garden"], ["garden", "--data"]),
        (["--workloads", "garden", "--data", "missing.npz"], ["missing.npz"]),
        (["--backends", "gpu"], ["gpu", "cpu-f32"]),
        (["--against", "brush"], ["brush", "opensplat=PATH"]),
        (["--against", "opensplat=missing"], ["missing", "opensplat=PATH"]),
    ],
)
def test_unknown_names_are_one_line(arguments, words, capsys):
    assert main(["bench", *arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and all(word in lines[0] for word in words), lines


def test_opensplat_needs_photographs(tmp_path, capsys):
    program = _fake_opensplat(tmp_path, "exit 0")
    assert main(["bench", "--against", f"opensplat={program}"]) == 2
    assert "--scene" in capsys.readouterr().err


def test_opensplat_is_timed_by_its_command_line(tmp_path, capsys, monkeypatch):
    from minisplat_ref.datasets.synthetic import make_scene
    from minisplat_ref.datasets.synthetic.files import write_scene

    settings = {"n_views": 4, "width": 32, "height": 24, "n_points": 300}
    write_scene(make_scene("room", **settings), tmp_path / "room", settings)
    log = tmp_path / "calls"
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    (tmp_path / "room" / "transforms.json").write_text("{}")  # it would read this instead of the model
    steps = 'for i in $(seq "$3"); do echo "Step $i: 0.4 [50%]"; done'  # the third argument is -n's value
    readings = (1e-3 * k**2 for k in count())  # of the clock, at each step: 1, 3, 5, ... ms lie between them
    monkeypatch.setattr(opensplat, "time", SimpleNamespace(perf_counter=lambda: next(readings)))
    program = _fake_opensplat(tmp_path, f'echo $(ls $1 $1/sparse/0 $1/images/) $OMP_WAIT_POLICY "$@" >> {log}; {steps}')
    scene = ["--scene", str(tmp_path / "room"), "--iterations", "2"]
    once = ["--workloads", "synth", "--backends", "cpu-f32", "--repeats", "1"]
    assert main(["bench", *once, *scene, "--against", f"opensplat={program}", "--json", str(tmp_path / "b.json")]) == 0
    calls = log.read_text().splitlines()
    assert [call.split(" -n ")[1].split()[:3] for call in calls] == [["7", "-d", "1"]] * 2  # five warm up
    for call in calls:
        assert {"cameras.bin", "images.bin", "points3D.bin", "images", "PASSIVE"} < set(call.split()) and ".png" in call
        assert "transforms.json" not in call
    cases = {case["name"]: case for case in json.loads((tmp_path / "b.json").read_text())["cases"]}
    ours, theirs = cases["room/cpu-f32 training"], cases["room/opensplat training"]
    # Of seven steps each, the last two: 9 and 11 ms, and from the seventh reading on 23 and 25.
    assert theirs["iteration ms"] == pytest.approx(17) and theirs["least ms"] == pytest.approx(9)
    assert theirs["x ours"] == pytest.approx(theirs["iteration ms"] / ours["iteration ms"])
    assert "not compared here" in theirs["note"] and "of 4 iterations, " in theirs["note"]
    assert ours["note"].endswith("Gaussians, 32 x 24")
    broken = _fake_opensplat(tmp_path, "echo no such scene >&2; echo usage >&2; exit 3")
    assert main(["bench", *once, *scene, "--against", f"opensplat={broken}"]) == 2
    assert "no such scene" in capsys.readouterr().err
    silent = _fake_opensplat(tmp_path, "echo Done")
    assert main(["bench", *once, *scene, "--against", f"opensplat={silent}"]) == 2
    assert "0 lines for 7 iterations" in capsys.readouterr().err


@pytest.mark.skipif(not (find_spec("torch") and find_spec("gsplat")), reason="needs torch and gsplat, the extra peers")
def test_gsplat_is_a_contender():
    [gsplat], program = make_peers(["gsplat-torch"])
    [_, case] = benchmark.benchmark(tiny(), [*contenders.choose(()), gsplat], repeats=1)
    assert program is None and case.passed, case
    assert case.name == "synth/gsplat-torch" and case.figures["both ms"] > 0


def test_stages_add_up_to_the_iteration(tmp_path, monkeypatch):
    monkeypatch.setattr(training_time, "ROOM", {"n_views": 2, "width": 48, "height": 36, "n_points": 500})
    file = tmp_path / "stages.json"
    args = ["bench", "--stages", "--iterations", "2", "--json", str(file)]
    assert main(args) == 0
    cases = {case["name"]: case for case in json.loads(file.read_text())["cases"]}
    stages = [case for name, case in cases.items() if name.startswith("iteration/") and "whole" not in name]
    assert {"project", "composite", "composite_vjp", "photometric_loss", "adam_update", "rest"} <= {
        case["name"].split("/")[1] for case in stages
    }
    assert sum(case["share %"] for case in stages) == pytest.approx(100)
    assert all(case["ms"] > 0 for case in stages)


def test_recipes_are_timed_beside_the_baseline(tmp_path, monkeypatch):
    """Processor time by hand: 2 and 3 s for an iteration of ``3dgs-accel``, 5 and 7 for one of ``surfels``."""
    clock, trained = [0.0], []
    seconds = {"3dgs-accel": iter([2, 3, 2, 3]), "surfels": iter([7, 5, 7, 7])}

    def fake_train(scene, recipe, *, seed, backend, on_step):
        trained.append(recipe)
        for step in range(1, recipe.iterations + 1):
            clock[0] += 90 if step <= training_time.WARM_UP else next(seconds[recipe.name])
            report = StepReport(step, 0.5, scene.train_views[0], None, len(scene.points), 0, None)
            on_step(report)

    monkeypatch.setattr(training_time, "DENSE_ROOM", {"n_views": 2, "width": 48, "height": 36, "n_points": 70})
    monkeypatch.setattr(training_time, "train", fake_train)
    monkeypatch.setattr(training_time.time, "process_time", lambda: clock[0])
    file = tmp_path / "recipes.json"
    assert main(["bench", "--recipes", "surfels,surfels", "--iterations", "2", "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    cases = {case["name"]: case for case in report["cases"]}
    assert list(cases) == ["room/3dgs-accel", "room/surfels"] and report["settings"]["iterations"] == 2
    assert [cases[name]["least ms"] for name in cases] == [2000, 5000]
    assert [cases[name]["iteration ms"] for name in cases] == [2500, 7000]
    assert [cases[name]["x 3dgs-accel"] for name in cases] == [1, 2.5]
    assert [cases[name]["primitives"] for name in cases] == [70, 70]
    assert [recipe.name for recipe in trained] == 2 * ["3dgs-accel", "surfels"]
    assert all(
        not recipe.events and all(term.is_due(1) or not term.weight for term in recipe.losses) for recipe in trained
    )


def test_unknown_recipes_are_not_timed(capsys):
    assert main(["bench", "--recipes", "surfelz"]) == 2
    assert "surfelz" in capsys.readouterr().err


def test_tasks_alternate_in_every_round(monkeypatch):
    clock, runs = [0.0], []

    def task(name, *seconds):
        def run():
            runs.append(name)
            clock[0] += seconds[runs.count(name) - 1]

        return run

    monkeypatch.setattr(interleaving.time, "perf_counter", lambda: clock[0])
    groups = [[task("a", 9, 1, 5, 2, 1), task("b", 9, 3, 3, 3, 3)], [task("c", 9, 4, 4, 4, 4)]]
    [a, b], [c] = interleaving.time_interleaved(groups, rounds=2, repeats=2)
    assert "".join(runs) == "abc" + "ababcc" * 2
    assert (a, b, c) == ((1, 1.5), (3, 3), (4, 4))  # without the first turn, which compiles


def test_stopwatches_change_nothing():
    seconds = {}
    backend = profiling.time_stages(CPU, seconds)
    workload = tiny()
    plain, _ = render(workload.gaussians, workload.camera, conventions=GSPLAT_MAIN)
    watched, _ = render(workload.gaussians, workload.camera, conventions=GSPLAT_MAIN, backend=backend)
    assert np.array_equal(plain.image, watched.image)
    assert list(seconds) == ["project", "sh_colors", "bin_gaussians", "composite"]


def _fake_opensplat(folder, script):
    program = folder / "opensplat"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return program
