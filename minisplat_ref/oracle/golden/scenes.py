"""The scenes of the golden vectors: their random inputs, and all their arrays, computed by the reference.

The scenes are small, random, and each has one thing that renderers get wrong. Their numbers are rounded to float32, so
that float32 and float64 renderers get the same problem; only the rotation is not rounded, or it would be none. Two
scenes are exact: placed by hand, with values that equal a threshold in binary.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, INRIA, Conventions
from minisplat_ref.oracle.golden.format import Arrays, Golden
from minisplat_ref.oracle.golden.running import projection_of, reference_bins, run_stages
from minisplat_ref.oracle.thresholds import thresholds
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Floats, Primitives, ProjectionGradient, RenderOutput


class Recipe(NamedTuple):
    """The distribution that a scene is drawn from."""

    name: str
    what: str  # its purpose, one line
    conventions: Conventions
    size: tuple[int, int] = (28, 20)  # px
    principal_point: tuple[float, float] = (0.5, 0.5)  # part of the size
    sh_degree: int = 2
    scales: tuple[float, float] = (0.05, 0.5)  # world units, drawn uniformly in their logarithm
    spread: float = 1.0  # of the centres, in half images around the image's middle
    n: int = 70
    depths: tuple[float, float] = (1.5, 6.0)  # world units, drawn uniformly
    n_features: int = 1
    has_all_adam_rows: bool = False
    is_exact: bool = False


def _round_thresholds(conventions: Conventions, name: str) -> Conventions:
    """Return conventions whose thresholds are exact in binary and equal to reachable opacities and products."""
    return conventions._replace(
        name=name, near_plane=2.0**-2, far_plane=8.0, alpha_min=2.0**-8, alpha_max=0.75, transmittance_min=2.0**-3
    )


RECIPES = (
    Recipe(
        "ordinary",
        "dense, opaque in places: clamped alpha and finished pixels",
        GSPLAT_MAIN,
        (48, 32),
        n=150,
        n_features=4,
    ),
    Recipe(
        "antialiased",
        "Gaussians thinner than a pixel, opacities compensated",
        GSPLAT_MAIN._replace(name="ANTIALIASED", is_antialiased=True),
        scales=(0.004, 0.12),
        n=90,
    ),
    Recipe(
        "inria",
        "the rules of the 3DGS rasteriser; the principal point must be ignored",
        INRIA,
        (36, 24),
        (0.4, 0.6),
        has_all_adam_rows=True,
    ),
    Recipe("off-centre", "principal point far from the middle of the image", GSPLAT_MAIN, (28, 20), (0.15, 0.9)),
    Recipe("sh3", "spherical harmonics of degree 3; colours clamped at 0", GSPLAT_MAIN, sh_degree=3, n_features=4),
    Recipe(
        "odd-size",
        "no tile divides 37 x 23; wide spread, so that the Jacobian's clamp acts",
        GSPLAT_MAIN,
        (37, 23),
        (0.35, 0.6),
        scales=(0.1, 1.2),
        spread=2.2,
        n=150,
        n_features=2,
    ),
    Recipe(
        "planes",
        "behind the camera, at the near plane and beyond the far one; large beside the camera",
        GSPLAT_MAIN._replace(name="PLANES", near_plane=0.5, far_plane=4.0),
        (24, 16),
        n=120,
        spread=1.5,
        depths=(-2.0, 5.0),
    ),
    Recipe(
        "equality",
        "transmittance, clamp, planes and depths that equal their thresholds or each other",
        _round_thresholds(GSPLAT_MAIN, "EQUALITY"),
        (24, 16),
        sh_degree=1,
        is_exact=True,
    ),
    Recipe(
        "equality-inria",
        "the same by the rules of the 3DGS rasteriser, and an alpha that equals the least",
        _round_thresholds(INRIA, "EQUALITY_INRIA"),
        (24, 16),
        sh_degree=1,
        is_exact=True,
    ),
)
FOCAL = (41.5, 38.25)  # px
DSSIM_WEIGHT = 0.2
N_RAYS = (6, 10)
ADAM_SHAPE = (24, 3)


def inputs(recipe: Recipe, seed: int = 0) -> Golden:
    """Return the scene of a recipe with its inputs.

    Parameters
    ----------
    recipe : Recipe
        One of :data:`RECIPES`.
    seed : int
        Of all that is random.

    Returns
    -------
    Golden
        Arrays of the role "input", except those that depend on a renderer.
    """
    rng = np.random.default_rng((seed, *recipe.name.encode()))
    size, center = np.array(recipe.size), np.multiply(recipe.size, recipe.principal_point)
    placed = _stack_at_thresholds(recipe, rng) if recipe.is_exact else _scatter(recipe, rng)
    n = len(placed["means"])
    n_rest = (recipe.sh_degree + 1) ** 2 - 1
    image_shape = (size[1], size[0])
    arrays: dict[str, Floats] = {
        "sh_dc": rng.normal(size=(n, 3)),
        "sh_rest": 0.3 * rng.normal(size=(n, n_rest, 3)),
        "background": np.array([0.1, 0.4, 0.7]),
        "intrinsics": np.array([*FOCAL, *center]),
        "target": rng.uniform(size=(*image_shape, 3)),
        "dssim_weight": np.array(DSSIM_WEIGHT),
        "features": rng.normal(size=(n, recipe.n_features)),
        "feature_background": rng.uniform(size=recipe.n_features),
        **_adam_inputs(rng),
        **placed,
    }
    rotation = arrays.pop("cam_from_world_R")
    rounded: Arrays = {name: array.astype(np.float32).astype(np.float64) for name, array in arrays.items()}
    is_updated = rng.uniform(size=ADAM_SHAPE[0]) < (1.0 if recipe.has_all_adam_rows else 0.6)
    exact: Arrays = {
        "cam_from_world_R": rotation,
        "image_size": size.astype(np.int32),
        "mask": (rng.uniform(size=image_shape) < 0.7).astype(np.int32),
        "target_bytes": rng.integers(0, 256, (*image_shape, 3), dtype=np.int32),
        "surface_ids": rng.integers(-1, n, N_RAYS, dtype=np.int32),
        "adam_rows": np.flatnonzero(is_updated).astype(np.int32),
    }
    return Golden(recipe.name, recipe.what, recipe.conventions, rounded | exact, recipe.is_exact)


def _scatter(recipe: Recipe, rng: np.random.Generator) -> Arrays:
    """Scatter Gaussians over the view; those behind the camera would be seen if their depth had the other sign."""
    size, center, n = np.array(recipe.size), np.multiply(recipe.size, recipe.principal_point), recipe.n
    R = rotation_matrices(np.array([[1.0, 0.21, -0.34, 0.13]]))[0]
    t = np.array([0.25, -0.5, 0.75])
    z = np.sort(rng.uniform(*recipe.depths, n))[rng.permutation(n)]
    pixels = size * (0.5 + recipe.spread * rng.uniform(-0.5, 0.5, (n, 2)))
    means_cam = np.column_stack([(pixels - center) / FOCAL * z[:, None], z])
    smallest, largest = np.log(recipe.scales)
    return {
        "means": np.linalg.solve(R, (means_cam - t).T).T,
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(smallest, largest, (n, 3))),
        "opacities": np.minimum(1, rng.uniform(0.05, 1.3, n)),
        "cam_from_world_R": R,
        "cam_from_world_t": t,
    }


def _stack_at_thresholds(recipe: Recipe, rng: np.random.Generator) -> Arrays:
    """Stack Gaussians on the centres of five pixels, where their alphas are their opacities, multiples of 1/256.

    The camera looks along z from a position in multiples of 1/8; all depths that matter are powers of two, so that the
    projection rounds nothing. The stacks are so far apart that none reaches the centre of another.
    """
    near, far, least = recipe.conventions.near_plane, recipe.conventions.far_plane, recipe.conventions.alpha_min
    rows = np.array(
        [  # column and row of the pixel, depth, opacity
            *((6, 5, depth, 0.5) for depth in (0.5, 1, 2, 4)),  # T: 1/2, the median's; 1/4; 1/8, the stop's; 1/16
            *((17, 5, depth, opacity) for depth, opacity in ((1, 0.75), (2, 0.25))),  # the first equals the clamp
            *((17, 12, 2, opacity) for opacity in (0.5, 0.25, 0.125)),  # one depth: the lower row is first
            *((6, 12, depth, opacity) for depth, opacity in ((1, least), (2, 0.25))),  # the first equals the least
            *((12, 8, depth, 0.25) for depth in (near, near + 2.0**-10, 1, -1, far - 2.0**-7, far)),
        ]
    )
    depths, t = rows[:, 2:3], np.array([0.5, -0.25, 0.125])
    center, focal = np.array(recipe.size) / 2, 16.0
    means = np.hstack([(rows[:, :2] + 0.5 - center) / focal * depths, depths])
    sizes = np.abs(depths) * np.array([1.25, 1.0, 0.75]) / focal  # about a pixel
    return {
        "means": means - t,
        "quats": rng.normal(size=(len(rows), 4)),
        "scales": sizes,
        "opacities": rows[:, 3],
        "intrinsics": np.array([focal, focal, *center]),
        "cam_from_world_R": np.eye(3),
        "cam_from_world_t": t,
    }


def _adam_inputs(rng: np.random.Generator) -> Arrays:
    """Draw gradients from 1e-6 to 1, on either side of eps, and rows that never had one."""
    had = rng.uniform(size=(ADAM_SHAPE[0], 1)) < 0.8
    size = 10 ** rng.uniform(-6, 0, ADAM_SHAPE) * had
    return {
        "adam_values": 0.02 * rng.normal(size=ADAM_SHAPE),
        "adam_gradient": size * rng.normal(size=ADAM_SHAPE),
        "adam_first": 0.5 * size * rng.normal(size=ADAM_SHAPE),
        "adam_second": size**2 * rng.uniform(0.001, 0.01, ADAM_SHAPE),
        "adam_settings": np.array([0.01, 0.9, 0.999, 1e-3, 4.0]),
    }


def truth(scene: Golden, *, seed: int = 0, zeros: tuple[str, ...] = ()) -> Golden:
    """Return the scene with all arrays, computed by the reference in float64.

    Parameters
    ----------
    scene : Golden
        With its inputs.
    seed : int
        Of the cotangents. They are 0 at pixels whose hits rounding decides, and at culled Gaussians, because no
        gradient should depend on those.
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
    near = thresholds(projection_of(known), bins, scene.conventions).is_near
    is_sure = np.ones_like(near) if scene.is_exact else ~near
    rng = np.random.default_rng(seed)
    cotangents = {
        "v_image": rng.uniform(-1, 1, forward["image"].shape) * is_sure[:, :, None],
        "v_alpha": rng.uniform(-1, 1, forward["alpha"].shape) * is_sure,
        "v_depths": rng.uniform(-1, 1, forward["depths"].shape) * (forward["radii"][:, 0] > 0),
        "v_feature_image": rng.uniform(-1, 1, (*is_sure.shape, known["features"].shape[1])) * is_sure[:, :, None],
        "v_accumulated_depth": rng.uniform(-1, 1, is_sure.shape) * is_sure,
        "v_expected_depth": rng.uniform(-1, 1, is_sure.shape) * is_sure,
        "v_surface_points": rng.uniform(-1, 1, (*known["surface_ids"].shape, 3)),
        "v_surface_depths": rng.uniform(-1, 1, known["surface_ids"].shape),
    }
    rounded = {name: array.astype(np.float32).astype(np.float64) for name, array in cotangents.items()}
    rounded |= {name: np.zeros_like(rounded[name]) for name in zeros}
    scene = scene._replace(arrays=scene.arrays | rounded)
    arrays = scene.arrays | run_stages(REFERENCE, scene, "float64", without=("view", "adam"))
    scene = scene._replace(arrays=arrays)
    return scene._replace(arrays=arrays | _view_by_stages(scene) | _adam_by_the_book(arrays))


