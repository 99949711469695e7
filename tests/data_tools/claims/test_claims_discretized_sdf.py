"""The discretised SDF: measures of the sphere, which are zero for the truth."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from data_tools.claims import discretized_sdf as claim
from minisplat_ref.extensions.discretized_sdf.model import WIDTH
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.types import Model, RenderOutput


@pytest.fixture
def small_claim(monkeypatch):
    for name, value in {"WIDTH_PX": 24, "HEIGHT_PX": 18, "N_SURFELS": 300, "STEPS": 8, "N_VIEWS": 2}.items():
        monkeypatch.setattr(claim, name, value)


def test_the_sphere_is_measured_as_it_says(small_claim, monkeypatch):
    rng = np.random.default_rng(0)
    g, truths = claim.noisy_sphere(rng), [claim.trace(camera) for camera in claim.cameras(rng, 2)]
    for truth in truths:
        assert_allclose(np.linalg.norm(truth.normals, axis=1), 1, rtol=1e-9)
        in_camera = truth.normals @ truth.camera.cam_from_world_R[2] + truth.camera.cam_from_world_t[2]
        assert_allclose(in_camera, truth.depth, rtol=1e-9)
    exact = g._replace(distances=np.linalg.norm(g.means, axis=1) - 1)
    found = claim.measure(exact, claim.opacities(exact, WIDTH), truths)
    assert found["radius_error"] < 1e-9 and found["consistency"] < 1e-9
    assert_allclose(found["slope"], 1, atol=0.02)  # normals of neighbours differ
    farther = exact._replace(
        means=1.2 * exact.means / np.linalg.norm(exact.means, axis=1)[:, None], distances=0 * g.distances
    )
    assert claim.measure(farther, np.full(300, 9.0), truths)["depth_bias"] < -0.1
    moved, logits = claim.project_sphere(exact, truths, claim.ARMS[0])
    assert_array_equal(moved.quats, g.quats)
    assert (moved.distances != exact.distances).any() and (logits < claim.opacities(moved, WIDTH)).any()
    monkeypatch.setattr(claim, "STEPS", 1)  # the first step of Adam is as long as the rate, whatever the gradient
    moved, _ = claim.project_sphere(exact, truths, claim.ARMS[2])
    for name, rate in claim.RATES.items():
        steps = np.abs(getattr(moved, name) - getattr(exact, name))
        assert_allclose(np.max(steps), rate, rtol=1e-6)


def test_the_albedo_is_compared_up_to_a_factor(small_claim):
    """A renderer of the truth has no error, whatever the factor; one of a wrong albedo has."""
    _, truths = claim.glossy_sphere(np.random.default_rng(0))
    shared = {ENVIRONMENT: np.zeros((4, 8, 3))}

    def render(model, view, request, factor=0.5):
        truth = claim.trace(view.camera)
        light = claim._light(0 if model.shared[ENVIRONMENT] is shared[ENVIRONMENT] else 1)
        image = np.zeros((18, 24, 6))
        image[..., :3] = claim.photograph(truth, light) + 1e-7
        image[truth.is_sphere, 3:] = claim.albedo_at(truth.normals) ** (1 if factor else 2) * 0.5
        if "albedo" not in request.wants:
            image = image[..., :3]
        return RenderOutput(image, truth.is_sphere.astype(float), None, None), None

    found, _ = claim.compare(Model(None, shared), render, truths)
    assert found["albedo_error"] < 1e-9 and found["psnr"] > 100
    assert found["relit_psnr"] > 30  # clipped highlights are not scaled exactly
    wrong, _ = claim.compare(Model(None, shared), lambda *a: render(*a, factor=0), truths)
    assert wrong["albedo_error"] > 0.02
