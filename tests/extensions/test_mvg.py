"""MVG-Splatting: levels, steps and insertions by hand, its losses, the recipe by the command line."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.extensions.mvg import insertion, recipe
from minisplat_ref.extensions.mvg.insertion import (
    Insertions,
    Photographed,
    Rules,
    assign_levels,
    choose_grid_pixels,
    depth_cuts,
    depth_density,
    drop_covered,
    propose,
)
from minisplat_ref.extensions.mvg.recipe import (
    MVG,
    depth_steps,
    edge_aware_steps,
    edge_aware_steps_vjp,
    facing,
    filtered_normals,
    make_surfels,
    photographed,
)
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView, Tolerances
from minisplat_ref.mechanisms.oriented.thin_axis import normals_of
from minisplat_ref.mechanisms.surfels.discs import DISCS
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.oracle.loss_terms import loss_cases
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Camera, Gaussians, Model, RenderOutput, Scene, View, view_from
from tolerances import CLOSED_FORM

FLOAT32 = 1e-6  # a float64 result stored as float32, relative


# --- levels ---


def test_the_density_is_the_sum_of_kernels(rng):
    """Against the sum itself; the histogram moves each kernel by up to half a bin, 1/20 of its width here.

    With the quartiles of a narrow peak, whose tails make the standard deviation larger than these say.
    """
    depths = np.concatenate([rng.normal(3, 0.5, 380), rng.uniform(0.5, 5.5, 20)])
    density = depth_density(depths)
    spread = min(depths.std(), np.subtract(*np.quantile(depths, [0.75, 0.25])) / 1.34)
    assert spread < 0.95 * depths.std()
    sigma = 0.9 * spread * 400**-0.2
    kernels = np.exp(-0.5 * ((density.depths[:, None] - depths) / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    assert_allclose(density.values, kernels.mean(axis=1), atol=5e-3 * density.values.max())
    assert_allclose(np.sum(density.values) * np.diff(density.depths)[0], 1, rtol=1e-6)


def test_an_object_before_a_wall_is_near(rng):
    """The wall's half maximum is 1.18 deviations away on either side; a few points float behind it."""
    depths = np.concatenate([rng.normal(5, 0.1, 20_000), rng.uniform(2, 3, 1_000), rng.uniform(6, 7, 500)])
    near, far = depth_cuts(depths)
    assert near == pytest.approx(5 - 0.118, abs=0.02) and far == pytest.approx(5 + 0.118, abs=0.02)
    assert assign_levels(np.array([2.5, 4.8, 5.0, 5.2, 6.5]), (near, far)).tolist() == [0, 0, 1, 2, 2]


@pytest.mark.parametrize("depths", [[2.0], [2.0, 2.0, 2.0]])
def test_a_wall_alone_is_all_middle(depths):
    cuts = depth_cuts(np.array(depths))
    assert assign_levels(np.array(depths), cuts).tolist() == [1] * len(depths)


def test_a_grid_begins_at_its_corner():
    assert np.argwhere(choose_grid_pixels((4, 5), 3, (1, 5))).tolist() == [[1, 2]]
    assert choose_grid_pixels((4, 5), 2, (0, 1)).sum() == 4 and not choose_grid_pixels((4, 5), 0, (0, 0)).any()


# --- depth steps ---


def test_steps_by_hand():
    """Three pixels in a row, 2, 3 and 5, an edge of 0.5 between the last two; and one without a depth."""
    depth, image = np.array([[2.0, 3.0, 5.0, 0.0]]), np.zeros((1, 4, 3))
    image[0, 2] = 0.5
    w = np.exp(-4 * 0.5)
    assert_allclose(edge_aware_steps(depth, image, 4.0), (1 + 2 * w) / 4, rtol=CLOSED_FORM)
    assert_allclose(edge_aware_steps_vjp(depth, image, 4.0), [[-1 / 4, (1 - w) / 4, w / 4, 0]], rtol=CLOSED_FORM)


def test_the_gradient_of_steps(rng):
    depth, image = rng.permutation(20).reshape(4, 5) / 4 + 1, rng.uniform(size=(4, 5, 3))  # no two are equal

    def vjp(v):
        return (float(v) * edge_aware_steps_vjp(depth, image, 3.0),)

    check_jacobian(lambda z: (np.array(edge_aware_steps(z, image, 3.0)),), vjp, (depth,), names=("depth",))


# --- insertions ---


def seen_from(x, depth):
    """A fronto-parallel plane of 24 x 18 pixels with a grey photograph."""
    camera = Camera(np.eye(3), np.array([-x, 0.0, 0.0]), 20.0, 20.0, 12.0, 9.0, 24, 18)
    return Photographed(DepthView(np.broadcast_to(depth, (18, 24)).copy(), camera), np.full((18, 24, 3), 0.25))


