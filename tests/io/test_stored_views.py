"""Photographs that memory cannot hold: the same results as with all in memory, whose bounds are kept."""

import shutil
import signal
import threading
import time
import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from minisplat_ref import memory
from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison.crops import choose_crops
from minisplat_ref.app.runs import fingerprint, memory_needs, run_folder
from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene, write_image
from minisplat_ref.io import scene as scene_io
from minisplat_ref.io.scene import half_size, rescale_camera
from minisplat_ref.io.stored_views import Photograph, Pixels, ReadingAhead, Shelf, StoredView, make_room
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import SPLATTING, RenderSettings, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import LossTerm
from minisplat_ref.training.schedule import SmallerViews
from minisplat_ref.types import View, some_of, view_from
from photo_scenes import DISTORTED, HEIGHT, WIDTH, colored_image, write_colmap, write_transforms
from run_commands import OPTIONS, SCENE, contents, interrupt_at, photograph, read_json, refused  # noqa: F401  (a fixture)
from tiny_training import assert_same_bytes

PHOTO_BYTES = 3 * SCENE["width"] * SCENE["height"]
N_PHOTOS = 8
FREE = 1e9


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **SCENE), folder, SCENE)
    return folder


@pytest.fixture
def scene(original, tmp_path):
    return shutil.copytree(original, tmp_path / "nook")


