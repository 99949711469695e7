"""CUS-GS: the teacher and counts of floats by hand, the tables, and small runs of both claims."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims.cus import floats as claim
from data_tools.claims.cus import growth as growth_claim
from data_tools.claims.kit.objects import object_ids
from measured_claims import measured
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.cus.memory import feature_map
from minisplat_ref.extensions.cus.model import as_anchors
from minisplat_ref.extensions.cus.recipe import grow_anchors, read_memory
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import does
from minisplat_ref.types import Model
from scenes import make_gaussians

SMALL = {"children": 2, "latent": 3, "hidden": 4, "embedding": 2, "query": 3}


@pytest.fixture(scope="module")
def made():
    return make_scene("room", n_views=6, width=48, height=40, supersampling=1, n_points=60)


@pytest.fixture(scope="module")
def scene(made):
    return made.scene


def test_the_teacher_s_features_are_read_as_their_labels(scene, rng):
    """Where one of an object's two pixels is taken for another's, one of three pixels that have either label agrees."""
    directions = claim.make_teacher(rng).directions
    labels = np.array([[0, 1, 2, 3, 4], [0, 1, 2, 3, 4]])
    view = scene.test_views[0]
    task = claim.Task(scene._replace(test_views=(view,)), "", [directions[labels]], [labels], 3 * directions)
    right = claim.quality(task, lambda view: directions[labels])
    assert right["iou"] == 1 and abs(right["error"]) < 1e-5
    half = claim.quality(task, lambda view: directions[[[0, 1, 2, 3, 4], [0, 2, 3, 4, 1]]])
    assert half["iou"] == pytest.approx(1 / 3) and half["error"] > 0.1


def test_the_claim_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(claim, "LATENTS", (2, 3))
    monkeypatch.setattr(claim, "QUERIES", (1, 3))
    monkeypatch.setattr(claim, "CUS", configure(find_recipe("cus"), **{**SMALL, "features": ""}))
    small_room = partial(make_scene, n_views=6, width=48, height=40, supersampling=1, n_points=60)
    monkeypatch.setattr(claim, "make_scene", lambda name, **size: small_room(name))
    monkeypatch.setattr(claim, "ANCHORS", configure(find_recipe("cus"), **SMALL).representation)
    words = ["cus/floats", "--iterations", "5", "--seeds", "1", "--out", str(tmp_path / "s")]
    records = measured(words)["records"]
    names = ["anchors, latent 2", "anchors, latent 3", "own queries, 1", "own queries, 3", "adaptive"]
    assert [r["arm"] for r in records] == names
    n = records[0]["gaussians"] // 2
    assert records[2]["floats"] == 2 * n and records[3]["floats"] == 6 * n
    assert records[1]["floats"] == 3 * n + (3 + 3 + 2) * 4 + 4 + 4 * 3 + 3 + 6 * 3 + 3
    assert records[4]["all_floats"] == 59 * records[4]["gaussians"]
    assert all(np.isfinite(r["error"]) and 0 <= r["iou"] <= 1 for r in records[:4])
    assert records[1]["all_floats"] - records[0]["all_floats"] == n + 4 * 4  # four networks read one number more
    assert "| adaptive " in capsys.readouterr().out


def test_the_claim_of_growing_runs(tmp_path, monkeypatch, capsys):
    """The threshold is so low that all grows, every ten iterations, the points so few that nothing takes long."""
    recipe = configure(find_recipe("cus"), **SMALL)
    events = tuple(e._replace(min_gap=10) if does(e, grow_anchors) else e for e in recipe.events)
    monkeypatch.setattr(growth_claim, "POINTS", (90, 40))
    monkeypatch.setattr(growth_claim, "THRESHOLD", 1e-6)
    monkeypatch.setattr(growth_claim, "SIZE", {"n_views": 6, "width": 48, "height": 40, "supersampling": 1})
    monkeypatch.setattr(claim, "CUS", recipe._replace(events=events))
    monkeypatch.setattr(claim, "ANCHORS", recipe.representation)
    monkeypatch.setattr(growth_claim, "LATENT", SMALL["latent"])
    records = measured(["cus/growth", "--iterations", "24", "--seeds", "1", "--out", str(tmp_path / "s")])["records"]
    assert [r["arm"] for r in records] == [
        "90 points, without growing",
        "90 points, with growing",
        "90 points, smaller voxels",
        "40 points, without growing",
        "40 points, with growing",
    ]
    anchors = [r["anchors"] for r in records]
    assert anchors[0] < anchors[1] and anchors[0] < anchors[2] and anchors[3] < anchors[4]
    per_anchor = 3 + 3 + 3 + 3 + 6  # centre, scale, colour, latent, offsets
    assert records[1]["all_floats"] - records[0]["all_floats"] == per_anchor * (anchors[1] - anchors[0])
    assert "| 40 points, with growing " in capsys.readouterr().out


def test_the_table_of_growing_by_hand():
    def record(arm, anchors, psnr, error):
        return {"arm": arm, "anchors": anchors, "all_floats": 10 * anchors, "psnr": psnr, "error": error, "iou": 0.5}

    names = ("2,000 points, without growing", "2,000 points, with growing")
    records = [record(names[0], 100, 20, 0.1), record(names[1], 180, 21, 0.2)]
    records += [record(names[0], 120, 22, 0.3), record(names[1], 240, 21, 0.4)]
    text = growth_claim.report(records, {}, "heading").text
    header = "| arm | anchors | floats in all | PSNR dB | error of features | mean IoU |"
    assert header in [" ".join(line.split()) for line in text.splitlines()]
    rows = [" ".join(line.split()) for line in text.splitlines() if line.startswith("| 2,000")]
    assert rows[0].startswith(f"| {names[0]} | 110 | 1,100 | 21.00 ± 1.41 | 0.2000 ± 0.1414 | 0.500 ")
    assert rows[1].startswith(f"| {names[1]} | 210 | 2,100 | 21.00 ± 0.00 | 0.3000 ± 0.1414 | 0.500 ")


def test_the_teacher_by_hand(made, rng):
    """A label's direction, and 0.3 times the projected texture."""
    teacher, view = claim.make_teacher(rng), made.scene.train_views[0]
    labels = object_ids(made.train_ids[0])
    texture = feature_map(view, "")[5, 7] @ teacher.texture
    expected = teacher.directions[labels[5, 7]] + 0.3 * texture
    assert_allclose(teacher.features(view, labels)[5, 7], expected, rtol=1e-5)
    assert_allclose(np.linalg.norm(teacher.directions, axis=1), 1)