def three_views():
    """A step: the left half at depth 3, a middle of more pixels at 4; the first view is wrong in a pixel of each."""
    wall = np.full((18, 24), 4.0)
    wall[:, :8] = 3.0
    views = [seen_from(0.0, wall), seen_from(0.0, wall), seen_from(0.0, wall)]
    views[0].seen.depth[[5, 5], [4, 16]] = 2.0
    return views


def test_only_what_views_agree_on_becomes_points(monkeypatch, rng):
    """Every second pixel of the near half, with the radius 2 D / f; the wrong pixels are left out by the test alone."""
    rules = Rules(Tolerances(n_views=2), 2, (1, 0, 0))
    tested, untested = propose(three_views(), rules, rng), propose(three_views(), rules._replace(n_sources=0), rng)
    of_first = tested.views == 0
    assert not np.isin(tested.pixels[of_first], [5 * 24 + 4, 5 * 24 + 16]).any() and of_first.sum() > 50
    assert np.isin([5 * 24 + 4, 5 * 24 + 16], untested.pixels[untested.views == 0]).all()
    assert_allclose(tested.radii, 3 / 20, rtol=CLOSED_FORM)
    assert_allclose(tested.points[:, 2], 3, rtol=CLOSED_FORM)
    assert (tested.levels == 0).all() and (tested.colors == 0.25).all()
    flat = np.abs(tested.normals @ [0, 0, -1] - 1) < 1e-12  # all but those beside the step or the wrong pixels
    assert flat.mean() > 0.7
    rows, columns = np.divmod(tested.pixels, 24)
    assert rows.min() == 1 and columns.min() == 1 and rows.max() == 16  # the border has no normal


def test_a_stride_takes_every_so_many_pixels(rng):
    rules = Rules(Tolerances(n_views=1), 2, (3, 0, 0))
    found = propose(three_views(), rules, rng)
    rows, columns = np.divmod(found.pixels[found.views == 1], 24)
    assert len(rows) > 4 and len(set(rows % 3)) == len(set(columns % 3)) == 1
    assert_allclose(found.radii, 3 * 3 / 20, rtol=CLOSED_FORM)


def test_beside_a_hole_there_is_no_normal_and_no_point(rng):
    """One pixel without a depth takes its four neighbours along; the radius is that of the mean focal length."""
    views = [seen_from(0.0, 3.0) for _ in range(3)]
    turned = Camera(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), np.zeros(3), 20.0, 45.0, 12.0, 9.0, 24, 18)
    views = [view._replace(seen=view.seen._replace(camera=turned)) for view in views]
    for view in views:
        view.seen.depth[9, 15] = 0
    found = propose(views, Rules(Tolerances(n_views=1), 2, (1, 1, 1)), rng)
    of_first = set(found.pixels[found.views == 0].tolist())
    hole = {9 * 24 + 15, 8 * 24 + 15, 10 * 24 + 15, 9 * 24 + 14, 9 * 24 + 16}
    inner = {24 * row + column for row in range(1, 17) for column in range(1, 23)}
    beside = {24 * row + column for row in (8, 10) for column in (14, 16)}  # by rounding they may read the hole, too
    assert not of_first & hole and inner - hole - beside <= of_first <= inner
    assert_allclose(found.radii, 3 / 30, rtol=CLOSED_FORM)  # of 20 and 45
    flat = np.median(found.normals, axis=0)
    assert_allclose(flat, [-1, 0, 0], atol=CLOSED_FORM)  # towards the camera, which looks along x


def test_nothing_is_proposed_where_nothing_agrees(rng):
    views = [seen_from(0.0, 3.0), seen_from(0.0, 3.5)]
    found = propose(views, Rules(Tolerances(n_views=1), 1, (1, 1, 1)), rng)
    assert len(found.points) == 0 and len(drop_covered(found, np.zeros((2, 3))).points) == 0


def test_normals_are_those_of_the_smoothed_depths(rng):
    """The depths that others agree on are a slope, on which the points are; smoothed, they were flat: the normals."""
    view = seen_from(0.0, 3.0)
    slope = 3 + 0.05 * np.arange(24) + np.zeros((18, 1))
    agreed = view._replace(seen=view.seen._replace(depth=slope))
    found = insertion._propose_in_view(agreed, view.seen.depth, (0.0, 0.0), (1, 1, 1), 0, rng)
    assert len(found.normals) == 16 * 22
    assert_allclose(found.normals, np.tile([0, 0, -1], (16 * 22, 1)), atol=CLOSED_FORM)
    assert_allclose(found.points[:, 2].reshape(16, 22), slope[1:-1, 1:-1], rtol=CLOSED_FORM)


