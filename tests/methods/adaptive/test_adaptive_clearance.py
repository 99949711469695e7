"""Veils beside cameras, in front of photographs from the far side alone: a planted case, trained from start to end."""

from functools import partial

import numpy as np
import pytest

from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.metrics import evaluate
from minisplat_ref.reference.pinhole import project_into_image
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.camera_clearance import find_free_balls
from minisplat_ref.strategy.ops import NO_PARENT, Edit, concat
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import At
from minisplat_ref.training.state import apply_edit
from minisplat_ref.types import Gaussians

PLANTED_AT, LAST = 550, 650  # veils are removed in iteration 600
BESIDE = 1.5  # metres: cameras of the near side are nearer to a veil
LOST = 3.0  # dB; with veils, six seeds on processors with and without AVX-512 lose 3.1 to 13.3 in each of the two views
RECOVERED = 0.5  # dB; with veils that are removed, the same are between 0.2 below and 0.1 above those without


@pytest.fixture(scope="module")
def scene():
    """A sphere on a floor, photographed all around; nothing is behind it but black."""
    sizes = {"n_views": 24, "width": 48, "height": 36, "n_points": 400, "test_every": 6}
    return make_scene("noisy-sphere", supersampling=1, **sizes).scene


def are_shown(points, views):
    """Which views [V, P] have the points in their images."""
    return np.array([np.isin(np.arange(len(points)), project_into_image(points, v.camera)[0]) for v in views])


def distances(points, views):
    return np.array([np.linalg.norm(points - v.camera.center, axis=1) for v in views])  # [V, P]


@pytest.fixture(scope="module")
def places(scene):
    """Points beside training cameras that none of the near side shows, but two of the far side and a held-out one."""
    rng, (centers, radii) = np.random.default_rng(0), find_free_balls(scene.train_views, scene.points, 1.0)
    offsets = rng.normal(size=(len(centers), 1000, 3))
    offsets *= rng.uniform(0.15, 0.4, (len(centers), 1000, 1)) / np.linalg.norm(offsets, axis=2, keepdims=True)
    points = (centers[:, None] + radii[:, None, None] * offsets).reshape(-1, 3)
    is_near = distances(points, scene.train_views) < BESIDE
    shown = are_shown(points, scene.train_views)
    in_test = (are_shown(points, scene.test_views) & (distances(points, scene.test_views) < BESIDE)).any(axis=0)
    found = points[~(shown & is_near).any(axis=0) & ((shown & ~is_near).sum(axis=0) >= 2) & in_test]
    assert len(found) > 4
    return found


def plant(state, iteration, *, places):
    """Add opaque Gaussians of the colour of the background, which is right in the photographs from the far side."""
    n, m, rest = len(places), len(state.gaussians.means), state.gaussians.sh_rest.shape[1:]
    fields = {
        "means": places,
        "quats": np.tile([1, 0, 0, 0], (n, 1)),
        "log_scales": np.full((n, 3), np.log(0.06)),
        "opacity_logits": np.full(n, 3.0),
        "sh_dc": np.full((n, 3), -0.5 / SH_C0),
        "sh_rest": np.zeros((n, *rest)),
    }
    veil = Gaussians(**{name: field.astype(np.float32) for name, field in fields.items()})
    parents = np.concatenate([np.arange(m), np.full(n, NO_PARENT)])
    apply_edit(state, Edit(concat(state.gaussians, veil), parents, np.arange(m + n) >= m))


@pytest.fixture(scope="module")
def views_of(scene, places):
    """Return a function that trains, with or without veils, and gives the PSNR of each test view and the notes."""

    def run(clearance, is_planted):
        events = list(ADAPTIVE.events)
        if is_planted:
            events.insert(0, At(PLANTED_AT, partial(plant, places=places)))
        recipe = configure(ADAPTIVE._replace(iterations=LAST, events=tuple(events)), clearance=clearance)
        notes = []
        state = train(
            scene, recipe, seed=0,
            on_step=lambda r: notes.extend(f.note for f in r.fired if f.action == "remove_veils" and r.step == 600),
        )  # fmt: skip
        found = evaluate(state.model, scene.test_views, RenderSettings(scene.background))
        return np.array([view.psnr for view in found.per_view]), notes[0]

    return run


def test_held_out_views_recover_from_veils_beside_cameras(scene, places, views_of):
    """No line of sight comes near these veils: without the rule they stay, with it they go as if none had been."""
    clean, _ = views_of(0.5, False)
    veiled, note_without = views_of(0.0, True)
    cleared, note_with = views_of(0.5, True)
    is_hit = (are_shown(places, scene.test_views) & (distances(places, scene.test_views) < BESIDE)).any(axis=1)
    assert is_hit.sum() >= 2
    assert (veiled[is_hit] < clean[is_hit] - LOST).all()
    assert (cleared[is_hit] > clean[is_hit] - RECOVERED).all()
    assert note_without.endswith(", 0 beside cameras")
    assert int(note_with.split(", ")[1].removesuffix(" beside cameras")) >= len(places)
