"""Reflective surfels: what the mirror shows, and normals that lean towards the camera."""

import numpy as np

from data_tools.claims import reflective as claim
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL
from minisplat_ref.mechanisms.gbuffer.prefilter import prefilter
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.types import view_from


def test_the_claim_measures_what_it_says(monkeypatch):
    """The truth has no error; a moved highlight is off; what is hidden is dark; the environment is approached."""
    monkeypatch.setattr(claim, "WIDTH", 32)
    monkeypatch.setattr(claim, "HEIGHT", 24)
    monkeypatch.setattr(claim, "STEPS", 4)
    light, rng = prefilter(claim.environment()), np.random.default_rng(0)
    truths = [claim.trace(camera, light, hides=True) for camera in claim._cameras(rng)[:4]]
    exact = []
    for truth in truths:
        normals = np.zeros((24, 32, 3))
        normals[truth.is_sphere] = truth.normals @ truth.camera.cam_from_world_R.T
        exact.append(np.concatenate([np.clip(truth.image, 0, 1), normals], axis=2))
    with np.errstate(divide="ignore"):
        found = claim.compare(truths, exact)
    assert found["psnr"] == np.inf and found["highlight"] == 0 and found["normal_error"] < 1e-5
    moved = claim.compare(truths, [np.roll(image, 2, axis=1) for image in exact])
    assert moved["psnr"] < 30 and 0.5 < moved["highlight"] < 4
    assert any(truth.is_hidden.any() for truth in truths)
    records = claim._occlusion(truths, rng)
    assert records[1]["hidden_psnr"] > records[0]["hidden_psnr"] + 3
    recovered = claim.recover(truths, rng)
    assert recovered["error_after"] < recovered["error_before"]


def test_blending_by_centres_makes_normals_lean_towards_the_camera():
    """As docs/family/reflective.md says: on a sphere, the blended normal is nearer to the view than the true one."""
    [camera, *_] = claim._cameras(np.random.default_rng(0))
    truth = claim.trace(camera, prefilter(claim.environment()))
    metal = claim.metal_of(claim.sphere_of(500, 0.0, np.random.default_rng(0)))
    request = Request(wants=frozenset({"normal"}))
    output, _ = REFLECTIVE.render(claim.model_of(metal, PER_PIXEL), view_from(camera), request)
    found = (
        output.image[truth.is_sphere][:, 3:6] / np.linalg.norm(output.image[truth.is_sphere][:, 3:6], axis=1)[:, None]
    )
    rays = pinhole_rays(np.arange(96) + 0.5, np.arange(72)[:, None] + 0.5, camera)[truth.is_sphere]
    to_camera = -rays / np.linalg.norm(rays, axis=1)[:, None]
    expected = truth.normals @ camera.cam_from_world_R.T
    assert (np.sum(found * to_camera, axis=1) > np.sum(expected * to_camera, axis=1)).mean() > 0.95
