"""Discretised SDF: opacity from a distance, losses by hand, the sphere, density control, the recipe by its command."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.discretized_sdf import EXTENSION, recipe
from minisplat_ref.extensions.discretized_sdf.model import (
    DISTANCED,
    LOG_WIDTH,
    WIDTH,
    _foreground,
    first_shared,
    opacity_logits,
    opacity_logits_vjp,
    projected,
    reference_sharpness,
    with_distances,
)
from minisplat_ref.extensions.discretized_sdf.recipe import (
    RECIPE,
    refresh_opacities,
    reset_distances,
    reset_distances_on_white,
)
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io.frames import place_fields
from minisplat_ref.io.images import read_image
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, PER_SURFEL, STAGE, sigmoid
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import Request
from minisplat_ref.strategy.clone_split import clone_and_split, prune_faint
from minisplat_ref.training.losses import Rendered
from minisplat_ref.types import Camera, Frame, Model, RenderOutput, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, ROUNDED_TO_FLOAT32


def log_of(width):
    return np.array([np.log(width)])


def shared_of(width, stage=PER_PIXEL):
    with np.errstate(divide="ignore"):
        return {ENVIRONMENT: np.zeros((4, 8, 3)), STAGE: np.full(1, float(stage)), LOG_WIDTH: log_of(width)}


def test_opacity_is_the_published_function_of_the_distance():
    s = np.array([-1.3, -0.2, 1e-4, 0.0, 0.2, 1.7627471740390859])
    gamma = 1.0
    expected = 4 * np.exp(-gamma * s) / (1 + np.exp(-gamma * s)) ** 2
    assert_allclose(sigmoid(opacity_logits(s, log_of(1 / gamma))), expected, rtol=CLOSED_FORM)
    assert_allclose(expected[-1], 0.5, rtol=CLOSED_FORM)
    o, transparency = 1 / np.cosh(1.25 * s) ** 2, np.tanh(1.25 * s) ** 2
    v_s, _ = opacity_logits_vjp(s, log_of(0.4), o * transparency)
    assert_allclose(v_s, -2.5 * np.tanh(1.25 * s) * o, rtol=1e-9, atol=1e-25)
    _, v_w = opacity_logits_vjp(s, log_of(0.4), np.ones(6))
    h = 1e-5
    difference = opacity_logits(s, log_of(0.4) + h) - opacity_logits(s, log_of(0.4) - h)
    assert_allclose(v_w, [np.sum(np.delete(difference, 3)) / (2 * h) + 2], rtol=1e-6)  # s = 0 counts as x -> 0: 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_far_and_near_distances_stay_finite(dtype):
    s = np.array([0, 1e-30, -1e-12, 1e3, -1e6], dtype)
    logits = opacity_logits(s, np.log(np.full(1, 0.1, dtype)))
    assert logits.dtype == dtype and np.isfinite(logits).all()
    assert_allclose(sigmoid(logits)[:3], 1)
    assert_allclose(logits[3:], -2 * (np.array([5e3, 5e6]) - np.log(2)), rtol=ROUNDED_TO_FLOAT32)  # gamma = 10
    v_s, v_w = opacity_logits_vjp(s, np.full(1, -2, dtype), np.zeros(5, dtype))
    assert not v_s.any() and not v_w.any()


@pytest.mark.parametrize("stage", [PER_SURFEL, PER_PIXEL])
def test_opacities_are_those_of_the_distances(stage, backend, rng):
    """As Ref-Gaussian's with these opacities, whose surfels have no own colours here; with gamma = 0 all are opaque."""
    g = with_distances(make_gaussians(rng, 20, size=0.3), rng, foreground=0.0)
    g = g._replace(distances=rng.normal(size=20))
    view, request = view_from(make_camera(rng=rng)), Request(np.array([0.3, 0.2, 0.1]), backend=backend)
    images = []
    for width, logits in ((1e300, np.full(20, 1e3)), (0.3, opacity_logits(g.distances, log_of(0.3)))):
        shared = shared_of(width, stage)
        found, _ = DISTANCED.renderer.render(Model(g, shared), view, request)
        plain = g._replace(opacity_logits=logits)
        expected, _ = REFLECTIVE.render(Model(plain, shared), view, request)
        assert_array_equal(found.image, expected.image)
        images.append(found.image)
    assert np.abs(images[1] - images[0]).max() > 0.01


def test_light_is_scattered_by_the_albedo(rng):
    """Whatever coefficients of colours there are: they belong to other recipes."""
    g = with_distances(make_gaussians(rng, 20, size=0.3), rng, foreground=0.0)
    view, shared = view_from(make_camera(rng=rng)), shared_of(0.3)
    first, second = (
        DISTANCED.renderer.render(Model(g._replace(sh_dc=np.full((20, 3), c)), shared), view, Request())[0].image
        for c in (0.0, 3.0)
    )
    assert_array_equal(first, second)
    brighter = {**shared, ENVIRONMENT: shared[ENVIRONMENT] + np.log(2)}
    assert DISTANCED.renderer.render(Model(g, brighter), view, Request())[0].image.mean() > 1.2 * first.mean()


