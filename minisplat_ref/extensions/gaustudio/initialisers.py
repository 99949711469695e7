"""The stage ``initialiser``: the Gaussians with which a training begins.

An alternative takes the Gaussians of the scene's points, and the scene; None leaves the former as they are.
"""

import numpy as np

from minisplat_ref.mechanisms.oriented.planes import N_AXES, flatten_on_planes
from minisplat_ref.strategy.initialization import gaussians_from_means, gaussians_from_points
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.dense_start import densify_points
from minisplat_ref.types import Gaussians, Scene

BOX_SHARE = 0.02  # of the points that may lie outside of the box on either side of an axis
LARGEST = 0.05  # of the scene's extent, a standard deviation in the box: density control removes those above 0.1


def points(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """A round Gaussian at each point of the scene, as in 3DGS."""
    return None


def planes(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """The same, flattened onto the planes of their neighbours."""
    return None if n_rows(gaussians) < N_AXES else flatten_on_planes(gaussians, gaussians.means)


def stereo(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """The scene's points, and points between them that stereo finds."""
    found, colors = densify_points(scene)
    degree = int(np.sqrt(gaussians.sh_rest.shape[1] + 1)) - 1
    return None if len(found) <= N_AXES else gaussians_from_points(found, colors, degree)


def box(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """As many, grey, at random in the box of the points.

    They are no larger than a twentieth of the scene's extent.
    """
    if n_rows(gaussians) <= N_AXES:
        return None
    low, high = np.quantile(gaussians.means.astype(np.float64), [BOX_SHARE, 1 - BOX_SHARE], axis=0)
    means = rng.uniform(low, high, gaussians.means.shape)
    made = gaussians_from_means(means, np.zeros_like(gaussians.sh_dc), int(np.sqrt(gaussians.sh_rest.shape[1] + 1)) - 1)
    return made._replace(
        log_scales=np.minimum(made.log_scales, made.log_scales.dtype.type(np.log(LARGEST * scene.extent)))
    )
