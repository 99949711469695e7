"""Our renderer against the oracle: images and gradients, stage by stage, one test for each scene."""

import pytest
from my_renderer import rasterization, rasterization_vjp  # torch and JAX need no vjp: leave it out

from minisplat_ref.testing import assert_matches_oracle


@pytest.mark.parametrize("scene", ["ordinary", "antialiased", "off-centre", "sh3", "odd-size", "planes"])
def test_scene(scene):
    assert_matches_oracle(rasterization, rasterization_vjp, scenes=[scene], dtype="float32")
