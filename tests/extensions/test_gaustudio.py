"""GauStudio: the ball, the map and the loss by hand and by differences, light behind a scene, masks, initialisers."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_inner_products, check_jacobian
from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.gaustudio import alternatives, backgrounds
from minisplat_ref.extensions.gaustudio.backgrounds import (
    BALL,
    MAP,
    ball_gaussians,
    fibonacci_directions,
    find_texels,
    look_up,
    look_up_vjp,
    put_behind,
    put_behind_vjp,
    white_ball,
    with_light,
)
from minisplat_ref.extensions.gaustudio.commands import all_stages
from minisplat_ref.extensions.gaustudio.model import mean_opacity, sky_opacity
from minisplat_ref.io.images import write_image
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.strategy.removal import CHANGES
from minisplat_ref.training.loop import train
from minisplat_ref.training.losses import Rendered, photometric
from minisplat_ref.training.recipe_settings import configure, find_alternatives, settings_of
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.training.sky import SKY
from minisplat_ref.types import Camera, Model, RenderOutput, Scene, View, view_from
from scenes import make_camera, make_gaussians
from tiny_training import all_arrays
from tiny_training import scene as scene  # a fixture
from tolerances import CLOSED_FORM, GRADIENT_STEP_IMAGE, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

BACKGROUND = np.array([0.2, 0.5, 0.8])


@pytest.fixture
def view(rng):
    return view_from(make_camera(rng=rng))


# The formulas


def test_the_lattice_by_hand():
    """Five directions have the heights 1, 1/2, 0, -1/2, -1; the third is turned by twice the golden angle."""
    d = fibonacci_directions(5)
    assert_allclose(d[:, 1], [1, 0.5, 0, -0.5, -1], atol=CLOSED_FORM)
    assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=CLOSED_FORM)
    turn = np.radians(2 * 137.50776405003785)
    assert_allclose(d[2], [np.cos(turn), 0, np.sin(turn)], atol=1e-12)
    assert fibonacci_directions(1).tolist() == [[0, 1, 0]]


def test_the_lattice_is_even():
    """Neighbours of 1,000 directions are at most 1.4 times farther apart than others; an even lattice sums to zero."""
    d = fibonacci_directions(1000)
    cosines = d @ d.T - 2 * np.eye(1000)
    gaps = np.arccos(cosines.max(axis=1))[5:-5]
    assert gaps.max() / gaps.min() < 1.4 and np.abs(d.mean(axis=0)).max() < 1e-2


def test_a_white_ball_is_white_and_overlaps():
    ball = white_ball(500)
    g = ball_gaussians(ball)
    assert_allclose(0.5 + SH_C0 * g.sh_dc, 1, rtol=1e-6)
    assert_array_equal(g.log_scales, np.repeat(ball[:, 4:], 3, axis=1))
    spacing = np.sqrt(4 * np.pi / 500)  # radians
    assert np.all((np.exp(ball[5:-5, 4]) > 0.7 * spacing) & (np.exp(ball[5:-5, 4]) < 1.5 * spacing))
    assert g.sh_rest.shape == (500, 0, 3) and ball.dtype == np.float32


def test_texels_by_hand():
    """In a map of 2 x 4 texels the +x axis is between columns 1 and 2, +y in between 2 and 3, -x between 3 and 0."""
    d = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 1e-12, 0], [0, 0, 1], [0, 0, -1]])
    found = find_texels(d, (2, 4))
    assert [found.columns[0][i] for i in range(3)] == [1, 2, 3]
    assert [found.columns[1][i] for i in range(3)] == [2, 3, 0]
    assert_allclose(found.a[:3], 0.5, atol=1e-11)
    assert_allclose(found.b, [0.5, 0.5, 0.5, 0, 1], atol=CLOSED_FORM)  # the poles are at the outer rows
    texels = np.arange(24.0).reshape(2, 4, 3)
    assert_allclose(look_up(texels, found)[0], texels[:, 1:3].mean(axis=(0, 1)), rtol=CLOSED_FORM)
    assert_allclose(look_up(texels, found)[2], (texels[:, 3] + texels[:, 0]).mean(axis=0) / 2, rtol=1e-11)


def test_gradients_of_the_map(rng):
    """With respect to the texels, and to directions that keep their length, some of them beyond the outer rows."""
    d = rng.normal(size=(12, 3))
    d[:4, 2] = (9, -9, 7, -7)  # near the poles, where only longitude counts
    sky_map = rng.normal(size=(5, 6, 3))

    def value(texels, directions):
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return (look_up(texels, find_texels(unit, texels.shape[:2])),)

    def vjp(v):
        n = np.linalg.norm(d, axis=1, keepdims=True)
        v_map, v_d = look_up_vjp(sky_map, d / n, find_texels(d / n, sky_map.shape[:2]), v)
        return v_map, (v_d - np.sum(v_d * d, axis=1, keepdims=True) * d / n**2) / n

    check_jacobian(value, vjp, (sky_map, d), names=("map", "directions"))


def test_light_behind_by_hand_and_by_differences(rng):
    """Of light 1 behind an image 0.25 with an opacity of 0.75 a quarter is seen."""
    assert put_behind(np.full((1, 1, 3), 0.25), np.full((1, 1), 0.75), np.ones((1, 1, 3))).tolist() == [[[0.5] * 3]]
    image, alpha, light = rng.uniform(size=(2, 3, 3)), rng.uniform(size=(2, 3)), rng.uniform(size=(2, 3, 3))
    check_jacobian(
        lambda a, s: (put_behind(image, a, s),),
        partial(put_behind_vjp, alpha, light),
        (alpha, light),
        names=("alpha", "light"),
    )


def test_opacity_in_a_mask_by_hand():
    alpha = np.array([[0.5, 0.25], [1.0, 0.0]])
    value, v = mean_opacity(alpha, np.array([[True, True], [False, False]]))
    assert value == 0.375 and v.tolist() == [[0.5, 0.5], [0, 0]]
    value, v = mean_opacity(alpha, np.array([[True, True], [True, False]]))
    assert value == pytest.approx(1.75 / 3) and v.tolist() == [[1 / 3, 1 / 3], [1 / 3, 0]]
    value, v = mean_opacity(alpha, np.zeros((2, 2), bool))
    assert value == 0 and not v.any()


# Backgrounds


@pytest.mark.parametrize("background", ["ball", "sky_map"])
def test_an_empty_scene_shows_the_light_alone(view, rng, background):
    """A map of one colour is that colour everywhere; a ball of opaque red Gaussians is red, but for 1 % at its gaps."""
    empty = make_gaussians(rng, 0)
    if background == "sky_map":
        light, sky = MAP, np.tile(np.array([0.1, 0.6, 0.9]), (4, 8, 1))
        expected = np.array([0.1, 0.6, 0.9])
    else:
        light, sky = BALL, white_ball(2000).astype(float)
        sky[:, :3], sky[:, 3] = (np.array([1.0, 0, 0]) - 0.5) / SH_C0, 9.0
        expected = np.array([1.0, 0, 0])
    output, _ = with_light(SPLATTING, light).render(Model(empty, {SKY: sky}), view, Request(BACKGROUND, backend=CPU))
    assert_allclose(output.image, np.broadcast_to(expected, output.image.shape), atol=1e-2)
    assert not output.alpha.any(), "the scene's own opacity"


@pytest.mark.parametrize("light", [BALL, MAP])
def test_light_has_no_parallax_and_depths_stay(rng, light):
    camera = make_camera(rng=rng)
    sky = white_ball(300).astype(float) if light is BALL else rng.uniform(size=(6, 9, 3))
    moved = camera._replace(cam_from_world_t=camera.cam_from_world_t + 5)
    images = [light.render(sky, c, Request(BACKGROUND))[0] for c in (camera, moved)]
    assert_array_equal(*images)
    g, view, depth = make_gaussians(rng, 12), view_from(camera), Request(BACKGROUND, wants=frozenset({"depth"}))
    plain = SPLATTING.render(Model(g), view, depth._replace(background=None))[0]
    behind = with_light(SPLATTING, light).render(Model(g, {SKY: sky}), view, depth)[0]
    assert_array_equal(behind.alpha, plain.alpha)
    assert_array_equal(behind.image[..., 3], plain.image[..., 3])
    assert_allclose(behind.image[..., :3], put_behind(plain.image[..., :3], plain.alpha, images[0]), rtol=1e-12)


def test_a_model_without_a_sky_is_drawn_by_3dgs(rng, view):
    g = make_gaussians(rng, 12)
    request = Request(BACKGROUND)
    plain, plain_tape = SPLATTING.render(Model(g), view, request)
    v = np.ones_like(plain.image)
    expected = SPLATTING.render_vjp(plain_tape, v, None)
    for light in (BALL, MAP):
        renderer = with_light(SPLATTING, light)
        ours, tape = renderer.render(Model(g), view, request)
        assert ours.image.tobytes() == plain.image.tobytes()
        found = renderer.render_vjp(tape, v, None)
        assert found.gaussians.means.tobytes() == expected.gaussians.means.tobytes() and not found.shared


@pytest.mark.parametrize("light", [BALL, MAP])
def test_gradients_with_light_behind(rng, light):
    """Along random directions, with a derivative of alpha; the pose turns the sky, too."""
    camera, g = make_camera(24, 16, rng=rng), make_gaussians(rng, 6)
    sky = (
        white_ball(60).astype(float) + 0.1 * rng.normal(size=(60, 5)) if light is BALL else rng.uniform(size=(5, 7, 3))
    )
    renderer = with_light(SPLATTING, light)
    v = rng.normal(size=(16, 24, 3)), rng.normal(size=(16, 24))

    def draw(sky, R, background, logits):
        posed = view_from(camera._replace(cam_from_world_R=R))
        model = Model(g._replace(opacity_logits=logits), {SKY: sky})
        return renderer.render(model, posed, Request(background, backend=REFERENCE))

    inputs = {"sky": sky, "R": camera.cam_from_world_R.astype(float), "logits": g.opacity_logits}
    if light is BALL:
        inputs["background"] = BACKGROUND

    def function(*args):
        given = {"background": BACKGROUND, **dict(zip(inputs, args, strict=True))}
        output, _ = draw(**given)
        return output.image, output.alpha

    found = renderer.render_vjp(draw(**{"background": BACKGROUND, **inputs})[1], *v)
    gradients = {
        "sky": found.shared[SKY],
        "R": found.cam_from_world_R,
        "logits": found.gaussians.opacity_logits,
        "background": found.background,
    }
    check_inner_products(
        function, [gradients[name] for name in inputs], tuple(inputs.values()), v, rng, names=tuple(inputs),
        step=GRADIENT_STEP_IMAGE,
    )  # fmt: skip


def test_what_a_gaussian_hides_is_the_light(rng, view):
    """The change of the image without a Gaussian counts the sky behind it, as for the harmonics of the core."""
    g, sky = make_gaussians(rng, 8), np.full((4, 8, 3), 0.7)
    request = Request(np.zeros(3), wants=frozenset({CHANGES}))
    behind = with_light(SPLATTING, MAP).render(Model(g, {SKY: sky}), view, request)[0]
    before_grey = SPLATTING.render(Model(g), view, request._replace(background=np.full(3, 0.7)))[0]
    assert_allclose(behind.extras[CHANGES], before_grey.extras[CHANGES], rtol=1e-9, atol=1e-12)


# Losses and masks


def rendered(view, output, step=1):
    scene = Scene("s", (), (), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(3), 1.0)
    return Rendered(output, {"rgb": slice(0, 3)}, view, scene, Model(None), step, Request(backend=REFERENCE))


def photograph(image, mask=None, name="a"):
    height, width = image.shape[:2]
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 10.0, width / 2, height / 2, width, height)
    return View(name, camera, image.astype(np.uint8), mask)


def test_the_squared_loss_by_hand():
    """Two pixels differ by 1/5 and 2/5 in all channels; then the mask leaves the first alone."""
    view = photograph(np.array([[[51] * 3, [102] * 3]]))
    output = RenderOutput(np.zeros((1, 2, 3)), np.zeros((1, 2)), None, None)
    value, v = alternatives.squared(rendered(view, output))
    assert_allclose(value, (0.04 + 0.16) / 2, rtol=CLOSED_FORM)
    assert_allclose(v.channels["rgb"][0, :, 0], [2 * -0.2 / 6, 2 * -0.4 / 6], rtol=CLOSED_FORM)
    value, v = alternatives.squared(rendered(view._replace(mask=np.array([[True, False]])), output))
    assert_allclose(value, 0.04, rtol=CLOSED_FORM)
    assert_allclose(v.channels["rgb"][0, :, 0], [2 * -0.2 / 3, 0], atol=1e-15)


def test_the_other_losses_are_those_of_3dgs(rng):
    view = photograph(rng.integers(0, 256, (12, 13, 3)))
    output = RenderOutput(rng.uniform(size=(12, 13, 3)), np.zeros((12, 13)), None, None)
    given = rendered(view, output)
    assert alternatives.l1_and_dssim(given)[0] == photometric(given, dssim_weight=0.2)[0]
    assert_allclose(alternatives.l1(given)[0], np.abs(output.image - view.image / 255).mean(), rtol=1e-6)


SKY_BLUE, CLOUD, ROAD, ROOF = (90, 140, 210), (240, 236, 230), (150, 150, 155), (60, 40, 40)


def test_the_rule_on_colours_by_hand():
    """Sky and cloud above a roof are found; a blue car below it is not, nor is a grey road that reaches the top."""
    image = np.array(
        [
            [SKY_BLUE, SKY_BLUE, CLOUD, ROOF, ROAD],
            [SKY_BLUE, ROOF, SKY_BLUE, ROOF, ROAD],
            [ROOF, ROOF, ROOF, SKY_BLUE, ROAD],
        ]
    )
    found = alternatives.by_color(photograph(image), "")
    assert_array_equal(found, [[1, 1, 1, 0, 0], [1, 0, 1, 0, 0], [0, 0, 0, 0, 0]])
    assert not alternatives.by_color(photograph(np.tile(np.array(ROOF), (2, 2, 1))), "").any()
    lawn, bright_lamp = (90, 220, 200), (255, 235, 90)  # more green than blue; bright in two channels
    assert not alternatives.by_color(photograph(np.array([[lawn, bright_lamp]])), "").any()


def test_masks_of_the_photograph_and_of_files(tmp_path):
    mask = np.array([[True, False, True, True], [True, True, True, False]])
    view = photograph(np.zeros((2, 4, 3)), mask)
    assert_array_equal(alternatives.left_out(view, ""), ~mask)
    assert alternatives.left_out(view._replace(mask=None), "") is None
    large = np.repeat(np.repeat(mask, 4, axis=0), 4, axis=1)
    write_image(tmp_path / "a.png", large)
    assert_array_equal(alternatives.from_files(view, str(tmp_path)), mask)
    with pytest.raises(InputError, match="sky_mask=from_files has no folder to read: add --set mask_folder=DIR"):
        alternatives.from_files(view, "")
    with pytest.raises(InputError, match=r"b\.png: there is no such mask; minisplat-ref gaustudio masks SCENE"):
        alternatives.from_files(view._replace(name="b"), str(tmp_path))
    write_image(tmp_path / "d.png", np.tile(mask, (25, 26))[:, :103])
    with pytest.raises(InputError, match=r"d\.png has 103 x 50 pixels"):  # 3 % wider than the photograph
        alternatives.from_files(view._replace(name="d"), str(tmp_path))
    write_image(tmp_path / "c.png", large[:4])
    with pytest.raises(InputError, match=r"c\.png has 16 x 4 pixels, which is not the shape of the photograph, 4 x 2"):
        alternatives.from_files(view._replace(name="c"), str(tmp_path))


def test_the_sky_term_counts_alpha_where_the_mask_says():
    alpha = np.array([[0.5, 0.25], [1.0, 0.0]])
    output = RenderOutput(np.zeros((2, 2, 3)), alpha, None, None)
    view = photograph(np.zeros((2, 2, 3)), np.array([[False, True], [True, False]]))
    value, v = sky_opacity(rendered(view, output), sky_mask=alternatives.left_out, mask_folder="")
    assert value == 0.25 and v.alpha.tolist() == [[0.5, 0], [0, 0.5]]
    value, v = sky_opacity(rendered(view._replace(mask=None), output), sky_mask=alternatives.left_out, mask_folder="")
    assert value == 0 and v.alpha is None


# Initialisers, representations, density


def test_initialisers(scene, rng, monkeypatch):
    g = make_gaussians(rng, 30)._replace(log_scales=np.full((30, 3), -1.0))
    assert alternatives.points(g, scene, rng) is None
    flat = alternatives.planes(g, scene, rng)
    assert_array_equal(flat.means, g.means)
    assert_allclose(flat.log_scales - g.log_scales, np.tile((0, 0, np.log(0.3)), (30, 1)), atol=1e-15)
    boxed = alternatives.box(g, scene, rng)
    low, high = np.quantile(g.means, [0.02, 0.98], axis=0)
    assert boxed.means.shape == g.means.shape and np.all((boxed.means >= low) & (boxed.means <= high))
    tight = alternatives.box(g, scene._replace(extent=0.4), rng)
    assert_allclose(np.exp(tight.log_scales), 0.02, rtol=1e-6)  # a twentieth, as 30 points lie wide apart
    assert np.exp(boxed.log_scales).max() > 0.02
    many = alternatives.box(make_gaussians(rng, 2_000), scene, rng).means
    wide = np.quantile(make_gaussians(rng, 2_000).means, [0.02, 0.98], axis=0)
    assert_allclose(np.ptp(many, axis=0), wide[1] - wide[0], rtol=0.15)  # of other 2,000: 96 % of the points
    assert not boxed.sh_dc.any() and boxed.sh_rest.shape == g.sh_rest.shape and not np.isin(boxed.means, g.means).any()
    few = type(g)(*(field[:2] for field in g))
    assert alternatives.planes(few, scene, rng) is None and alternatives.box(few, scene, rng) is None
    dense = rng.normal(size=(50, 3)), np.zeros((50, 3), np.uint8)
    monkeypatch.setattr(alternatives, "densify_points", lambda given: dense)
    found = alternatives.stereo(g, scene, rng)
    assert_allclose(found.means, dense[0], rtol=1e-6)
    assert found.sh_rest.shape[1:] == g.sh_rest.shape[1:]


def test_a_training_begins_with_what_the_initialiser_gives(scene):
    """After the first iteration there are grey Gaussians without moments, and other parameters are as trained."""
    recipe = configure(scale_recipe(find_recipe("gaustudio"), 1), initialiser=alternatives.box)
    state = train(scene, recipe, seed=0)
    assert len(state.gaussians.means) == len(scene.points) and not state.gaussians.sh_dc.any()
    assert not any(moment.any() for moment in (*state.adam.first, *state.adam.second))
    assert state.shared_adam.first[SKY].any()


def test_surfels_that_are_flat_already_keep_their_axes(rng):
    flat = make_gaussians(rng, 5)
    surfels = alternatives.surfels().extend(flat, rng)
    assert_array_equal(surfels.quats, flat.quats)
    assert_array_equal(surfels.log_scales[:, :2], flat.log_scales[:, :2])
    round_ones = flat._replace(log_scales=np.full((5, 3), -1.0))
    assert not np.isin(alternatives.surfels().extend(round_ones, rng).quats, flat.quats).any()
    assert alternatives.gaussians().extend(flat, rng) is flat


class State:
    """What density control sees: two of three Gaussians are pulled, the first of them is large."""

    def __init__(self, rng):
        sizes = np.log([[0.5] * 3, [0.001] * 3, [0.001] * 3])
        self.gaussians = make_gaussians(rng, 3)._replace(log_scales=sizes)
        self.rng = np.random.default_rng(0)
        self.stats = {"gradient_sum": np.array([4e-4, 6e-4, 3e-4]), "view_count": np.full(3, 2)}


def test_density_modules(monkeypatch, rng, scene):
    edits = []
    monkeypatch.setattr(alternatives, "apply_edit", lambda state, edit: edits.append(edit))
    monkeypatch.setattr("minisplat_ref.methods.gaussian_splatting.apply_edit", lambda state, edit: edits.append(edit))
    context = rendered(photograph(np.zeros((2, 2, 3))), None)
    state = State(rng)
    assert "fixed" in alternatives.fixed(state, context) and not edits and "gradient_sum" in state.stats
    alternatives.halves(State(rng), context)
    alternatives.clones(State(rng), context)
    halved, cloned = edits
    assert halved.parent_ids.tolist() == [0, 1, 2, 0, 1] and len(halved.gaussians.means) == 5
    assert len(cloned.gaussians.means) == 5
    assert np.sort(np.exp(cloned.gaussians.log_scales).max(axis=1))[-1] < 0.5, "the large one was split"
    for size, n_as_large in ((0.02, 0), (0.005, 2)):  # above a hundredth of the extent, 1, it is split, else cloned
        state = State(rng)
        state.gaussians.log_scales[0] = np.log(size * context.scene.extent)
        alternatives.clones(state, context)
        scales = np.exp(edits[-1].gaussians.log_scales[:, 0])
        assert np.count_nonzero(np.isclose(scales, size * context.scene.extent)) == n_as_large, size


# One stage at a time


def other_modules():
    """Every module that the recipe does not have, without stereo, which has its test, and masks, which are input."""
    for stage in all_stages():
        for name in stage.modules:
            if name not in (stage.present, "stereo") and stage.name != "sky_mask":
                yield stage.name, name


def bound(recipe, stage):
    """Return the module that a recipe has."""
    return settings_of(recipe)[stage]


def check_initialiser(trained, recipe, scene):
    assert trained.note == "nothing done: begins with the points"
    assert len(trained.first.means) == len(scene.points)
    assert np.abs(trained.first.means - scene.points).max() < 0.1


def check_representation(trained, recipe, scene):
    """The scene's opacity is that of 3DGS."""
    view = scene.train_views[0]
    ours = recipe.renderer.render(trained.model, view, Request())[0]
    plain = SPLATTING.render(Model(trained.model.gaussians), view, Request())[0]
    assert_array_equal(ours.alpha, plain.alpha)
    assert ours.alpha.max() > 0.1


