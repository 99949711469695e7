"""The scenes of the golden vectors: small, random, and each with one thing that renderers get wrong.

Numbers are rounded to float32, so that float32 and float64 renderers are given the same problem; only the rotation is
not, which would no longer be one.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, INRIA, Conventions
from minisplat_ref.oracle.golden.arrays import Arrays
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Floats


class Recipe(NamedTuple):
    """How a scene is drawn."""

    name: str
    what: str  # one line: what it is for
    conventions: Conventions
    size: tuple[int, int] = (48, 32)  # px
    principal_point: tuple[float, float] = (0.5, 0.5)  # part of the size
    sh_degree: int = 2
    scales: tuple[float, float] = (0.05, 0.5)  # world units, drawn uniformly in their logarithm
    spread: float = 1.0  # of the centres, in half images around the image's middle
    n: int = 150


class Golden(NamedTuple):
    """A scene with arrays of the golden format: its inputs alone, or all."""

    name: str
    what: str
    conventions: Conventions
    arrays: Arrays

    @property
    def camera(self) -> Camera:
        """The view, in float64."""
        a = self.arrays
        fx, fy, cx, cy = map(float, a["intrinsics"])
        width, height = map(int, a["image_size"])
        return Camera(a["cam_from_world_R"], a["cam_from_world_t"], fx, fy, cx, cy, width, height)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics; all that is stored is used."""
        return round((self.arrays["sh_rest"].shape[1] + 1) ** 0.5) - 1


RECIPES = (
    Recipe("ordinary", "dense, opaque in places: clamped alpha and finished pixels", GSPLAT_MAIN),
    Recipe(
        "antialiased",
        "Gaussians thinner than a pixel, opacities compensated",
        GSPLAT_MAIN._replace(name="ANTIALIASED", is_antialiased=True),
        scales=(0.004, 0.12),
        n=200,
    ),
    Recipe(
        "inria", "the rules of the 3DGS rasteriser; the principal point must be ignored", INRIA, (48, 32), (0.4, 0.6)
    ),
    Recipe("off-centre", "principal point far from the middle of the image", GSPLAT_MAIN, (48, 32), (0.15, 0.9)),
    Recipe("sh3", "spherical harmonics of degree 3; colours clamped at 0", GSPLAT_MAIN, sh_degree=3),
    Recipe(
        "odd-size",
        "no tile divides 37 x 23; wide spread, so that the Jacobian's clamp acts",
        GSPLAT_MAIN,
        (37, 23),
        (0.35, 0.6),
        scales=(0.1, 1.2),
        spread=2.2,
    ),
)
FOCAL = (41.5, 38.25)  # px
DEPTHS = (1.5, 6.0)  # world units
DSSIM_WEIGHT = 0.2


def inputs(recipe: Recipe, seed: int = 0) -> Golden:
    """Scene of a recipe with its inputs.

    Parameters
    ----------
    recipe : Recipe
        One of :data:`RECIPES`.
    seed : int
        Of all that is random.

    Returns
    -------
    Golden
        Arrays of the role "input", except what depends on a renderer.
    """
    rng = np.random.default_rng((seed, *recipe.name.encode()))
    size, center = np.array(recipe.size), np.multiply(recipe.size, recipe.principal_point)
    R = rotation_matrices(np.array([[1.0, 0.21, -0.34, 0.13]]))[0]
    t = np.array([0.25, -0.5, 0.75])
    z = np.sort(rng.uniform(*DEPTHS, recipe.n))[rng.permutation(recipe.n)]
    pixels = size * (0.5 + recipe.spread * rng.uniform(-0.5, 0.5, (recipe.n, 2)))
    means_cam = np.column_stack([(pixels - center) / FOCAL * z[:, None], z])
    n_rest = (recipe.sh_degree + 1) ** 2 - 1
    low, high = np.log(recipe.scales)
    arrays: dict[str, Floats] = {
        "means": np.linalg.solve(R, (means_cam - t).T).T,
        "quats": rng.normal(size=(recipe.n, 4)),
        "scales": np.exp(rng.uniform(low, high, (recipe.n, 3))),
        "opacities": np.minimum(1, rng.uniform(0.05, 1.3, recipe.n)),
        "sh_dc": rng.normal(size=(recipe.n, 3)),
        "sh_rest": 0.3 * rng.normal(size=(recipe.n, n_rest, 3)),
        "background": np.array([0.1, 0.4, 0.7]),
        "cam_from_world_t": t,
        "intrinsics": np.array([*FOCAL, *center]),
        "target": rng.uniform(size=(size[1], size[0], 3)),
        "dssim_weight": np.array(DSSIM_WEIGHT),
    }
    rounded: Arrays = {name: array.astype(np.float32).astype(np.float64) for name, array in arrays.items()}
    exact: Arrays = {"cam_from_world_R": R, "image_size": size.astype(np.int32)}
    return Golden(recipe.name, recipe.what, recipe.conventions, rounded | exact)
