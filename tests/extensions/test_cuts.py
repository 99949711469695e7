"""DisC-GS: masks against polygons, gradients, hard cases, training end to end."""

import json

import numpy as np
import pytest
from matplotlib.path import Path as Polygon
from numpy.testing import assert_allclose

from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.backends import CPU, REFERENCE
from minisplat_ref.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.cuts import card
from minisplat_ref.extensions.cuts.curve import (
    N_EDGES,
    VERTICES,
    bernstein,
    evaluate_cuts,
    evaluate_cuts_vjp,
    n_crossings,
)
from minisplat_ref.extensions.cuts.method import CUT_GAUSSIANS, CutGaussians
from minisplat_ref.extensions.cuts.response import image_points, image_points_vjp
from minisplat_ref.types import Gaussians, Primitives, view_from
from payloads import drawn, random_cuts
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

HARD, SOFT = np.zeros(1), np.ones(1)
LOOP = np.array([[[2.0, -5.0], [9.0, -6.0], [6.0, 7.0], [-2.5, 5.0]]])  # px; beside the centre
AROUND = np.array([[[-3.0, 0.5], [-2.0, 9.0], [8.0, -3.0], [-3.0, -0.5]]])  # almost closed around it
RENDERER = CUT_GAUSSIANS.renderer


def grid(n=41, reach=8.0):
    """Return pixels [1, n^2, 2] around the centre."""
    steps = np.linspace(-reach, reach, n) + 0.013
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)


# --- the mask ---


@pytest.mark.parametrize("points", [LOOP, AROUND], ids=["beside", "around"])
def test_what_is_cut_away_is_the_shadow_of_the_curve(points):
    """The shadow is the polygon of the curve's vertices and, far away, the ends projected by a lamp at the centre."""
    d, vertices = grid(), VERTICES @ points[0]
    directions = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    shadow = Polygon(np.concatenate([vertices, 1e3 * directions[::-1], vertices[:1]]))
    expected = shadow.contains_points(d[0])
    found = evaluate_cuts(points, HARD, d)
    assert 0.1 < expected.mean() < 0.95
    assert (found.masks[0] == ~expected).all()
    assert set(np.unique(found.masks)) == {0.0, 1.0}


def test_a_closed_curve_cuts_as_a_point_in_a_polygon(rng):
    """If the ends meet and the centre is outside, the inside is cut away, and so is where an odd number is crossed."""
    points = np.array([[[3.0, 0.0], [9.0, -7.0], [9.0, 7.0], [3.0, 0.0]]])
    polygon, d = Polygon(VERTICES @ points[0]), rng.uniform(-9, 9, size=(1, 4000, 2))
    inside = polygon.contains_points(d[0])
    assert inside.sum() > 50 and (n_crossings(points, d)[0] % 2 == 1)[inside].all()
    assert (n_crossings(points, d)[0] % 2 == 0)[~inside].all()


def test_the_polygon_is_the_curve_at_its_vertices():
    t = np.linspace(0, 1, N_EDGES + 1)
    straight = np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0], [3.0, 6.0]])
    assert_allclose(VERTICES @ straight, t[:, None] * [3.0, 6.0], atol=CLOSED_FORM)
    assert_allclose(bernstein(np.array(0.5)), [0.125, 0.375, 0.375, 0.125])
    assert (VERTICES * 512 == np.rint(VERTICES * 512)).all()


def test_a_straight_cut_is_a_logistic_curve_of_the_distance():
    points = np.array([[[1.5, -90.0], [1.5, -30.0], [1.5, 30.0], [1.5, 90.0]]])
    d = np.array([[[x, 0.4] for x in (-3.0, 1.0, 1.5, 1.75, 4.0)]])
    found = evaluate_cuts(points, 2 * SOFT, d).masks[0]
    assert_allclose(found, 1 / (1 + np.exp(-(1.5 - d[0, :, 0]) / 2)), rtol=CLOSED_FORM)
    assert_allclose(evaluate_cuts(points, HARD, d).masks[0], [1, 1, 0, 0, 0])