@pytest.fixture(scope="module")
def whole(original, tmp_path_factory):
    """What a training ends with that nothing disturbs, all photographs in memory."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    assert main(["train", str(original), *OPTIONS, "--out", str(folder)]) == 0
    return result(folder)


def keep_few(monkeypatch, n_photographs=2.5):
    """Let so many photographs of the scene stay in memory."""
    monkeypatch.setattr(memory, "free_bytes", lambda: FREE)
    monkeypatch.setattr(memory, "SHELF_SHARE", n_photographs * PHOTO_BYTES / FREE)


@pytest.fixture
def few(monkeypatch):
    keep_few(monkeypatch)


@pytest.fixture
def alive(monkeypatch):
    """How many photographs have been in memory at once, and which thread read each."""
    seen = {"now": 0, "most": 0, "threads": []}
    read = scene_io.read_image

    def counted(path):
        image = read(path)
        seen["now"] += 1
        seen["most"] = max(seen["most"], seen["now"])
        seen["threads"].append(threading.current_thread().name)
        weakref.finalize(image, lambda: seen.update(now=seen["now"] - 1))
        return image

    monkeypatch.setattr(scene_io, "read_image", counted)
    return seen


def readers():
    return [thread for thread in threading.enumerate() if thread.name.startswith("photographs")]


def result(folder):
    """What a training leaves, without times."""
    files = contents(folder)
    return {name: files[name] for name in files if name == run_folder.POINT_CLOUD or name.endswith(".png")}, {
        key: value
        for key, value in read_json(folder / run_folder.METRICS).items()
        if key in ("psnr", "ssim", "per_view")
    }


# what is read


def write_masked(folder):
    write_colmap(folder)
    (folder / "masks").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = True
    write_image(folder / "masks" / "0000.png", mask)
    write_image(
        folder / "images" / "0001.png", np.dstack([colored_image(1), mask.T.repeat(2, 1)[:HEIGHT, :WIDTH] * 255])
    )


SCENES = {
    "masks and alpha": (write_masked, {}),
    "downscaled": (write_masked, {"downscale": 3}),
    "undistorted": (partial(write_colmap, model="OPENCV", params=DISTORTED), {"undistort": True, "downscale": 2}),
    "composited": (
        partial(write_transforms, camera_angle_x=0.7, listed=""),
        {"background": (1, 0.5, 0), "test_every": 2},
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_views_are_those_that_memory_would_hold(name, tmp_path, monkeypatch):
    keep_few(monkeypatch, 0.1)
    write, options = SCENES[name]
    write(tmp_path)
    if name == "composited":
        half_seen = np.dstack([colored_image(2), np.full((HEIGHT, WIDTH), 100, np.uint8)])
        write_image(tmp_path / "images" / "0002.png", half_seen)
    stored = load_scene(tmp_path, **options)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "free_bytes", lambda: float("inf"))
        held = load_scene(tmp_path, **options)
    for views, others in ((stored.train_views, held.train_views), (stored.test_views, held.test_views)):
        assert len(views) == len(others)
        for view, other in zip(views, others, strict=True):
            assert type(view) is StoredView and type(other) is View
            for a, b in ((view, other), (half_size(view), half_size(other)), (view._replace(name="x"), other)):
                np.testing.assert_array_equal(a.image, b.image)
                np.testing.assert_array_equal(a.mask, b.mask)
                assert [a.load().image is a.load().mask, a.camera[2:8]] == [False, b.camera[2:8]]
                assert (view.view_id, view.time) == (other.view_id, other.time)
            assert np.array_equal(view.camera.cam_from_world_R, other.camera.cam_from_world_R)
            assert type(half_size(view)) is StoredView and type(view.load()) is View
    assert fingerprint.take_fingerprint(stored) == fingerprint.take_fingerprint(held)


def test_another_image_replaces_the_stored_one(scene, few):
    view = load_scene(scene).train_views[0]
    black = np.zeros_like(view.image)
    changed = view._replace(image=black)
    assert type(changed) is View and changed.image is black and changed.mask is None


def test_of_two_threads_one_reads(few):
    started, n_read = threading.Barrier(2), []

    def read():
        n_read.append(1)
        time.sleep(0.05)  # long enough for the other thread to ask meanwhile
        return Pixels(np.zeros((2, 2, 3), np.uint8), None)

    stored = Photograph(read, 4, Shelf(12))
    threads = [threading.Thread(target=lambda: (started.wait(), stored.pixels())) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(n_read) == 1 and stored.shelf.n_free == 0


# what a training makes of it


def test_training_ends_with_the_same_bytes(original, tmp_path, alive, monkeypatch, capsys):
    """Mini-Splatting2 takes colours from photographs, too."""
    options = ["--recipe", "mini-splatting2", "--iterations", "60", "--test-every", "4", "--eval-every", "25"]
    assert main(["train", str(original), *options, "--out", str(tmp_path / "held")]) == 0
    assert "read from disk" not in capsys.readouterr().out and len(alive["threads"]) == N_PHOTOS
    keep_few(monkeypatch)
    alive.update(now=0, most=0, threads=[])
    assert main(["train", str(original), *options, "--out", str(tmp_path / "stored")]) == 0
    assert "photographs are read from disk again and again" in capsys.readouterr().out
    assert result(tmp_path / "stored") == result(tmp_path / "held")
    # Two stay; one is shown, one is read for the next iteration, and meanwhile a test view is measured, the next read.
    assert alive["most"] <= 2 + 2 + 2
    assert len(alive["threads"]) > 60 / 2


def test_half_size_views_give_the_same_bytes(original, monkeypatch):
    recipe = get_recipe("3dgs-accel", 20)._replace(events=(SmallerViews(lambda scene: 1, until=10),))
    held = train(load_scene(original), recipe, seed=0)
    keep_few(monkeypatch)
    stored = train(load_scene(original), recipe, seed=0)
    assert_same_bytes(stored, held)


def test_the_next_photograph_is_read_in_a_thread(scene, alive, monkeypatch):
    keep_few(monkeypatch, 0)
    n_views, n_rounds = 6, 5
    loaded = load_scene(scene, test_every=4)
    train(loaded, get_recipe("3dgs-accel", n_views * n_rounds), seed=0)
    assert len(loaded.train_views) == n_views
    in_thread = [name.startswith("photographs") for name in alive["threads"]]
    # What a round begins with is not known before.
    assert in_thread.count(False) == n_rounds and len(in_thread) == n_views * n_rounds
    assert readers() == []


def test_small_scenes_have_no_thread(original):
    loaded, seen = load_scene(original), []
    train(loaded, get_recipe("3dgs-accel", 5), seed=0, on_step=lambda report: seen.extend(readers()))
    assert seen == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
@pytest.mark.parametrize("place", ["loss", "callback"])
def test_the_thread_ends_with_the_training(scene, few, error, place):
    recipe, calls = get_recipe("3dgs-accel", 30), []

    def fail(*_):
        calls.append(readers())
        if len(calls) == 4:
            raise error
        return 0.0, scene_io  # never looked at: the fourth call comes first

    if place == "loss":
        photometric = recipe.losses[0].function
        term = LossTerm("failing", lambda rendered: (fail(), photometric(rendered))[1], 1.0)
        recipe = recipe._replace(losses=(term,))
    state = initial_state(load_scene(scene), recipe, 0)
    with pytest.raises(error):
        on_step = fail if place == "callback" else None
        train(load_scene(scene), recipe, seed=0, state=state, on_step=on_step)
    assert any(calls) and readers() == []


def test_ctrl_c_ends_the_thread_and_the_run_goes_on(scene, whole, tmp_path, few, monkeypatch):
    interrupt_at(12, monkeypatch, signal.SIGINT)
    assert main(["train", str(scene), *OPTIONS, "--out", str(tmp_path / "run")]) == 130
    assert readers() == []
    assert main(["train", "--resume", str(tmp_path / "run")]) == 0
    assert result(tmp_path / "run") == whole


# evaluation


def test_evaluations_hold_no_more_than_they_show(scene, alive, monkeypatch):
    keep_few(monkeypatch, 0)
    loaded = load_scene(scene, test_every=0)
    loaded = loaded._replace(test_views=loaded.train_views)
    model = initial_state(loaded, get_recipe("3dgs-accel"), 0).model
    assert alive["threads"] == []
    assert fingerprint.take_fingerprint(loaded) == fingerprint.take_fingerprint(loaded)
    assert len(alive["threads"]) == N_PHOTOS  # not twice
    evaluate(model, loaded.test_views, RenderSettings(loaded.background))
    assert len(alive["threads"]) == 2 * N_PHOTOS
    choose_crops([Trained(model, SPLATTING, loaded.background, GSPLAT_MAIN.name, "cpu")], loaded)
    assert len(alive["threads"]) == 3 * N_PHOTOS
    assert alive["most"] <= 2  # the one that is shown, until the next has been read


# photographs that go wrong


def hide_at(step, path, monkeypatch, change):
    from minisplat_ref.app.runs.progress import Progress

    report_step = Progress.__call__

    def hide(progress, report):
        report_step(progress, report)
        if report.step == step:
            change(path)

    monkeypatch.setattr(Progress, "__call__", hide)


def remove(path):
    path.rename(path.with_suffix(".away"))


def overwrite(path):
    shutil.copyfile(path, path.with_suffix(".away"))
    shutil.copystat(path, path.with_suffix(".away"))
    path.write_bytes(path.read_bytes()[:-200])


@pytest.mark.parametrize(
    ("change", "text"), [(remove, "no such image"), (overwrite, "has changed since its scene was")]
)
def test_a_photograph_that_is_lost_in_training_is_named(scene, whole, tmp_path, refused, change, text):
    path, out = photograph(scene, "view_0003"), tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        keep_few(patch, 0)
        hide_at(7, path, patch, change)
        line = refused("train", scene, *OPTIONS, "--out", out)
    assert f"{path}: {text}" in line and "leave them as they are" in line
    assert f"; to continue: minisplat-ref train --resume {out}" in line and readers() == []
    path.with_suffix(".away").replace(path)
    assert main(["train", "--resume", str(out)]) == 0
    assert result(out) == whole


def test_a_damaged_photograph_is_found_before_training(scene, tmp_path, few, refused):
    path = photograph(scene, "view_0005")
    path.write_bytes(path.read_bytes()[:-200])
    line = refused("train", scene, *OPTIONS, "--out", tmp_path / "run")
    assert f"{path}: cannot be decoded" in line and not (tmp_path / "run").exists()


def test_a_missing_photograph_is_found_while_loading(scene, few):
    path = photograph(scene, "view_0005")
    path.unlink()
    with pytest.raises(InputError, match=r"view_0005\.png: missing"):
        load_scene(scene)


def test_sizes_are_checked_while_loading(scene, few):
    write_image(photograph(scene, "view_0005"), np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(InputError, match=r"view_0005\.png: the image is 6x5 but its camera is"):
        load_scene(scene)


# room


def stored_views(n, shelf):
    read = partial(Pixels, np.zeros((10, 10, 3), np.uint8), None)
    return [StoredView(f"{i}", None, Photograph(read, 100, shelf), None) for i in range(n)]


def test_photographs_give_way(monkeypatch):
    """1000 bytes are free: half of them for photographs of 300, unless something else needs more."""
    shelf = Shelf(700)
    views = stored_views(3, shelf)
    for view in views:
        view.load()
    assert shelf.n_bytes == 600
    monkeypatch.setattr(memory, "free_bytes", lambda: 1000.0 - shelf.n_bytes)
    assert make_room(views, 0.0) == 200 and shelf.n_bytes == 300
    assert make_room([half_size_of(views[2])], 650.0) == 50 and shelf.n_bytes == 300
    assert make_room(views, 900.0) == 100 and shelf.n_bytes == 0
    assert make_room(views, 2000.0) == 0
    assert make_room([view.load() for view in views], 0.0) == 0
    views[0].load()
    assert shelf.n_bytes == 0
    make_room(views, 0.0)
    assert half_size_of(views[0]).image.shape == (5, 5, 3) and shelf.n_bytes == 300


def half_size_of(view):
    return view.change(lambda pixels: Pixels(pixels.image[::2, ::2], None))


def test_growing_gaussians_take_the_room_of_photographs(scene, monkeypatch):
    keep_few(monkeypatch, N_PHOTOS - 1)
    recipe = get_recipe("3dgs-accel", 240)
    loaded = load_scene(scene)
    shelf, kept = loaded.train_views[0].photograph.shelf, []
    first = next(step for step in range(1, 240) if any(event.is_due(step) for event in recipe.events[1:]))
    state = train(loaded, recipe._replace(iterations=first - 1), seed=0)
    assert shelf.n_bytes > 0
    n_bytes = sum(field.nbytes for field in state.gaussians)
    monkeypatch.setattr(memory, "free_bytes", lambda: 6.0 * n_bytes)
    train(loaded, recipe._replace(iterations=first), seed=0, state=state, on_step=lambda _: kept.append(shelf.n_bytes))
    assert kept[-1] == 0


def test_what_is_foreseen(original, few):
    loaded = load_scene(original, test_every=4)
    state = initial_state(loaded, get_recipe("3dgs-accel"), 0)
    needs = memory_needs.foresee(loaded, state, GSPLAT_MAIN, CPU)
    assert (needs.n_rows, needs.n_pixels) == (len(state.gaussians.means), PHOTO_BYTES / 3)
    assert needs.kept_bytes == pytest.approx(2.5 * PHOTO_BYTES)
    assert needs.reading_bytes == (2 * 3 + 10) * PHOTO_BYTES / 3
    text = memory.check_start(needs)
    assert memory.as_text(needs.at_the_peak) in text and text.endswith("read from disk again and again")


@pytest.mark.parametrize("enlarged", [2, 20])
def test_pairs_are_foreseen(enlarged):
    """Few tiles a Gaussian and many; a sample of a third stands for all of them."""
    made = make_scene("room", n_views=2, width=80, height=60, n_points=3 * 400, supersampling=1).scene
    cameras = [rescale_camera(view.camera, 80 * enlarged, 60 * enlarged) for view in made.train_views]
    made = made._replace(train_views=tuple(map(view_from, cameras)))
    state = initial_state(made, get_recipe("3dgs-accel"), 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory_needs, "N_SAMPLED", 400)
        foreseen = memory_needs.foresee(made, state, GSPLAT_MAIN, CPU).n_pairs
    request = Request(made.background)
    n_pairs = max(SPLATTING.render(state.model, view, request)[0].n_pairs for view in made.train_views)
    # The mean over all places of the tiles is 0.05 to 0.12 above what scenes at hand have; a sample adds its chance.
    assert foreseen == pytest.approx(n_pairs, rel=0.2)
    few = state.gaussians._make(field[:0] for field in state.gaussians)
    assert memory_needs.foresee(made, replace(state, gaussians=few), GSPLAT_MAIN, CPU).n_pairs == 0


def test_a_context_that_reads_ahead_forgets_what_is_not_needed(few):
    views = stored_views(3, Shelf(0))
    with ReadingAhead() as ahead:
        first = ahead.load(views[0], views[1])
        third = ahead.load(views[2], None)  # the second was expected
        assert first.name == "0" and third.name == "2" and type(third) is View
    assert readers() == []


@pytest.mark.parametrize(
    ("n", "chosen"), [(1, [0]), (2, [0, 6]), (3, [0, 3, 6]), (4, [0, 2, 4, 6]), (9, list(range(7)))]
)
def test_some_of_seven(n, chosen):
    assert some_of(range(7), n) == chosen
    assert some_of([], n) == []