def test_the_start_is_the_released_one(rng):
    """Distances between 0 and 2 that are even, gamma 1, roughness sigmoid(0.6), half of it metal, shading per pixel."""
    found = with_distances(make_gaussians(rng, 400), rng, foreground=0.0)
    assert 0 < found.distances.min() < 0.05 and 1.95 < found.distances.max() < 2
    assert_allclose([found.distances.mean(), found.distances.std()], [1, 1 / 3**0.5], rtol=0.1)
    assert_allclose(sigmoid(found.opacity_logits), 1 / np.cosh(found.distances / 2) ** 2, rtol=1e-9)
    assert (found.roughness_logits == 0.6).all() and not found.metallic_logits.any()
    shared = first_shared(None, rng)
    assert shared[STAGE] == PER_PIXEL and shared[LOG_WIDTH] == 0
    assert find_recipe("discretized-sdf").representation.extend.keywords == {"foreground": 0.0}


def test_a_start_on_the_sphere(rng):
    gaussians = make_gaussians(rng, 40)
    found = with_distances(gaussians, rng, foreground=0.5)
    center = np.median(gaussians.means, axis=0)
    away = np.linalg.norm(gaussians.means - center, axis=1)
    rows = np.argsort(away)[:20]
    points = projected(found.means, found.quats, found.distances)
    assert_allclose(np.linalg.norm(points[rows] - center, axis=1), away[rows[-1]], rtol=1e-12)
    outwards = (found.means[rows] - center) / np.linalg.norm(found.means[rows] - center, axis=1)[:, None]
    normals = rotation_matrices(found.quats[rows])[:, :, 2]
    assert_allclose(np.abs(np.sum(outwards * normals, axis=1)), 1, rtol=1e-12)
    others = np.setdiff1d(np.arange(40), rows)
    assert_array_equal(found.means[others], gaussians.means[others])
    assert_allclose(found.distances[rows], 0.2 / 1.1 * away[rows[-1]], rtol=1e-12)
    assert np.ptp(found.distances[others]) > 0.5
    none = with_distances(gaussians, rng, foreground=0.0)
    assert_array_equal(none.means, gaussians.means)
    rows, _, _ = _foreground(gaussians.means[:7], 0.4)
    assert len(rows) == 3  # of 2.8


def rendered_of(means, distances, depth=2.0, width=8, height=6, **changed):
    """Surfels that face the camera, before a plane at a depth; the camera looks along z."""
    n = len(means)
    g = with_distances(make_gaussians(np.random.default_rng(0), n), np.random.default_rng(0), foreground=0.0)
    g = g._replace(means=np.array(means, float), quats=np.tile([1.0, 0, 0, 0], (n, 1)), distances=np.array(distances))
    camera = Camera(np.eye(3), np.zeros(3), 8.0, 8.0, width / 2, height / 2, width, height)
    alpha = np.full((height, width), 0.5)
    image = np.zeros((height, width, 4))
    image[..., 3] = depth * alpha
    output = RenderOutput(image, alpha, None, None)
    slices = {"rgb": slice(0, 3), "depth": slice(3, 4)}
    return Rendered(output, slices, view_from(camera), None, Model(g, shared_of(0.5)), 1, Request())._replace(**changed)


def test_the_projection_by_hand():
    """Depths of the projected centres 2.03, 1.96 and 2.2; the last, too far, counts as 0 of 3; others are unseen."""
    means = [[0, 0, 2.13], [0.1, 0, 1.9], [0, 0.1, 2.2], [9, 0, 2.0], [0, 0, -2.0]]
    value, v = recipe.projection(rendered_of(means, [0.1, -0.06, 0, 0, 0]), reach=0.1)
    assert_allclose(value, (0.03 + 0.04) / 3, rtol=1e-9)
    assert_allclose(v.gaussians["means"][:, 2], [1 / 3, -1 / 3, 0, 0, 0])
    assert_allclose(v.gaussians["distances"], [-1 / 3, 1 / 3, 0, 0, 0])
    assert not v.gaussians["quats"][2:].any()
    near = rendered_of([[0, 0, 0.009], [0, 0, 0.011]], [0.0, 0.0], depth=0.05)  # what touches the camera has no pixel
    assert_allclose(recipe.rendered_depths(near), [0, 0.05], rtol=1e-6)
    nothing, v = recipe.projection(rendered_of(means[3:], [0.0, 0.0]), reach=0.1)
    assert nothing == 0 and not v.gaussians