@pytest.mark.parametrize("points", [LOOP, AROUND], ids=["beside", "around"])
def test_the_soft_mask_does_not_jump_and_narrows_to_the_hard_one(points):
    path = np.linspace([[-8.0, -5.0]], [[8.0, 6.3]], 20_001).swapaxes(0, 1)
    soft, hard = evaluate_cuts(points, SOFT, path).masks[0], evaluate_cuts(points, HARD, path).masks[0]
    step = np.linalg.norm(path[0, 1] - path[0, 0])
    assert np.abs(np.diff(hard)).max() == 1 and np.abs(np.diff(soft)).max() <= 0.2501 * step
    narrow = evaluate_cuts(points, 1e-4 * SOFT, path).masks[0]
    assert np.mean(np.abs(narrow - hard) > 1e-6) < 0.002


@pytest.mark.parametrize(
    "points",
    [
        np.array([[[-2.0, -3.0], [0.0, 0.0], [0.0, 0.0], [2.0, 3.0]]]),
        np.tile([1.5, 1.1], (1, 4, 1)),
        np.zeros((1, 4, 2)),
        np.array([[[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]]]),
    ],
    ids=["through the centre", "a point", "the centre itself", "away from the centre"],
)
def test_degenerate_curves_are_finite_and_cut_nothing_if_they_have_no_breadth(points):
    d = np.concatenate([grid(), points, np.zeros((1, 1, 2))], axis=1)
    for widths in (HARD, SOFT):
        found = evaluate_cuts(points, widths, d)
        v_points, v_offsets = evaluate_cuts_vjp(points, widths, found, np.ones_like(found.masks))
        assert all(np.isfinite(array).all() for array in (found.masks, v_points, v_offsets))
    share = evaluate_cuts(points, HARD, grid()).masks.mean()
    assert 0.3 < share < 0.7 if np.ptp(points[0, :, 1]) > 1 else share > 0.999


@pytest.mark.parametrize("points", [LOOP, AROUND], ids=["beside", "around"])
def test_the_gradient_of_the_mask(points, rng):
    d = rng.uniform(-5, 8, size=(1, 12, 2))
    check_jacobian(
        lambda points, d: (evaluate_cuts(points, SOFT, d).masks,),
        lambda v: evaluate_cuts_vjp(points, SOFT, evaluate_cuts(points, SOFT, d), v),
        [points, d],
        names=["points", "offsets"],
    )


def test_the_gradient_of_the_points(rng):
    camera = make_camera(rng=rng)
    curves, means = rng.normal(size=(3, 8)), rng.normal(size=(3, 3)) + np.array([0, 0, 4])
    quats, scales = rng.normal(size=(3, 4)), rng.uniform(0.1, 0.4, size=(3, 3))
    pose = [camera.cam_from_world_R, camera.cam_from_world_t]

    def function(curves, means, quats, scales, R, t):
        moved = camera._replace(cam_from_world_R=R, cam_from_world_t=t)
        return (image_points(curves, Primitives(means, quats, scales, np.ones(3)), moved, GSPLAT_MAIN),)

    check_jacobian(
        function,
        lambda v: image_points_vjp(curves, Primitives(means, quats, scales, np.ones(3)), camera, GSPLAT_MAIN, v),
        [curves, means, quats, scales, *pose],
        names=["curves", "means", "quats", "scales", "R", "t"],
    )


# --- whole images ---


def test_needles_and_curves_through_the_centre(rng):
    """A needle, a Gaussian with a curve through its centre, one with a curve that is a point, one around the camera."""
    population = random_cuts(rng, make_gaussians(rng, 4))._replace(
        means=np.array([[0.1, 0.0, 3.0], [-0.3, 0.2, 2.5], [0.3, -0.2, 2.8], [0.05, 0.02, 0.3]]),
        log_scales=np.log([[0.8, 8e-4, 8e-4], [0.3, 0.3, 1e-6], [0.2, 0.2, 0.2], [0.6, 0.5, 0.7]]),
        opacity_logits=np.array([1.0, 1.0, 1.0, -1.5]),
    )
    population.curves[1], population.curves[2] = [-2, -2, -1, -1, 1, 1, 2, 2], 0.5
    view = view_from(make_camera())
    for dtype, rel in ((np.float64, 100 * PARITY_FLOAT64), (np.float32, 10 * PARITY_FLOAT32_IMAGE)):
        theirs, v_theirs = drawn(RENDERER, population, view, REFERENCE, compared_to=dtype)
        ours, v_ours = drawn(RENDERER, as_dtype(population, dtype), view, CPU)
        assert (ours.visible_ids == np.arange(4)).all()
        assert np.abs(ours.image - theirs.image).max() <= rel
        assert all(np.isfinite(field).all() for field in (*v_ours.gaussians, *v_theirs.gaussians))


