"""Compute all arrays of a golden scene with any backend's stages, each on its own or one after the other.

If the arrays of a truth are given, they are the input of every stage, so that an error stays in its stage. The last two
stages are calls of which a backend is only a part: the view, which is the public call ``rasterization``, and Adam with
its bias corrections.
"""

from collections import ChainMap
from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from minisplat_ref.constants import Conventions
from minisplat_ref.gsplat.call import rasterization, rasterization_vjp
from minisplat_ref.oracle.golden.format import STAGE_COTANGENTS, Arrays, Golden
from minisplat_ref.rendering.backends import REFERENCE, Backend
from minisplat_ref.training.adam import AdamRule, AdamState, adam_step
from minisplat_ref.types import Floats, Primitives, Projection, ProjectionGradient, RenderOutput, TileBins, TileGrid

Take = Callable[[str], Floats]
"""Reads an array by name; floating-point arrays come in the dtype of the computation."""

# Fields of a stage's result, by array.
PROJECTION = ("means2d", "depths", "conics", "opacities2d", "radii", "boxes")
PROJECT_GRADIENT = ("v_means_projection", "v_quats", "v_scales", "v_opacities", "v_R_projection", "v_t_projection")
COLORS_GRADIENT = ("v_means_colors", "v_sh_dc", "v_sh_rest", "v_R_colors", "v_t_colors")
COMPOSITE_GRADIENT = ("v_means2d", "v_conics", "v_opacities2d", "v_colors", "v_background")
SURFACE_GRADIENT = ("v_means_surface", "v_quats_surface", "v_scales_surface")
STATISTICS = ("blend_weight_sum", "blend_weight_max", "hit_count", "dominant_count", "dominant_ids")
VIEW_GRADIENT = {
    "v_means_view": "v_means",
    "v_quats_view": "v_quats",
    "v_scales_view": "v_scales",
    "v_opacities_view": "v_opacities",
}


def projection_of(arrays: Arrays) -> Projection:
    """Return the projection made of the arrays with its fields' names."""
    return Projection(*(arrays[name] for name in PROJECTION))


def grid_of(arrays: Arrays, tile_size: tuple[int, int]) -> TileGrid:
    """Return the grid of tiles of any size over the image."""
    width, height = map(int, arrays["image_size"])
    return TileGrid(width, height, *tile_size)


def reference_bins(arrays: Arrays, conventions: Conventions, tile_size: tuple[int, int]) -> TileBins:
    """Return the tile lists that the reference makes from a projection, for tiles of any size."""
    return REFERENCE.bin_gaussians(projection_of(arrays), grid_of(arrays, tile_size), conventions)