def check_background(trained, recipe, scene):
    """The ball is behind whatever the scene is, and has learned something."""
    view, sky = scene.train_views[0], trained.model.shared.get(SKY, np.zeros(0))
    assert sky.shape == (backgrounds.N_BALL, 5) and np.abs(sky - white_ball(len(sky))).max() > 0.01
    ours = recipe.renderer.render(trained.model, view, Request(BACKGROUND))[0]
    without = recipe.renderer.render(trained.model._replace(shared={}), view, Request())[0]
    light, _ = BALL.render(sky, view.camera, Request(BACKGROUND))
    assert_allclose(
        ours.image[..., :3], put_behind(without.image[..., :3], ours.alpha, light), atol=PARITY_FLOAT32_IMAGE
    )


def check_photo_loss(trained, recipe, scene):
    view = scene.train_views[0]
    output = recipe.renderer.render(trained.model, view, Request())[0]
    term = next(term for term in recipe.losses if term.name == "photometric")
    given = Rendered(output, {"rgb": slice(0, 3)}, view, scene, trained.model, 1, Request())
    assert term.function(given)[0] == photometric(given, dssim_weight=0.2)[0]


def check_density(trained, recipe, scene):
    """Two Gaussians with a large gradient that are small beside the scene are doubled, and the others stay."""
    (event,) = [event for event in recipe.events if "density" in getattr(event.action, "keywords", {})]
    state, before = trained.state, trained.state.gaussians.means.copy()
    state.stats = {"gradient_sum": np.zeros(len(before)), "view_count": np.ones(len(before), int)}
    state.stats["gradient_sum"][[3, 5]] = 1.0
    context = rendered(photograph(np.zeros((2, 2, 3))), None)
    event.action(state, context._replace(scene=scene._replace(extent=1e6)))
    assert_array_equal(state.gaussians.means, np.concatenate([before, before[[3, 5]]]))