# --- from end to end ---

SCENE = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


def test_trains_evaluates_and_renders(tmp_path, capsys):
    write_scene(make_scene("room", supersampling=1, **SCENE), tmp_path / "nook", SCENE)
    run = tmp_path / "run"
    options = ["--recipe", "cuts", "--test-every", "4", "--iterations", "40", "--out", str(run)]
    assert main(["train", str(tmp_path / "nook"), *options]) == 0
    losses = [json.loads(line)["loss"] for line in (run / "log.jsonl").read_text().splitlines()]
    assert losses[-1] < losses[0]
    population = load_ply(run / "point_cloud.ply", CutGaussians)
    assert population.curves.shape == (len(population.means), 8) and (population.widths == 0).all()
    assert main(["eval", str(run)]) == 0
    ply, cameras = str(run / "point_cloud.ply"), ["--cameras", str(run / "cameras.json")]
    for name, extension in (("ours", []), ("theirs", ["--extension", "core"])):
        assert main(["render", ply, *cameras, *extension, "--out", str(tmp_path / name)]) == 0
    ours, theirs = (sorted((tmp_path / name).glob("*.png")) for name in ("ours", "theirs"))
    assert all(a.read_bytes() != b.read_bytes() for a, b in zip(ours, theirs, strict=True))
    plain = tmp_path / "plain"
    assert main(["train", str(tmp_path / "nook"), "--recipe", "3dgs", "--iterations", "3", "--out", str(plain)]) == 0
    capsys.readouterr()
    command = ["render", str(plain / "point_cloud.ply"), *cameras, "--extension", "cuts", "--out", str(tmp_path / "no")]
    assert main(command) == 2
    error = capsys.readouterr().err.strip()
    assert "curves" in error and "\n" not in error and not (tmp_path / "no").exists()


def test_one_gaussian_with_a_cut_is_a_cut_gaussian():
    """Starting with a curve on the right side it is reproduced; 3DGS spills over the edge."""
    target = card.cut_gaussian()
    plain, found = (card.measure_card(target, card.fit_card(target, 1, is_cut, 300, 3)) for is_cut in (False, True))
    assert found["psnr"] > plain["psnr"] + 20 and found["edge_width"] < 2 < plain["edge_width"]


def test_the_width_of_an_edge():
    image = np.zeros((card.SIZE, card.SIZE, 3))
    image[:, :20] = 1.0
    assert card.edge_width(image) == pytest.approx(0.8)  # of a step from one pixel to the next
    image = np.clip((30.5 - np.arange(card.SIZE)) / 10, 0, 1)[None, :, None] * np.ones((card.SIZE, 1, 3))
    assert card.edge_width(image) == pytest.approx(8.0)


def test_the_study(tmp_path, monkeypatch, capsys):
    from minisplat_ref.extensions.cuts import study

    monkeypatch.setattr(study, "NUMBERS", {"plain": (1,), "cut": (1,)})
    out = tmp_path / "study"
    assert main(["study", "cuts/card", "--iterations", "5", "--seeds", "2", "--out", str(out)]) == 0
    assert len(json.loads((out / "result.json").read_text())["rows"]) == 4
    assert (out / "figure.png").stat().st_size > 10_000 and "| cut Gaussian" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["study", "cuts/card", "--seeds", "0", "--out", str(tmp_path / "none")])
    assert not (tmp_path / "none").exists()


def test_the_fields_of_3dgs_come_first():
    assert CutGaussians._fields[:6] == Gaussians._fields