def _view_by_stages(scene: Golden) -> Arrays:
    """Compute the view from stages that are known, not with the public call, which is compared with it.

    ::

        z = D / alpha,  v_D = v_z / alpha,  v_alpha gains -v_z z / alpha      0 where nothing was hit
        o = -R^-1 t,    w = R^-T v_o:  v_R gains -w o^T,  v_t gains -w        the direction of each mean is mu - o
    """
    a, c, camera = scene.arrays, scene.conventions, scene.camera
    is_hit = a["alpha"] > 0
    over_alpha = np.where(is_hit, 1 / np.where(is_hit, a["alpha"], 1), 0)
    z = a["accumulated_depth"] * over_alpha
    v_D = a["v_expected_depth"] * over_alpha
    projection = projection_of(a)
    channels = np.column_stack([a["colors"], a["depths"]])
    image = np.dstack([a["image"], a["accumulated_depth"]])
    v = REFERENCE.composite_vjp(
        projection,
        channels,
        np.append(a["background"], 0.0),
        reference_bins(a, c, (REFERENCE.tile_width, REFERENCE.tile_height)),
        c,
        RenderOutput(image, a["alpha"], None, None),
        np.dstack([a["v_image"], v_D]),
        a["v_alpha"] - v_D * z,
    )
    primitives = Primitives(a["means"], a["quats"], a["scales"], a["opacities"])
    v_projection = ProjectionGradient(v.means2d, v.colors[:, 3], v.conics, v.opacities)
    by_shape = REFERENCE.project_vjp(*primitives, camera, c, projection, v_projection)
    by_color = REFERENCE.sh_colors_vjp(
        a["means"], a["sh_dc"], a["sh_rest"], camera, scene.sh_degree, a["radii"], v.colors[:, :3]
    )
    R, t = a["cam_from_world_R"], a["cam_from_world_t"]
    o, w = -np.linalg.solve(R, t), np.linalg.solve(R.T, -by_color.means.sum(axis=0))
    v_R, v_t = by_shape.cam_from_world_R - np.outer(w, o), by_shape.cam_from_world_t - w
    return {
        "view": np.dstack([a["image"], z]),
        "view_alpha": a["alpha"],
        "v_means_view": by_shape.means + by_color.means,
        "v_quats_view": by_shape.quats,
        "v_scales_view": by_shape.scales,
        "v_opacities_view": by_shape.opacities,
        "v_sh_dc_view": by_color.sh_dc,
        "v_sh_rest_view": by_color.sh_rest,
        "v_viewmat": np.column_stack([v_R, v_t]),
        "v_background_view": v.background[:3],
    }


def _adam_by_the_book(a: Arrays) -> Arrays:
    """Do a step of Adam as algorithm 1 of its paper states it, with its bias corrections."""
    rate, beta1, beta2, eps, step = a["adam_settings"]
    m = beta1 * a["adam_first"] + (1 - beta1) * a["adam_gradient"]
    v = beta2 * a["adam_second"] + (1 - beta2) * a["adam_gradient"] ** 2
    p = a["adam_values"] - rate * (m / (1 - beta1**step)) / (np.sqrt(v / (1 - beta2**step)) + eps)
    is_updated = np.zeros((len(p), 1), bool)
    is_updated[a["adam_rows"]] = True
    return {
        "adam_values_after": np.where(is_updated, p, a["adam_values"]),
        "adam_first_after": np.where(is_updated, m, a["adam_first"]),
        "adam_second_after": np.where(is_updated, v, a["adam_second"]),
    }


def golden_scenes() -> dict[str, Golden]:
    """Return all scenes with all arrays, by name."""
    return {recipe.name: truth(inputs(recipe)) for recipe in RECIPES}
