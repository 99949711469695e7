"""A plane seen by satellites, for tests of shears and of surface models."""

import numpy as np
import pytest

from data_tools.claims.satellite import boxes
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.satellite.model import IN_SHADOW, RADIOMETRY
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.types import Model
from scenes import as_dtype


@pytest.fixture(scope="module")
def plateau():
    """An opaque, textured plane at 6 m of altitude, so that a shear moves what is seen, and changes nothing of it."""
    truth = boxes.make_scene(0, n_points=4, size=16)
    state = initial_state(truth.scene, find_recipe("satellite", 10), 0)
    places = np.stack(np.meshgrid(*[np.linspace(-2, 2, 61)] * 2), axis=-1).reshape(-1, 2)
    n = len(places)
    waves = np.sin(3 * places[:, :1] + [0, 1, 2]) + np.cos(4 * places[:, 1:] + [0, 1, 2])
    g = as_dtype(state.gaussians, np.float64)._replace(
        means=np.column_stack([places, np.full(n, 6 / boxes.SCALE)]),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.log(np.tile([0.05, 0.05, 1e-4], (n, 1))),
        opacity_logits=np.full(n, 6.0),
        sh_dc=0.3 * waves,
        sh_rest=np.zeros((n, 0, 3)),
    )
    return Model(g, {RADIOMETRY: np.eye(3, 4)[None], IN_SHADOW: np.full((1, 3), 0.05)}), truth.scene
