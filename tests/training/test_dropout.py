"""DropGaussian: what a rendering leaves out, opacities that make up for it, and the setting in whole trainings."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.methods import get_recipe
from minisplat_ref.rendering import SPLATTING, Request, render, wrap
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.case import Case, load_case, save_case
from minisplat_ref.training.dropout import drop_share, leave_out
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure, parse_settings
from minisplat_ref.training.saved_state import load_state, save_state
from minisplat_ref.training.schedule import describe
from minisplat_ref.types import Model, view_from
from scenes import make_camera, make_gaussians
from tolerances import GRADIENT_REL, PARITY_FLOAT64, SAMPLE_MEAN


def test_the_share_rises_linearly_and_stays():
    assert [drop_share(0.2, step, 100) for step in (1, 50, 100, 250)] == [0.002, 0.1, 0.2, 0.2]
    assert drop_share(0.0, 50, 100) == 0


def test_a_recipe_with_a_schedule_has_its_own_length_and_an_open_one_3000():
    for iterations in (30_000, 700):
        recipe = configure(get_recipe("3dgs", iterations), dropout=0.2)
        assert recipe.drop_share(iterations) == 0.2 and recipe.drop_share(iterations // 2) == 0.1
    recipe = configure(get_recipe("adaptive", 9_000), dropout=0.2)
    assert [recipe.drop_share(step) for step in (1_500, 3_000, 8_000)] == [0.1, 0.2, 0.2]


def test_rows_are_left_out_at_random_and_hidden_ones_stay_hidden(rng):
    request = leave_out(Request(), 8_000, 0.2, rng)
    assert abs(request.is_visible.mean() - 0.8) < SAMPLE_MEAN
    assert request.opacity_factor == 1.25
    shown = np.arange(8_000) % 2 == 0
    half = leave_out(Request(is_visible=shown), 8_000, 0.2, rng)
    assert not half.is_visible[~shown].any() and abs(half.is_visible[shown].mean() - 0.8) < SAMPLE_MEAN
    assert shown.sum() == 4_000  # the mask that was given is not changed


@pytest.mark.parametrize("is_compiled", [False, True])
def test_opacities_are_multiplied(is_compiled, rng):
    """As if their logits were those of the greater opacities, as long as these are below 1."""
    gaussians = make_gaussians(rng, 12)
    o = rng.uniform(0.1, 0.7, 12)
    settings = {} if is_compiled else {"backend": REFERENCE}
    by_factor, _ = render(with_opacities(gaussians, o), make_camera(), opacity_factor=1.25, **settings)
    by_logits, _ = render(with_opacities(gaussians, 1.25 * o), make_camera(), **settings)
    assert_allclose(by_factor.image, by_logits.image, rtol=PARITY_FLOAT64, atol=PARITY_FLOAT64)
    plain, _ = render(with_opacities(gaussians, o), make_camera(), **settings)
    assert np.abs(by_factor.image - plain.image).max() > 0.01


def with_opacities(gaussians, opacities):
    return gaussians._replace(opacity_logits=np.log(opacities) - np.log1p(-opacities))


def test_opacities_above_one_by_both_derivations(rng):
    """The limit of alpha, its gradient, and footprints that are cut where alpha falls below 1 / 255."""
    gaussians = with_opacities(make_gaussians(rng, 12), rng.uniform(0.7, 0.95, 12))
    v_image = rng.normal(size=(18, 24, 3))
    model, view = Model(gaussians), view_from(make_camera())
    found = []
    for backend in ({"backend": REFERENCE}, {}):
        request = Request(conventions=GSPLAT_MAIN, opacity_factor=1.25, **backend)
        output, tape = SPLATTING.render(model, view, request)
        found.append((output.image, *SPLATTING.render_vjp(tape, v_image, None).gaussians))
    for ours, theirs in zip(*found, strict=True):
        assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max(initial=0))
    assert np.abs(found[0][4]).max() > 0


def test_the_gradient_of_the_logits(rng):
    gaussians = with_opacities(make_gaussians(rng, 5), rng.uniform(0.2, 0.7, 5))
    view = view_from(make_camera(8, 6, fx=10.0, fy=9.0))
    request = Request(backend=REFERENCE, opacity_factor=1.25)

    def image(logits):
        return (SPLATTING.render(Model(gaussians._replace(opacity_logits=logits)), view, request)[0].image,)

    def vjp(v_image):
        _, tape = SPLATTING.render(Model(gaussians), view, request)
        return (SPLATTING.render_vjp(tape, v_image, None).gaussians.opacity_logits,)

    check_jacobian(image, vjp, [gaussians.opacity_logits], names=["opacity_logits"], rel=GRADIENT_REL)


# --- the setting ---


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", n_views=5, width=24, height=18, supersampling=1, n_points=80).scene


def noting(recipe, requests):
    """The recipe with a renderer that notes the requests that it gets."""

    def change(model, view, request):
        requests.append(request)
        return (model, view, request), None

    renderer = wrap(SPLATTING, "noting", change, lambda record, v: v)
    return recipe._replace(representation=recipe.representation._replace(renderer=renderer))


def test_a_training_leaves_out_more_and_more(scene):
    requests = []
    recipe = noting(configure(get_recipe("3dgs", 40), dropout=0.5), requests)
    train(scene, recipe, seed=0)
    assert_allclose([r.opacity_factor for r in requests], [1 / (1 - 0.5 * k / 40) for k in range(1, 41)])
    shares = [1 - r.is_visible.mean() for r in requests]
    assert shares[0] < 0.1 < 0.35 < np.mean(shares[-8:]) < 0.55
    assert not np.array_equal(requests[-1].is_visible, requests[-2].is_visible)


@pytest.mark.parametrize("name", ["3dgs", "adaptive", "mini-splatting2", "mcmc"])
def test_off_it_asks_for_nothing_and_changes_no_description(name):
    recipe = find_recipe(name)
    assert recipe.dropout == 0 and configure(recipe, dropout=0.0) == recipe
    assert "dropout" not in describe(recipe)
    assert describe(configure(recipe, dropout=0.1))["dropout"] == 0.1


def test_off_it_draws_no_random_number(scene):
    """After three iterations the generator has made one permutation of the five views, and nothing else."""
    requests = []
    state = train(scene, noting(get_recipe("3dgs", 300)._replace(iterations=3), requests), seed=7)
    expected = np.random.default_rng(7)
    expected.permutation(list(range(len(scene.train_views))))
    assert state.rng.bit_generator.state == expected.bit_generator.state
    assert all(r.is_visible is None and r.opacity_factor == 1 for r in requests)


def test_a_resumed_run_has_the_same_bytes(scene, tmp_path):
    recipe = configure(get_recipe("3dgs", 24), dropout=0.3)
    whole = train(scene, recipe, seed=3)
    path = tmp_path / "half.npz"

    def save_halfway(report):
        if report.step == 11:
            save_state(path, report.state, recipe)

    train(scene, recipe, seed=3, on_step=save_halfway)
    resumed = train(scene, recipe, seed=99, state=load_state(path, recipe))
    for name, field in whole.gaussians._asdict().items():
        assert field.tobytes() == getattr(resumed.gaussians, name).tobytes()
    other = train(scene, configure(recipe, dropout=0.0), seed=3)
    assert not np.array_equal(other.gaussians.means, whole.gaussians.means)
    with pytest.raises(InputError, match="other settings"):
        load_state(path, configure(recipe, dropout=0.2))


def test_a_saved_case_keeps_what_was_left_out(scene, tmp_path):
    recipe, shown = get_recipe("3dgs"), np.array([True, False, True])
    gaussians = make_gaussians(np.random.default_rng(0), 3)
    request = Request(is_visible=shown, opacity_factor=1.25)
    case = Case(5, Model(gaussians), scene.train_views[0], scene, request, recipe)
    save_case(tmp_path / "case.npz", case, "nothing", {})
    read = load_case(tmp_path / "case.npz").of(recipe).request
    assert read.opacity_factor == 1.25
    assert_array_equal(read.is_visible, shown)


@pytest.mark.parametrize("name", ["lens", "surfels", "antialiasing"])
def test_renderers_that_scale_opacities_do(name, rng):
    representation = find_recipe(name).representation
    gaussians = make_gaussians(rng, 8)
    view = view_from(make_camera())

    def image(opacities, factor):
        population = representation.extend(with_opacities(gaussians, opacities), np.random.default_rng(0))
        request = Request(backend=REFERENCE, opacity_factor=factor)
        return representation.renderer.render(Model(population), view, request)[0].image

    o = rng.uniform(0.2, 0.7, 8)
    assert representation.renderer.scales_opacities
    assert_allclose(image(o, 1.25), image(1.25 * o, 1.0), rtol=1e-9, atol=1e-9)
    assert np.abs(image(o, 1.25) - image(o, 1.0)).max() > 1e-3


@pytest.mark.parametrize("text", ["1", "-0.1", "1.5", "inf"])
def test_shares_beyond_0_and_1_are_refused(text):
    with pytest.raises(InputError, match=f"--set dropout={text}: the share that is left out is at least 0 and below 1"):
        parse_settings(get_recipe("3dgs"), {"dropout": text})


@pytest.mark.parametrize("name", ["dropout", "dssim_weight"])
def test_a_share_is_a_number(name):
    with pytest.raises(InputError, match=f"--set {name}=none is not a number"):
        parse_settings(get_recipe("3dgs"), {name: "none"})


def test_a_renderer_that_cannot_is_refused_by_name():
    recipe = find_recipe("rays")
    assert configure(recipe, dropout=0.0) == recipe
    with pytest.raises(InputError, match=r"recipe rays: renderer .* cannot make up for Gaussians that are left out"):
        configure(recipe, dropout=0.2)


def test_the_command_line(tmp_path):
    size = {"n_views": 8, "width": 24, "height": 18, "n_points": 120}
    write_scene(make_scene("room", supersampling=1, **size), tmp_path / "scene", size)
    out = tmp_path / "run"
    arguments = ["train", str(tmp_path / "scene"), "--iterations", "30", "--set", "dropout=0.2"]
    assert main([*arguments, "--out", str(out)]) == 0
    config = json.loads((out / "config.json").read_text())
    assert config["recipe"]["name"] == "adaptive" and config["recipe"]["dropout"] == 0.2
    psnr = json.loads((out / "metrics.json").read_text())["psnr"]
    assert main(["eval", str(out)]) == 0
    assert json.loads((out / "metrics.json").read_text())["psnr"] == psnr
