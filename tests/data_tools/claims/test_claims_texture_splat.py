"""The wall of bricks by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.claims import texture_splat as claim


def test_the_wall_of_the_claim(monkeypatch):
    """Bricks slope outward at their edges; mortar is flat; maps of the truth have no error; floats do not exceed."""
    rng = np.random.default_rng(0)
    wall = claim.make_wall(rng)._replace(shifts=np.zeros(16))
    points = np.array([[0.2, 0.08], [0.395, 0.08], [0.0101, 0.08], [0.39 - 0.03, 0.08]])
    albedo, normals = claim.look_up(wall, points)
    assert_allclose(albedo[[0, 2]], wall.bricks[[0, 0], [0, 0]])
    assert_allclose(albedo[1], wall.mortar)
    assert_allclose(normals[:2], [[0, 0, 1], [0, 0, 1]], atol=1e-12)
    assert normals[2, 0] == pytest.approx(-0.8 / np.hypot(1, 0.8), rel=0.01)
    assert normals[3, 0] == pytest.approx(0.4 / np.hypot(1, 0.4), rel=1e-9)
    monkeypatch.setattr(claim, "WIDTH", 32)
    monkeypatch.setattr(claim, "HEIGHT", 24)
    maps = [claim.trace(camera, wall) for camera in claim.cameras(rng, 2)]
    with np.errstate(divide="ignore"):
        exact = claim.compare(maps, tuple(m.materials[:, :, :3] for m in maps), tuple(m.normals for m in maps))
    assert exact["albedo_psnr"] == np.inf and exact["angle"] < 1e-5
    for arm, size, population in claim.arms(rng):
        if arm != claim.TEXTURES:
            degree = 3 if arm == claim.MORE else 0
            coarse = next(p for a, t, p in claim.arms(np.random.default_rng(0)) if (a, t) == (claim.TEXTURES, size))
            floats, most = (len(p.means) * claim.floats_of(p, degree) for p in (population, coarse))
            assert 0.8 * most < floats <= most
