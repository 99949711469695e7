"""Conics with a payload: the properties that all kinds share, each tested with its own population."""

import numba
import numpy as np
import pytest
from numpy.testing import assert_allclose

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.gradients import inner_product_case
from minisplat_ref.oracle.models import check_model_gradients
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Gaussians, Model, view_from
from payloads import BACKGROUND, CASES, drawn, random_textures
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import COVERAGE_MIN, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

OF_ALL = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


@OF_ALL
def test_the_gradient_of_the_whole_model(case, small_proof):
    """On kernels; the reference's is checked for every extension by test_every_extension.py."""
    report = check_model_gradients(CPU, GSPLAT_MAIN, case.representation, case.stages)
    assert len(report.cases) == 2 and report.n_failed == 0, report.cases


@OF_ALL
def test_a_wrong_gradient_is_found(case, monkeypatch):
    path, function = case.formula
    monkeypatch.setattr(path, lambda *args: tuple(1.001 * v for v in function(*args)))
    rng = np.random.default_rng(SEED)
    (stage,) = case.stages(REFERENCE, tiny_setting(GSPLAT_MAIN), rng)
    result = inner_product_case(stage, rng)
    assert not result.passed and "is wrong" in result.note


@OF_ALL
@pytest.mark.parametrize(
    ("dtype", "image_rel", "gradient_rel"),
    [(np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64), (np.float32, PARITY_FLOAT32_IMAGE, PARITY_FLOAT32_GRADIENT)],
)
@pytest.mark.parametrize("size", [0.15, 0.6])
def test_kernels_and_reference_agree(case, dtype, image_rel, gradient_rel, size, rng):
    """The second scene has Gaussians as large as the image, and the camera is inside some of them."""
    population, view = case.random(rng, make_gaussians(rng, 40, size=size)), view_from(make_camera(rng=rng))
    agree(case, population, view, dtype, image_rel, gradient_rel)


def test_kernels_and_reference_agree_on_textures_of_a_lower_degree(rng):
    """The kernels pad them with zeros."""
    population, view = random_textures(rng, make_gaussians(rng, 40), 2), view_from(make_camera(rng=rng))
    agree(CASES["textured"], population, view, np.float64, PARITY_FLOAT64, 10 * PARITY_FLOAT64)


def agree(case, population, view, dtype, image_rel, gradient_rel):
    renderer = case.representation.renderer
    (ours, v_ours), (theirs, v_theirs) = (
        drawn(renderer, as_dtype(population, dtype), view, CPU),
        drawn(renderer, population, view, REFERENCE, compared_to=dtype),
    )
    assert ours.image.dtype == dtype and theirs.alpha.max() > COVERAGE_MIN
    assert np.abs(ours.image - theirs.image).max() <= image_rel * np.abs(theirs.image).max()
    for name, expected in v_theirs.gaussians._asdict().items():
        found, scale = getattr(v_ours.gaussians, name), np.abs(expected).max()
        assert found.dtype == dtype and (scale == 0) == (name in case.not_learnt)
        assert np.abs(found - expected).max() <= gradient_rel * scale, name


@OF_ALL
def test_without_a_payload_they_are_3dgs_to_the_last_byte(case, backend, rng):
    gaussians, view = make_gaussians(rng, 30), view_from(make_camera(rng=rng))
    with_depth = not case.has_own_depths
    ours, v_ours = drawn(case.representation.renderer, case.plain(gaussians), view, backend, with_depth=with_depth)
    theirs, v_theirs = drawn(SPLATTING, gaussians, view, backend, with_depth=with_depth)
    assert theirs.alpha.max() > COVERAGE_MIN and ours.image.tobytes() == theirs.image.tobytes()
    for name in Gaussians._fields:
        assert getattr(v_ours.gaussians, name).tobytes() == getattr(v_theirs.gaussians, name).tobytes(), name


@OF_ALL
def test_payloads_that_change_nothing(case, backend, rng):
    gaussians, view = make_gaussians(rng, 30), view_from(make_camera(rng=rng))
    with_depth = not case.has_own_depths
    ours, _ = drawn(case.representation.renderer, case.harmless(gaussians), view, backend, with_depth=with_depth)
    theirs, _ = drawn(SPLATTING, gaussians, view, backend, with_depth=with_depth)
    assert_allclose(ours.image, theirs.image, atol=PARITY_FLOAT64)


@OF_ALL
def test_the_number_of_threads_does_not_change_a_byte(case, rng):
    population = as_dtype(case.random(rng, make_gaussians(rng, 60)), np.float32)
    view, threads, results = view_from(make_camera(48, 40, rng=rng)), numba.get_num_threads(), []
    try:
        for n in (1, min(2, threads)):
            numba.set_num_threads(n)
            output, v = drawn(case.representation.renderer, population, view, CPU)
            results.append([output.image.tobytes(), *(field.tobytes() for field in v.gaussians)])
    finally:
        numba.set_num_threads(threads)
    assert results[0] == results[1]


@OF_ALL
def test_no_gaussians_and_statistics(case, backend, rng):
    """The weights of all Gaussians add up to the alpha of the image."""
    render, view = case.representation.renderer.render, view_from(make_camera())
    none, some = (as_dtype(case.random(rng, make_gaussians(rng, n)), np.float32) for n in (0, 5))
    assert render(Model(none), view, Request(backend=backend))[0].image.max() == 0
    output, _ = render(Model(some), view, Request(backend=backend, wants=frozenset({"stats", "median_depth"})))
    assert output.stats.hit_count.sum() > 0 and output.median_depth.shape == output.alpha.shape
    assert_allclose(output.stats.blend_weight_sum.sum(), output.alpha.sum(), rtol=1e-4)
    with pytest.raises(InputError, match="surface"):
        render(Model(some), view, Request(backend=backend, wants=frozenset({"surface"})))


@OF_ALL
def test_rows_that_are_hidden_and_the_depth(case, backend, rng):
    """Hidden rows draw nothing and have no gradient; the depth is a channel with the weights of the colours."""
    renderer, view = case.representation.renderer, view_from(make_camera(rng=rng))
    population = case.random(rng, make_gaussians(rng, 20))
    is_visible = np.arange(20) % 3 > 0
    kept = type(population)(*(field[is_visible] for field in population))
    asks = Request(BACKGROUND, 1, backend=backend, wants=frozenset({"depth"}))
    output, tape = renderer.render(Model(population), view, asks._replace(is_visible=is_visible))
    alone, _ = renderer.render(Model(kept), view, asks)
    assert output.image.shape[2] == 4 and output.image[..., 3].max() > 1
    assert_allclose(output.image, alone.image, atol=PARITY_FLOAT64)
    v = renderer.render_vjp(tape, np.ones_like(output.image), None)
    assert np.abs(v.gaussians.means[is_visible]).max() > 0 and not v.gaussians.means[~is_visible].any()
    assert not v.gaussians.sh_rest[:, 3:].any()  # degrees above 1