def test_the_projection_holds_the_rendered_depth():
    rendered = rendered_of([[0, 0, 2.0]], [0.0], 2.05)
    moved = rendered_of([[0, 0, 2.0]], [0.0], 2.01)._replace(held=rendered)
    assert_allclose(recipe.projection(moved, reach=0.1)[0], 0.05, rtol=1e-9)


def test_the_median_by_hand():
    s = [0.1, -0.3, 0.2]
    assert_allclose(reference_sharpness(np.array(s)), 1.7627471740390859 / 0.2, rtol=1e-12)
    value, v = recipe.median(rendered_of(np.zeros((3, 3)), s))
    assert_allclose(value, 1.7627471740390859 / 0.2 - 2, rtol=1e-12)
    assert_allclose(v.shared[LOG_WIDTH], [2.0])
    sharp = rendered_of(
        np.zeros((3, 3)), s, model=Model(rendered_of(np.zeros((3, 3)), s).model.gaussians, shared_of(0.1))
    )
    assert recipe.median(sharp)[0] == 0
    for small in ([0.0, 0.0, 0.0], [0.1, -0.1, 0.3]):  # up to 0.1 nothing more is wanted than this
        assert reference_sharpness(np.array(small)) == 4.549
    assert_allclose(reference_sharpness(np.array([0.1000001])), 17.62747, rtol=1e-5)
    assert_allclose(recipe.median(rendered_of(np.zeros((3, 3)), [0.0, 0.0, 0.0]))[0], 2.549, rtol=1e-12)
    [term] = [term for term in RECIPE.losses if term.name == "median"]
    assert not term.is_due(1_000) and term.is_due(1_001) and term.weight == 1


def test_the_silhouette_by_hand():
    rendered = rendered_of(np.zeros((1, 3)), [0.0])
    assert recipe.silhouette(rendered)[0] == 0
    mask = np.zeros((6, 8), bool)
    mask[:, :4] = True
    alpha = np.where(mask, 0.9, 0.2)
    masked = rendered._replace(view=rendered.view._replace(mask=mask), output=rendered.output._replace(alpha=alpha))
    value, v = recipe.silhouette(masked)
    assert_allclose(value, -(np.log(0.9) + np.log(0.8)) / 2, rtol=1e-12)
    assert_allclose(v.alpha[0, [0, 7]], [-1 / 0.9 / 48, 1 / 0.8 / 48], rtol=1e-12)
    thin = masked._replace(output=rendered.output._replace(alpha=np.where(mask, 1.0, 1e-5)))
    value, v = recipe.silhouette(thin)  # beyond the margin of 1e-6 there is neither an infinite loss nor a slope
    assert_allclose(value, -(np.log(1 - 1e-6) + np.log(1 - 1e-5)) / 2, rtol=1e-6)
    assert v.alpha[0, 0] == 0 and v.alpha[0, 7] > 0


def test_smooth_maps_by_hand():
    """A step of 0.3 in the metallic share has the slope 1.2 in two columns, of which the mask leaves 4 rows."""
    rendered = rendered_of(np.zeros((1, 3)), [0.0])
    image = np.zeros((6, 8, 5))
    image[:, 4:, 3] = 0.3
    slices = {"albedo": slice(0, 3), "metallic": slice(3, 4), "roughness": slice(4, 5)}
    mask = np.zeros((6, 8), bool)
    mask[1:5, 1:7] = True
    shown = rendered._replace(
        output=rendered.output._replace(image=image), channels=slices, view=rendered.view._replace(mask=mask)
    )
    value, v = recipe.base_smoothness(shown)
    assert_allclose(value, 4 * 2 * 4 * 0.3 / 48, rtol=1e-12)
    assert_allclose(v.channels["metallic"][2, :, 0] * 48, [0, 0, -4, -4, 4, 4, 0, 0], atol=1e-12)
    coloured = np.zeros((6, 8, 5))
    coloured[:, 4:, 0] = 0.3
    value, v = recipe.base_smoothness(shown._replace(output=rendered.output._replace(image=coloured)))
    assert_allclose(value, 4 * 2 * 4 * 0.1 / 48, rtol=1e-12)  # of the mean of three channels
    assert_allclose(v.channels["albedo"][2, 4] * 48, 4 / 3)
    whole, _ = recipe.base_smoothness(shown._replace(view=rendered.view))
    assert whole > 5 * value


def test_the_derivative_of_smooth_maps(rng):
    rendered = rendered_of(np.zeros((1, 3)), [0.0])
    image, direction, h = rng.normal(size=(6, 8, 5)), rng.normal(size=(6, 8, 5)), 1e-7
    slices = {"albedo": slice(0, 3), "metallic": slice(3, 4), "roughness": slice(4, 5)}

    def at(x):
        return recipe.base_smoothness(rendered._replace(output=rendered.output._replace(image=x), channels=slices))

    v = np.concatenate([at(image)[1].channels[name] for name in slices], axis=2)
    numeric = (at(image + h * direction)[0] - at(image - h * direction)[0]) / (2 * h)
    assert_allclose(np.sum(v * direction), numeric, rtol=1e-6)


