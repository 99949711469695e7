"""The true surface of synthetic scenes, and the Chamfer distance of Gaussians from it, in closed form."""

import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic import surface as surface_module
from minisplat_ref.datasets.synthetic.files import load_depths, write_scene
from minisplat_ref.datasets.synthetic.surface import (
    chamfer,
    nearest_surface,
    surface_distance,
    true_surface,
    unproject_views,
)
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, SYNTHETIC_FLOAT32

SCENE = {"n_views": 4, "width": 32, "height": 24, "n_points": 60, "test_every": 3}
SPACING = 0.25
GRID = SPACING * np.stack(np.meshgrid(*[np.arange(6.0)] * 2), axis=-1).reshape(-1, 2)  # [36, 2]


@pytest.fixture(scope="module")
def synthetic():
    return make_scene("outdoor", supersampling=1, **SCENE)


@pytest.fixture
def folder(synthetic, tmp_path):
    write_scene(synthetic, tmp_path / "scene", SCENE)
    return tmp_path / "scene"


def plane(height):
    return np.column_stack([GRID, np.full(len(GRID), height)])


def test_two_planes():
    """Nearest is the point above: the distance of the planes, there and back."""
    assert chamfer(plane(0.1), cKDTree(plane(0.0))) == pytest.approx(0.2, rel=CLOSED_FORM)


def test_shifted_grid():
    """Half a spacing to the neighbour, there and back."""
    shifted = plane(0.0) + np.array([SPACING / 2, 0, 0])
    assert chamfer(shifted, cKDTree(plane(0.0))) == pytest.approx(SPACING, rel=CLOSED_FORM)


def test_half_a_grid_is_near_the_whole_one_and_not_the_other_way():
    """Every second column: on the grid, but half of the grid's points are a spacing away."""
    columns = plane(0.0)[np.round(GRID[:, 0] / SPACING) % 2 == 0]
    assert chamfer(columns, cKDTree(plane(0.0))) == pytest.approx(SPACING / 2, rel=CLOSED_FORM)


def test_what_counts_of_the_gaussians(rng):
    """Units are extents; what is hardly opaque or far away does not count; nothing left is None."""
    surface = nearest_surface(plane(0.0), [make_camera(8, 8)._replace(cam_from_world_t=np.zeros(3))], extent=2.0)
    means = np.concatenate([plane(0.1), [[0.0, 0, 1.5]], [[0.0, 0, 6.1]]])
    logits = np.full(len(means), 1.0)
    logits[-2] = np.log(0.099 / 0.901)
    gaussians = make_gaussians(rng, len(means))._replace(means=means, opacity_logits=logits)
    assert surface_distance(gaussians, surface) == pytest.approx(0.2 / 2.0, rel=CLOSED_FORM)
    logits[-2] = np.log(0.101 / 0.899)
    assert surface_distance(gaussians, surface) > 0.2 / 2.0 + 0.01
    assert surface_distance(gaussians._replace(opacity_logits=np.full(len(means), -3.0)), surface) is None


def test_truth_is_bounded_and_repeats(monkeypatch):
    monkeypatch.setattr(surface_module, "POINTS_MAX", 10)
    one, other = (nearest_surface(plane(0.0), [make_camera(8, 8)], extent=9.0).cloud.data for _ in range(2))
    assert len(np.unique(one, axis=0)) == 10 and np.array_equal(one, other)
    assert nearest_surface(plane(0.0) + 100, [make_camera(8, 8)], extent=9.0) is None


def test_true_surface_is_what_the_training_views_show(synthetic, folder):
    cameras = [view.camera for view in synthetic.scene.train_views]
    shown = unproject_views(cameras, list(synthetic.train_depths))
    assert 0 < len(shown) == np.count_nonzero(synthetic.train_depths) < synthetic.train_depths.size  # there is sky
    scene = load_scene(folder, test_every=3)
    distances = np.linalg.norm(shown - np.mean([camera.center for camera in cameras], axis=0), axis=1)
    surface = true_surface(folder, scene)
    assert len(surface.cloud.data) == np.count_nonzero(distances <= 3 * scene.extent) < len(shown)  # a wide meadow
    assert cKDTree(shown).query(surface.cloud.data)[0].max() < 10 * SYNTHETIC_FLOAT32 * np.abs(surface.cloud.data).max()


def test_smaller_photographs_have_the_same_surface(folder):
    whole, half = (true_surface(folder, load_scene(folder, test_every=3, downscale=d)) for d in (1, 2))
    assert_allclose(half.cloud.data, whole.cloud.data, rtol=CLOSED_FORM, atol=CLOSED_FORM)


def test_only_what_synthetic_has_written_is_the_truth(folder):
    scene = load_scene(folder, test_every=3)
    names = [view.name for view in scene.train_views]
    assert len(load_depths(folder, names)) == len(names)
    assert load_depths(folder / "scene_info.json", names) is None
    info = (folder / "scene_info.json").read_text()
    (folder / "scene_info.json").write_text(info.replace("metres", "feet"))
    assert true_surface(folder, scene) is None
    (folder / "scene_info.json").write_text("[]")
    assert true_surface(folder, scene) is None
    (folder / "scene_info.json").write_text(info)
    (folder / "depths" / f"{names[0]}.npy").unlink()
    assert true_surface(folder, scene) is None
    shutil.rmtree(folder / "depths")
    assert true_surface(folder, scene) is None


def test_damaged_depth(folder):
    scene = load_scene(folder, test_every=3)
    path = folder / "depths" / f"{scene.train_views[1].name}.npy"
    for damage in (lambda: path.write_bytes(path.read_bytes()[:200]), lambda: np.save(path, np.zeros(3, np.float32))):
        damage()
        with pytest.raises(InputError, match=str(path)):
            true_surface(folder, scene)