def test_prototypes_are_means_over_the_training_views(made, tmp_path):
    task = claim.make_task(made, 0, tmp_path)
    stored = np.stack([np.load(tmp_path / f"{view.name}.npy") for view in made.scene.train_views])
    labels = np.stack([object_ids(ids) for ids in made.train_ids])
    label = labels[0, 0, 0]
    assert_allclose(task.prototypes[label], stored[labels == label].mean(axis=0), rtol=1e-4)
    assert len(task.targets) == len(task.labels) == len(made.scene.test_views)


def test_floats_by_hand(rng):
    """Two anchors of two Gaussians: centre, scale and colour, three numbers of latent and six of offsets, each."""
    g = as_anchors(make_gaussians(rng, 2, sh_degree=0), rng, voxel=1e-3, children=2, latent=3)
    shared = {"query_weights_0": np.zeros((4, 5)), "query_mix_biases_0": np.zeros(7), "memory": np.zeros((2, 2))}
    assert claim.counts(Model(g, shared)) == {"gaussians": 4, "all_floats": 2 * (9 + 3 + 6) + 20 + 7 + 4}
    assert claim.feature_floats(Model(g, shared)) == 2 * 3 + 20 + 7
    assert claim.counts(Model(make_gaussians(rng, 2, sh_degree=0))) == {"gaussians": 2, "all_floats": 28}


def test_the_error_of_features_is_the_mean_over_views(made):
    """A feature of length 1 that is found as zero has an error of 1/32, and a cosine of 0."""
    scene = made.scene
    labels = np.zeros((2, 3), np.int64)
    target = np.zeros((2, 3, claim.DIMENSION), np.float32)
    target[..., 0] = 1
    views = (scene.test_views[0], scene.train_views[0])
    task = claim.Task(scene._replace(test_views=views), "", [target, target], [labels, labels], np.eye(5, 32))
    zero = np.zeros_like(target)
    found = claim.quality(task, lambda view: zero if view is views[0] else target)
    assert_allclose(found["error"], (1 / 32 + 1) / 2, rtol=1e-5)


def test_own_queries_learn(made, tmp_path):
    """Forty iterations leave less than half of the error that one leaves."""
    task = claim.make_task(made, 0, tmp_path)
    recipe = configure(find_recipe("cus"), **SMALL, features=str(tmp_path))
    model = initial_state(made.scene, recipe, seed=0).model
    errors = []
    for iterations in (1, 40):
        found = claim.own_queries(model, task, 4, iterations, 0)

        def features_of(view, found=found):
            image, _ = claim._blend(model, view, found["queries"])
            return read_memory(image.reshape(-1, 4), found)[0].reshape(*image.shape[:2], -1)

        errors.append(claim.quality(task, features_of)["error"])
    assert errors[1] < 0.5 * errors[0]