CHECKS = {
    "initialiser": check_initialiser,
    "representation": check_representation,
    "background": check_background,
    "photo_loss": check_photo_loss,
    "density": check_density,
}


class Trained:
    """A short training, and what it began with."""

    def __init__(self, scene, recipe):
        self.note, self.first = None, None
        self.state = train(scene, recipe, seed=0, on_step=self.see)
        self.model = self.state.model

    def see(self, report):
        if report.step == 1:
            self.note = report.fired[0].note
            self.first = type(report.state.gaussians)(*(field.copy() for field in report.state.gaussians))


@pytest.mark.parametrize(("stage", "name"), list(other_modules()))
def test_one_stage_is_exchanged_and_the_others_stay(scene, stage, name):
    """What is checked of the other stages is what holds for the recipe as it is; the exchanged one fails its check."""
    recipe = scale_recipe(find_recipe("gaustudio"), 12)
    swapped = configure(recipe, **{stage: find_alternatives(bound(recipe, stage))[name]})
    trained = Trained(scene, swapped)
    for other, check in CHECKS.items():
        if other == stage:
            with pytest.raises(AssertionError):
                check(trained, swapped, scene)
        else:
            check(trained, swapped, scene)


def test_without_a_background_and_the_loss_it_is_3dgs_to_the_last_byte(scene):
    plain = train(scene, scale_recipe(get_recipe("3dgs-accel"), 15), seed=2)
    recipe = configure(scale_recipe(find_recipe("gaustudio"), 15), background=backgrounds.nothing, sky_opacity=0.0)
    ours = train(scene, recipe, seed=2)
    assert not ours.shared
    for name, array in all_arrays(plain).items():
        assert array.tobytes() == all_arrays(ours)[name].tobytes(), name


def test_parity_of_backends(rng, view):
    model = Model(make_gaussians(rng, 12), {SKY: white_ball(200).astype(float)})
    renderer = find_recipe("gaustudio").renderer
    images = [
        renderer.render(model, view, Request(BACKGROUND, backend=backend))[0].image for backend in (CPU, REFERENCE)
    ]
    assert_allclose(*images, atol=PARITY_FLOAT64)