def test_depths_to_be_inserted_are_smoothed():
    """A pixel that is 0.01 too far, amid a plain photograph, is nearer to its neighbours afterwards."""
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 4.5, 3.5, 9, 7)
    image = np.full((7, 9, 4), 2.0)
    image[3, 4, 3] = 2.01

    class Settings:
        renderer, conventions = SURFELS, GSPLAT_MAIN

        @staticmethod
        def render_view(model, view, wants, sh_degree):
            return RenderOutput(image, np.ones((7, 9)), None, None), None

    view = View("v", camera, np.full((7, 9, 3), 51, np.uint8), None)
    depth = photographed(Model(None), view, Settings()).seen.depth
    assert 2 < depth[3, 4] < 2.005 and 2 < depth[3, 5] < 2.005


def insertions_at(points, radii):
    n = len(points)
    points = np.asarray(points, float)
    return Insertions(
        points, np.tile([0, 0, 1.0], (n, 1)), np.asarray(radii, float), np.full((n, 3), 0.5), *np.zeros((3, n), int)
    )


def test_covered_points_are_left_out():
    """On a line: 0.5 lies near the old one at 0, 1.5 near none, 2 near 1.5 and 2.6 near 2 alone, which is gone."""
    found = insertions_at([[0.5, 0, 0], [1.5, 0, 0], [2.0, 0, 0], [2.6, 0, 0]], [0.7] * 4)
    assert drop_covered(found, np.zeros((1, 3))).points[:, 0].tolist() == [1.5, 2.6]
    assert drop_covered(found, np.zeros((0, 3))).points[:, 0].tolist() == [0.5, 1.5, 2.6]


def test_a_surfel_faces_as_its_normal(rng):
    normals = rng.normal(size=(40, 3))
    normals = np.vstack([normals / np.linalg.norm(normals, axis=1, keepdims=True), [[0, 0, 1], [0, 0, -1]]])
    like = Gaussians(*(np.zeros((1, *shape)) for shape in ((3,), (4,), (3,), (), (3,), (15, 3))))
    found = insertions_at(rng.normal(size=(42, 3)), np.full(42, 0.2))._replace(normals=normals)
    surfels = make_surfels(found, like)
    assert_allclose(normals_of(surfels), normals, atol=1e-12)
    assert_allclose(surfels.log_scales[0], [np.log(0.2), np.log(0.2), -16], rtol=CLOSED_FORM)
    assert_allclose(1 / (1 + np.exp(-surfels.opacity_logits)), 0.1, rtol=CLOSED_FORM)
    assert surfels.sh_rest.shape == (42, 15, 3) and not surfels.sh_dc.any()  # grey 0.5 is all zeros
    bright = make_surfels(found._replace(colors=np.full((42, 3), 1.0)), like)
    assert_allclose(0.5 + SH_C0 * bright.sh_dc, 1.0, rtol=CLOSED_FORM)


def test_facing_takes_the_shorter_way():
    assert_allclose(facing(np.array([[1.0, 0, 0]])), [[np.sqrt(0.5), 0, np.sqrt(0.5), 0]], rtol=CLOSED_FORM)
    assert_allclose(facing(np.array([[0, 1.0, 0]])), [[np.sqrt(0.5), -np.sqrt(0.5), 0, 0]], rtol=CLOSED_FORM)


def test_depths_are_of_opaque_pixels_that_the_mask_keeps():
    """Three pixels: opaque, translucent, masked."""
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 1.5, 0.5, 3, 1)
    image = np.zeros((1, 3, 4))
    alpha = np.array([[0.8, 0.4, 0.8]])
    image[..., 3] = 2 * alpha

    class Settings:
        renderer, conventions = SURFELS, GSPLAT_MAIN

        @staticmethod
        def render_view(model, view, wants, sh_degree):
            return RenderOutput(image, alpha, None, None), None

    view = View("v", camera, np.full((1, 3, 3), 51, np.uint8), np.array([[True, True, False]]))
    found = photographed(Model(None), view, Settings())
    assert_allclose(found.seen.depth, [[2, 0, 0]], rtol=CLOSED_FORM)
    assert_allclose(found.image, 0.2, rtol=CLOSED_FORM)


# --- losses ---


