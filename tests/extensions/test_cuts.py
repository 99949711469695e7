"""DisC-GS: masks against polygons, gradients, hard cases, training end to end."""

import json

import numpy as np
import pytest
from matplotlib.path import Path as Polygon
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.cuts.model import CUT_GAUSSIANS, CutGaussians, with_cuts
from minisplat_ref.extensions.cuts.response import (
    N_EDGES,
    N_PIECES,
    VERTICES,
    bernstein,
    count_crossings,
    evaluate_cuts,
    evaluate_cuts_vjp,
    image_points,
    image_points_vjp,
)
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Gaussians, Model, Primitives, view_from
from payloads import drawn, random_cuts
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

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
    assert inside.sum() > 50 and (count_crossings(points, d)[0] % 2 == 1)[inside].all()
    assert (count_crossings(points, d)[0] % 2 == 0)[~inside].all()


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


def test_where_two_shadows_overlap_it_is_visible_again():
    """An even number of crossings of all curves: the hard mask of two is the exclusive or of their shadows."""
    d, both = grid(), np.concatenate([LOOP, AROUND], axis=1)
    alone = [evaluate_cuts(points, HARD, d) for points in (LOOP, AROUND)]
    found = evaluate_cuts(both, HARD, d)
    is_cut = [one.masks == 0 for one in alone]
    assert (is_cut[0] & is_cut[1]).sum() > 20 and (found.masks == (is_cut[0] == is_cut[1])).all()
    assert_array_equal(count_crossings(both, d), count_crossings(LOOP, d) + count_crossings(AROUND, d))


def test_the_soft_mask_of_two_curves_is_that_of_the_nearer():
    d, both = grid(), np.concatenate([LOOP, AROUND], axis=1)
    alone = [evaluate_cuts(points, SOFT, d) for points in (LOOP, AROUND)]
    distances = [np.linalg.norm(one.away, axis=2) for one in alone]
    sign = np.where(alone[0].is_visible == alone[1].is_visible, 1, -1)
    assert_allclose(evaluate_cuts(both, SOFT, d).masks, 1 / (1 + np.exp(-sign * np.minimum(*distances))), rtol=1e-12)
    is_nearer = distances[1] < distances[0]
    assert 0.1 < is_nearer.mean() < 0.9
    assert_array_equal(evaluate_cuts(both, SOFT, d).pieces // N_PIECES, is_nearer)


@pytest.mark.parametrize(
    "points", [LOOP, AROUND, np.concatenate([AROUND, LOOP], axis=1)], ids=["beside", "around", "both"]
)
def test_the_gradient_of_the_mask(points, rng):
    d = rng.uniform(-5, 8, size=(1, 12, 2))
    check_jacobian(
        lambda points, d: (evaluate_cuts(points, SOFT, d).masks,),
        lambda v: evaluate_cuts_vjp(points, SOFT, evaluate_cuts(points, SOFT, d), v),
        [points, d],
        names=["points", "offsets"],
    )


@pytest.mark.parametrize("n_curves", [1, 2])
def test_the_gradient_of_the_points(n_curves, rng):
    camera = make_camera(rng=rng)
    curves, means = rng.normal(size=(3, 8 * n_curves)), rng.normal(size=(3, 3)) + np.array([0, 0, 4])
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


@pytest.mark.parametrize(
    ("n_curves", "dtype", "image_rel", "rel"),
    [
        (2, np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64),
        (2, np.float32, PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT),
        (3, np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64),
    ],
)
def test_kernels_and_reference_agree_on_several_curves(n_curves, dtype, image_rel, rel, rng):
    """Every image and every gradient; all curves have one."""
    population = random_cuts(rng, make_gaussians(rng, 30, size=0.4), n_curves)
    view = view_from(make_camera(rng=rng))
    theirs, v_theirs = drawn(RENDERER, population, view, REFERENCE, compared_to=dtype)
    ours, v_ours = drawn(RENDERER, as_dtype(population, dtype), view, CPU)
    assert np.abs(ours.image - theirs.image).max() <= image_rel
    assert v_ours.gaussians.curves.shape == (30, 8 * n_curves)
    for name in ("curves", "means", "log_scales", "opacity_logits"):
        mine, yours = (np.asarray(getattr(v.gaussians, name), np.float64) for v in (v_ours, v_theirs))
        assert np.abs(mine - yours).max() <= rel * np.abs(yours).max(), name
    by_curve = np.abs(v_theirs.gaussians.curves).reshape(30, n_curves, 8).sum(axis=(0, 2))
    assert (by_curve > 0.02 * by_curve.max()).all()


def test_a_second_curve_that_is_far_away_changes_no_byte_of_the_image(backend, rng):
    """Nor the gradients, but for the order in which the compiler adds."""
    one = random_cuts(rng, make_gaussians(rng, 20))
    far = np.full((20, 8), 1e6)
    two, view = one._replace(curves=np.hstack([one.curves, far])), view_from(make_camera(rng=rng))
    (image, v), (image_of_two, v_of_two) = (drawn(RENDERER, population, view, backend) for population in (one, two))
    assert_array_equal(image_of_two.image, image.image)
    assert_allclose(v_of_two.gaussians.curves[:, :8], v.gaussians.curves, rtol=1e-9, atol=1e-12)
    assert not v_of_two.gaussians.curves[:, 8:].any() and np.abs(v.gaussians.curves).max() > 0.01
    assert_allclose(v_of_two.gaussians.means, v.gaussians.means, rtol=1e-9, atol=1e-12)


def test_the_number_of_curves(rng):
    gaussians = make_gaussians(rng, 5)
    three = with_cuts(gaussians, rng, n_curves=3).curves.reshape(5, 3, 4, 2)
    middles = three.mean(axis=2)
    assert_allclose(np.linalg.norm(middles, axis=2), 1, rtol=CLOSED_FORM)
    assert_allclose(middles.sum(axis=1), 0, atol=CLOSED_FORM)  # evenly around the centre
    assert (with_cuts(gaussians, rng).widths == 1).all()  # px
    for wrong in (0, 5):
        with pytest.raises(InputError, match=f"n_curves is {wrong}: give 1 to 4"):
            with_cuts(gaussians, rng, n_curves=wrong)
    odd = with_cuts(gaussians, rng)._replace(curves=np.zeros((5, 12)))
    with pytest.raises(InputError, match="curves have 12 numbers per Gaussian"):
        RENDERER.render(Model(odd), view_from(make_camera()), Request())


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


def test_the_fields_of_3dgs_come_first():
    assert CutGaussians._fields[:6] == Gaussians._fields
