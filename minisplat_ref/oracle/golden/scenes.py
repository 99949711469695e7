"""The scenes of the golden vectors: how their inputs are drawn, and how any backend's stages make all arrays of them.

The scenes are small, random, and each has one thing that renderers get wrong. Their numbers are rounded to float32, so
that float32 and float64 renderers are given the same problem; only the rotation is not, which would no longer be one.
Fed with the arrays of a truth, every stage by itself is given the truth's input, so that an error stays in its stage.
"""

from collections import ChainMap
from typing import NamedTuple

import numpy as np

from minisplat_ref.backends import REFERENCE, Backend
from minisplat_ref.constants import GSPLAT_MAIN, INRIA, Conventions
from minisplat_ref.oracle.golden.format import STAGE_COTANGENTS, Arrays, Golden
from minisplat_ref.oracle.thresholds import thresholds
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Floats, Primitives, Projection, ProjectionGradient, RenderOutput, TileBins, TileGrid


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


# Fields of a stage's result, by array.
PROJECTION = ("means2d", "depths", "conics", "opacities2d", "radii", "boxes")
PROJECT_GRADIENT = ("v_means_projection", "v_quats", "v_scales", "v_opacities", "v_R_projection", "v_t_projection")
COLORS_GRADIENT = ("v_means_colors", "v_sh_dc", "v_sh_rest", "v_R_colors", "v_t_colors")
COMPOSITE_GRADIENT = ("v_means2d", "v_conics", "v_opacities2d", "v_colors", "v_background")


def projection_of(arrays: Arrays) -> Projection:
    """Projection of the arrays of these names."""
    return Projection(*(arrays[name] for name in PROJECTION))


def grid_of(arrays: Arrays, tile_size: tuple[int, int]) -> TileGrid:
    """Tiles of any size over the image."""
    width, height = map(int, arrays["image_size"])
    return TileGrid(width, height, *tile_size)


def reference_bins(arrays: Arrays, conventions: Conventions, tile_size: tuple[int, int]) -> TileBins:
    """Tile lists that the reference makes of a projection, on tiles of any size."""
    return REFERENCE.bin_gaussians(projection_of(arrays), grid_of(arrays, tile_size), conventions)


def run_stages(backend: Backend, scene: Golden, dtype: str, fed: Arrays | None = None) -> Arrays:
    """Outputs and gradients of every stage.

    Parameters
    ----------
    backend : Backend
        The renderer.
    scene : Golden
        Its inputs and the cotangents are read; whatever else it has is not.
    dtype : str
        ``"float32"`` or ``"float64"``: what the stages compute in.
    fed : dict, optional
        All arrays of a truth: the input of each stage. By default each stage reads what the stage before it gave.

    Returns
    -------
    dict
        By the names of the golden format; the totals only where no truth was fed, of which they would be sums.
    """
    out: Arrays = {}
    known = ChainMap(out if fed is None else fed, scene.arrays)

    def take(name: str) -> Floats:
        array = known[name]
        return np.asarray(array, dtype, order="C") if array.dtype.kind == "f" else array

    c, camera = scene.conventions, scene.camera
    primitives = Primitives(take("means"), take("quats"), take("scales"), take("opacities"))
    out |= zip(PROJECTION, backend.project(*primitives, camera, c), strict=True)
    projection = projection_of({name: take(name) for name in PROJECTION})

    tile_size = backend.tile_width, backend.tile_height
    bins = backend.bin_gaussians(projection, grid_of(scene.arrays, tile_size), c)
    out["tile_size"] = np.array(tile_size, np.int32)
    out["gaussian_ids"], out["tile_offsets"] = bins.gaussian_ids, bins.tile_offsets
    if fed is not None:
        bins = reference_bins(fed, c, tile_size)

    shading = (take("means"), take("sh_dc"), take("sh_rest"), camera, scene.sh_degree, known["radii"])
    out["colors"] = backend.sh_colors(*shading)
    blending = (projection, take("colors"), take("background"), bins, c)
    output = backend.composite(*blending)
    out["image"], out["alpha"] = output.image, output.alpha
    if "v_image" not in known:
        return out

    v = backend.composite_vjp(
        *blending, RenderOutput(take("image"), take("alpha"), None, None), take("v_image"), take("v_alpha")
    )
    out |= zip(COMPOSITE_GRADIENT, v, strict=True)
    v_projection = ProjectionGradient(*map(take, STAGE_COTANGENTS["project"]))
    out |= zip(PROJECT_GRADIENT, backend.project_vjp(*primitives, camera, c, projection, v_projection), strict=True)
    out |= zip(COLORS_GRADIENT, backend.sh_colors_vjp(*shading, take("v_colors")), strict=True)
    if fed is None:
        for name in ("v_means", "v_R", "v_t"):
            out[name] = out[f"{name}_projection"] + out[f"{name}_colors"]

    loss, tape = backend.photometric_loss(take("image"), take("target"), float(take("dssim_weight")))
    out["loss"], out["v_image_of_loss"] = np.array(loss, dtype), backend.photometric_loss_vjp(tape)
    return out


def truth(scene: Golden, *, seed: int = 0, zeros: tuple[str, ...] = ()) -> Golden:
    """Scene with all arrays, by the reference in float64.

    Parameters
    ----------
    scene : Golden
        With its inputs.
    seed : int
        Of the cotangents. They are 0 at the pixels whose hits rounding decides, and at Gaussians that are culled: no
        gradient is to depend on those.
    zeros : tuple of str
        Cotangents that are zero throughout, for a renderer that cannot take them.

    Returns
    -------
    Golden
        All arrays of the format.
    """
    forward = run_stages(REFERENCE, scene, "float64")
    known = scene.arrays | forward
    tile_size = (REFERENCE.tile_width, REFERENCE.tile_height)
    bins = reference_bins(known, scene.conventions, tile_size)
    is_sure = ~thresholds(projection_of(known), bins, scene.conventions).is_near
    rng = np.random.default_rng(seed)
    cotangents = {
        "v_image": rng.uniform(-1, 1, forward["image"].shape) * is_sure[:, :, None],
        "v_alpha": rng.uniform(-1, 1, forward["alpha"].shape) * is_sure,
        "v_depths": rng.uniform(-1, 1, forward["depths"].shape) * (forward["radii"][:, 0] > 0),
    }
    rounded = {name: array.astype(np.float32).astype(np.float64) for name, array in cotangents.items()}
    rounded |= {name: np.zeros_like(rounded[name]) for name in zeros}
    scene = scene._replace(arrays=scene.arrays | rounded)
    return scene._replace(arrays=scene.arrays | run_stages(REFERENCE, scene, "float64"))


def golden_scenes() -> dict[str, Golden]:
    """All scenes with all arrays, by name."""
    return {recipe.name: truth(inputs(recipe)) for recipe in RECIPES}