def rendered(photograph):
    """A noisy depth of about 3 under surfels that face the camera, of opacity 0.8."""
    rng = np.random.default_rng(5)
    slices = SURFELS.channels(frozenset({"depth", "normal"}))
    image = np.zeros((6, 7, 7))
    image[..., slices["depth"]] = 0.8 * (3 + 0.01 * rng.normal(size=(6, 7, 1)))
    image[..., slices["normal"]] = [0, 0, -0.8]
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, 3.5, 3.0, 7, 6)
    scene = Scene("s", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 2.0)
    view = view_from(camera)._replace(image=np.broadcast_to(photograph, (6, 7, 3)).astype(np.uint8))
    output = RenderOutput(image, np.full((6, 7), 0.8), None, None)
    return Rendered(output, slices, view, scene, Model(None), 1, Request(conventions=GSPLAT_MAIN))


def test_the_filter_takes_noise_out_of_the_loss_on_normals():
    """On an even photograph it does; on one of 42 unlike colours it hears no neighbour and changes nothing."""
    from minisplat_ref.mechanisms.surfels.disagreement import disagree

    even = rendered(128)
    depth = even.channel("depth")[..., 0] / 0.8
    raw = disagree(even, depth).value
    floor = 0.8 * (1 - 20 / 42)  # the border has no normal
    assert filtered_normals(even)[0] - floor < 0.5 * (raw - floor)
    unlike = np.arange(42).reshape(6, 7, 1) * np.array([97, 61, 151]) % 256
    assert_allclose(filtered_normals(rendered(unlike))[0], raw, rtol=1e-3)


def test_steps_are_in_units_of_the_extent_and_end_at_edges():
    scene = rendered(128)
    depth = scene.channel("depth")[..., 0] / 0.8
    plain = np.abs(np.diff(depth, axis=0)).sum() + np.abs(np.diff(depth, axis=1)).sum()
    assert_allclose(depth_steps(scene, sharpness=10.0)[0], plain / 42 / 2.0, rtol=1e-12)
    checks = 255 * (np.indices((6, 7)).sum(axis=0) % 2)[..., None]
    edges = depth_steps(rendered(checks), sharpness=10.0)[0]
    assert_allclose(edges, plain / 42 / 2.0 * np.exp(-10), rtol=1e-10)


def test_the_gradients_of_the_losses():
    terms = {term.name: term for term in MVG.losses}
    for name in ("filtered_normals", "depth_steps"):
        cases = loss_cases(terms[name], REFERENCE, GSPLAT_MAIN, DISCS)
        assert cases and all(case.passed for case in cases), name


# --- the recipe ---


def test_the_recipe_trains_through_the_command_line(tmp_path, capsys):
    """Once as it is, and once without the test, which inserts more."""
    tiny = ("--views", "6", "--width", "48", "--height", "36", "--supersampling", "1", "--points", "150")
    assert main(["synthetic", "staircase", "--out", str(tmp_path / "stairs"), *tiny]) == 0
    added = []
    for name, settings in (("tested", ()), ("untested", ("--set", "n_sources=0"))):
        train = ["train", str(tmp_path / "stairs"), "--recipe", "mvg", "--iterations", "250"]
        assert main([*train, *settings, "--out", str(tmp_path / name)]) == 0
        events = [json.loads(line) for line in (tmp_path / name / "events.jsonl").read_text().splitlines()]
        own = [event for event in events if event["action"] == "insert_consistent"]
        added.append(sum(event["n_after"] - event["n_before"] for event in own))
    assert 0 < added[0] < added[1]
    capsys.readouterr()
    assert main(["info", str(tmp_path / "tested" / "point_cloud.ply")]) == 0 and "mvg" in capsys.readouterr().out


def test_an_insertion_that_finds_nothing_says_so(monkeypatch, rng):
    monkeypatch.setattr(recipe, "photographed", lambda *arguments: seen_from(0.0, 0.0))

    class State:
        model, gaussians = None, Gaussians(*np.zeros((6, 1, 3)))

    State.rng = rng
    scene = Scene("s", (view_from(seen_from(0, 1).seen.camera),), (), None, None, None, 1.0)
    strides = {"near_stride": 1, "far_stride": 1}
    note = recipe.insert_consistent(State, _Iteration(scene), n_views=1, n_sources=1, **strides)
    assert "no pixel" in note


def test_near_and_far_have_strides_of_their_own(monkeypatch, rng):
    asked = []

    def propose(views, rules, rng):
        asked.append(rules)
        return insertions_at(np.zeros((0, 3)), [])

    monkeypatch.setattr(recipe, "propose", propose)

    class State:
        model, gaussians = None, Gaussians(*np.zeros((6, 1, 3)))

    State.rng = rng
    scene = Scene("s", (), (), None, None, None, 1.0)
    recipe.insert_consistent(State, _Iteration(scene), n_views=3, n_sources=5, near_stride=7, far_stride=2)
    assert asked == [Rules(Tolerances(n_views=3), 5, (7, 0, 2))]


class _Iteration:
    render_settings = None

    def __init__(self, scene):
        self.scene = scene