def test_neutral_light_by_hand():
    """One texel of two is (3, 1, 2): 1 + 1 + 0 off its mean, of six values; grey ones do not count."""
    light = np.log(np.array([[[3.0, 1.0, 2.0], [5.0, 5.0, 5.0]]]))
    rendered = rendered_of(np.zeros((1, 3)), [0.0])
    model = rendered.model._replace(shared={**rendered.model.shared, ENVIRONMENT: light})
    value, v = recipe.neutral_light(rendered._replace(model=model))
    assert_allclose(value, 2 / 6, rtol=1e-12)
    assert_allclose(v.shared[ENVIRONMENT][0, 0], [3 / 6, -1 / 6, 0], atol=1e-12)


def test_density_control_by_distance(rng):
    g = with_distances(make_gaussians(rng, 6), rng, foreground=0.0)
    g = g._replace(distances=np.array([0.0, 0.2, -0.4, 6.0, -8.0, 2.0]))
    moments = SimpleNamespace(distances=np.ones(6))
    state = SimpleNamespace(gaussians=g, shared=shared_of(WIDTH), adam=SimpleNamespace(first=moments, second=moments))
    refresh_opacities(state, None)
    o = 1 / np.cosh(state.gaussians.distances / WIDTH / 2) ** 2
    assert_allclose(sigmoid(state.gaussians.opacity_logits), o, rtol=1e-9)
    kept = prune_faint(state.gaussians, min_opacity=0.05)
    assert_array_equal(kept.parent_ids, [0, 1, 2, 5])
    edit = clone_and_split(state.gaussians, np.ones(6), threshold=0.5, size_limit=np.inf, rng=rng)
    assert_array_equal(edit.gaussians.distances, np.tile(g.distances, 2))
    edit = clone_and_split(state.gaussians, np.ones(6), threshold=0.5, size_limit=0.0, rng=rng)
    assert_array_equal(edit.gaussians.distances, np.tile(g.distances, 2))
    signs = np.sign(g.distances)
    white = SimpleNamespace(scene=SimpleNamespace(background=np.zeros(3)))
    assert "not white" in reset_distances_on_white(state, white, ceiling=0.01) and moments.distances.all()
    reset_distances(state, None, ceiling=0.01)
    after = sigmoid(state.gaussians.opacity_logits)
    assert_allclose(after.max(), 0.01, rtol=1e-9)
    assert_array_equal(np.sign(state.gaussians.distances)[1:], signs[1:])
    assert not moments.distances.any()


def test_gamma_and_distances_scale_with_the_frame():
    frame = Frame((0.0, 0.0, 0.0), 0.25)
    fields = {"distances": np.array([0.5]), LOG_WIDTH: log_of(0.1)}
    placed = place_fields(fields, DISTANCED.units, frame)
    assert_allclose(placed["distances"], 2.0)
    assert_allclose(opacity_logits(placed["distances"], placed[LOG_WIDTH]), opacity_logits(*fields.values()))


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sdf")
    settings = {"n_views": 3, "width": 24, "height": 18, "n_points": 60}
    write_scene(make_scene("glossy", supersampling=1, **settings), folder / "scene", settings)
    train = ["train", str(folder / "scene"), "--recipe", "discretized-sdf", "--iterations", "10"]
    assert main([*train, "--out", str(folder / "run")]) == 0
    return folder


def test_a_run_keeps_distances_and_gamma_and_is_relit(run_folder, capsys):
    run, views = run_folder / "run", run_folder / "run" / "views"
    g = EXTENSION.load(run / "point_cloud.ply", EXTENSION.representation.population)
    with np.load(run / "shared.npz") as shared:
        width = shared[LOG_WIDTH]
    assert width != np.float32(np.log(WIDTH))
    assert_allclose(g.opacity_logits, opacity_logits(g.distances, width), rtol=1e-6)
    np.save(run_folder / "dark.npy", np.full((8, 16, 3), 0.05))
    means = []
    for light in ([], ["--environment", str(run_folder / "dark.npy")]):
        assert main(["render", str(run), *light]) == 0
        means.append(np.mean([read_image(path).mean() for path in views.glob("*.png")]))
    assert means[1] < 0.7 * means[0]
    assert main(["render", str(run), "--map", "normal"]) == 0
    assert main(["train", "--resume", str(run), "--iterations", "12"]) == 0
    assert main(["render", str(run / "point_cloud.ply")]) == 2
    assert "no place for gamma" in capsys.readouterr().err.splitlines()[-1]