def run_stages(
    backend: Backend, scene: Golden, dtype: str, fed: Arrays | None = None, without: Collection[str] = ()
) -> Arrays:
    """Return the outputs and gradients of every stage.

    Parameters
    ----------
    backend : Backend
        The renderer.
    scene : Golden
        Its inputs and the cotangents are read; whatever else it has is not. Without cotangents there are no gradients,
        and of the stages only those of the image.
    dtype : str
        ``"float32"`` or ``"float64"``, the dtype of the stages.
    fed : dict, optional
        All arrays of a truth: the input of each stage. By default each stage reads the output of the stage before it.
    without : collection of str
        Stages behind the image that the backend does not have: loss, features, statistics, surface, view, adam.

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
    further: dict[str, Callable[[], Arrays]] = {
        "loss": lambda: _loss(backend, take),
        "features": lambda: _features(backend, take, projection, bins, c),
        "statistics": lambda: _statistics(backend, blending),
        "surface": lambda: _surface(backend, take, scene),
        "view": lambda: _view(backend, take, scene),
        "adam": lambda: _adam(backend, take),
    }
    for stage, run in further.items():
        if stage not in without:
            out |= run()
    return out


def _loss(backend: Backend, take: Take) -> Arrays:
    image, weight = take("image"), float(take("dssim_weight"))
    loss, tape = backend.photometric_loss(image, take("target"), weight)
    photograph, mask = take("target_bytes").astype(np.uint8), take("mask").astype(bool)
    masked_loss, masked_tape = backend.photometric_loss(image, photograph, weight, mask)
    return {
        "loss": np.array(loss, image.dtype),
        "v_image_of_loss": backend.photometric_loss_vjp(tape),
        "masked_loss": np.array(masked_loss, image.dtype),
        "v_image_of_masked_loss": backend.photometric_loss_vjp(masked_tape),
    }


def _features(backend: Backend, take: Take, projection: Projection, bins: TileBins, c: Conventions) -> Arrays:
    """Return features and depths, the latter as one more channel over black."""
    channels = np.column_stack([take("features"), projection.depths])
    background = np.append(take("feature_background"), channels.dtype.type(0))
    blending = (projection, channels, background, bins, c)
    output = backend.composite(*blending)
    v_image = np.concatenate([take("v_feature_image"), take("v_accumulated_depth")[..., None]], axis=2)
    v = backend.composite_vjp(*blending, output, v_image, np.zeros_like(output.alpha))
    return {
        "feature_image": output.image[..., :-1],
        "accumulated_depth": output.image[..., -1],
        "v_features": v.colors[:, :-1],
        "v_feature_background": v.background[:-1],
        "v_depths_features": v.colors[:, -1],
        "v_means2d_features": v.means2d,
        "v_conics_features": v.conics,
        "v_opacities2d_features": v.opacities,
    }


def _statistics(backend: Backend, blending: tuple[Projection, Floats, Floats, TileBins, Conventions]) -> Arrays:
    output = backend.composite(*blending, with_stats=True, with_median_depth=True)
    assert output.stats is not None and output.median_depth is not None  # they were requested
    return {**dict(zip(STATISTICS, output.stats, strict=True)), "median_depth": output.median_depth}


def _surface(backend: Backend, take: Take, scene: Golden) -> Arrays:
    rays = (take("means"), take("quats"), take("scales"), scene.camera, scene.arrays["surface_ids"])
    points, depths = backend.surface_points(*rays)
    v = backend.surface_points_vjp(*rays, take("v_surface_points"), take("v_surface_depths"))
    return {"surface_points": points, "surface_depths": depths, **dict(zip(SURFACE_GRADIENT, v, strict=True))}


def _view(backend: Backend, take: Take, scene: Golden) -> Arrays:
    """The public call, for one camera: colours and expected depth."""
    fx, fy, cx, cy = take("intrinsics")
    width, height = map(int, take("image_size"))
    viewmat = np.vstack([np.column_stack([take("cam_from_world_R"), take("cam_from_world_t")]), [0, 0, 0, 1]])
    coefficients = np.concatenate([take("sh_dc")[:, None], take("sh_rest")], axis=1)
    call: dict[str, Any] = {
        **{name: take(name) for name in ("means", "quats", "scales", "opacities")},
        "colors": coefficients,
        "viewmats": viewmat[None].astype(coefficients.dtype),
        "Ks": np.array([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], coefficients.dtype),
        "width": width,
        "height": height,
        "backgrounds": take("background")[None],
        "sh_degree": scene.sh_degree,
        "render_mode": "RGB+ED",
        "rasterize_mode": "antialiased" if scene.conventions.is_antialiased else "classic",
        "profile": scene.conventions,
        "backend": backend,
    }
    images, alphas, _ = rasterization(**call)
    v_image = np.concatenate([take("v_image"), take("v_expected_depth")[..., None]], axis=2)[None]
    v = rasterization_vjp(**call, v_render_colors=v_image, v_render_alphas=take("v_alpha")[None, ..., None])
    return {
        "view": images[0],
        "view_alpha": alphas[0, ..., 0],
        **{name: v[key] for name, key in VIEW_GRADIENT.items()},
        "v_sh_dc_view": v["v_colors"][:, 0],
        "v_sh_rest_view": v["v_colors"][:, 1:],
        "v_viewmat": v["v_viewmats"][0, :3],
        "v_background_view": v["v_backgrounds"][0],
    }


def _adam(backend: Backend, take: Take) -> Arrays:
    values, first, second = (take(f"adam_{name}").copy() for name in ("values", "first", "second"))
    rate, beta1, beta2, eps, step = map(float, take("adam_settings"))
    rows = take("adam_rows").astype(np.int64)
    rule = AdamRule(len(rows) < len(values), has_bias_correction=True, beta1=beta1, beta2=beta2, eps=eps)
    state = AdamState({"p": first}, {"p": second}, round(step) - 1)
    adam_step({"p": values}, {"p": take("adam_gradient")}, state, {"p": rate}, rule, rows, backend)
    return {"adam_values_after": values, "adam_first_after": first, "adam_second_after": second}
