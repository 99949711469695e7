"""gsplat's door: activated Gaussians and a batch of cameras in, images out, with gsplat's names, shapes and meta keys.

For code and tests that were written against ``gsplat.rasterization``: the same call on NumPy arrays and, in place of
autograd, a second call that returns the gradients. N Gaussians, C cameras, D colour channels, K spherical-harmonic
coefficients a channel. The twelve free entries of a view matrix count as independent. Left out: cameras other than
pinholes, packed output, and ``isect_ids`` in the meta, the keys of gsplat's own sort.
"""

from typing import Any

import numpy as np

from minisplat_ref.backends import Backend, get_backend
from minisplat_ref.batch import checked_batch, draw, draw_vjp, expected_depth, expected_depth_vjp
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.splatting import SplatTape
from minisplat_ref.types import Floats, TileGrid
from minisplat_ref.validation import check_array, chosen_conventions

META_TILE_SIZE = 16  # pixels; the tiles of the meta's lists are gsplat's, whatever tiles the backend works with


def rasterization(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    *,
    near_plane: float | None = None,
    far_plane: float | None = None,
    eps2d: float | None = None,
    sh_degree: int | None = None,
    backgrounds: Floats | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    backend: str | Backend = "cpu",
    profile: str | Conventions = GSPLAT_MAIN,
) -> tuple[Floats, Floats, dict[str, Any]]:
    """Render Gaussians through C cameras.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame. All arrays are float32, or all are float64; so is the result. N may be 0.
    quats : ndarray of shape (N, 4)
        wxyz, world_from_gaussian, any length but zero.
    scales : ndarray of shape (N, 3)
        Standard deviations, world units (activated).
    opacities : ndarray of shape (N,)
        In [0, 1] (activated).
    colors : ndarray of shape (N, D) or (C, N, D); with `sh_degree` of shape (N, K, 3) or (C, N, K, 3)
        Any D channels; or coefficients, degree by degree, of ``max(0, 0.5 + sum_k c_k Y_k)``.
    viewmats : ndarray of shape (C, 4, 4)
        cam_from_world, OpenCV axes.
    Ks : ndarray of shape (C, 3, 3)
        ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, pixels; the centre of the first pixel is (0.5, 0.5).
    width, height : int
        Image size, pixels.
    near_plane, far_plane, eps2d : float, optional
        Replace the profile's; see :class:`Conventions`.
    sh_degree : int, optional
        Active degree, 0 to 3, of coefficients K >= (sh_degree + 1)^2.
    backgrounds : ndarray of shape (C, D), optional
        Black by default. Depth has the background 0.
    render_mode : {"RGB", "D", "ED", "RGB+D", "RGB+ED"}
        Colours, accumulated depth ``sum w z``, expected depth ``sum w z / max(alpha, 1e-10)``, or both; depth is last.
    rasterize_mode : {"classic", "antialiased"}
        Whether opacities are compensated for the low-pass (Mip-Splatting).
    backend : {"cpu", "cpu-exact", "reference"} or Backend
        Implementation of the stages.
    profile : str or Conventions
        Name in ``PROFILES``, or a value; its ``is_antialiased`` gives way to `rasterize_mode`.

    Returns
    -------
    render_colors : ndarray of shape (C, H, W, D), D + 1 with depth, or 1 for depth alone
    render_alphas : ndarray of shape (C, H, W, 1)
    meta : dict
        ``means2d`` [C, N, 2], ``depths`` [C, N], ``conics`` [C, N, 3], ``opacities`` [C, N] as blended, ``radii``
        [C, N, 2] int32; all 0 where culled. Tiles of ``tile_size`` pixels, ``tile_height`` rows of ``tile_width``:
        ``tiles_per_gauss`` [C, N], ``flatten_ids`` (c N + n, by camera, tile and depth), ``isect_offsets``
        [C, tile_height, tile_width], where each tile's ids begin. ``width``, ``height``, ``n_cameras``.

    Raises
    ------
    InputError
        If an argument has a wrong shape, dtype or value. No Gaussians, or none in sight, is no error.
    """
    conventions = chosen_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = get_backend(backend) if isinstance(backend, str) else backend
    primitives = (means, quats, scales, opacities)
    batch = checked_batch(primitives, colors, viewmats, Ks, width, height, sh_degree, backgrounds, render_mode)
    tapes = [draw(batch, c, conventions, stages) for c in range(len(batch.cameras))]
    images = np.stack([tape.output.image for tape in tapes])  # [C, H, W, D]
    alphas = np.stack([tape.output.alpha for tape in tapes])  # [C, H, W]
    if batch.has_expected_depth:
        images = expected_depth(images, alphas)
    return images, alphas[..., None], _meta(tapes)


def rasterization_vjp(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    v_render_colors: Floats,
    v_render_alphas: Floats,
    *,
    near_plane: float | None = None,
    far_plane: float | None = None,
    eps2d: float | None = None,
    sh_degree: int | None = None,
    backgrounds: Floats | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    backend: str | Backend = "cpu",
    profile: str | Conventions = GSPLAT_MAIN,
) -> dict[str, Floats]:
    """Gradient of :func:`rasterization`; the views are drawn once more.

    Parameters
    ----------
    means, quats, scales, opacities, colors, viewmats, Ks, width, height
        As for :func:`rasterization`, like all options.
    v_render_colors : ndarray of shape (C, H, W, D)
        Derivative of the loss by ``render_colors``.
    v_render_alphas : ndarray of shape (C, H, W, 1)
        Derivative of the loss by ``render_alphas``.

    Returns
    -------
    dict of ndarray
        ``v_means, v_quats, v_scales, v_opacities, v_colors, v_viewmats`` in the shapes of the arguments, summed over
        the cameras; ``v_backgrounds`` where there are backgrounds. The last row of ``v_viewmats`` is 0.
    """
    conventions = chosen_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = get_backend(backend) if isinstance(backend, str) else backend
    primitives = (means, quats, scales, opacities)
    batch = checked_batch(primitives, colors, viewmats, Ks, width, height, sh_degree, backgrounds, render_mode)
    tapes = [draw(batch, c, conventions, stages) for c in range(len(batch.cameras))]
    dtype, sizes = batch.colors.dtype, {"C": len(tapes), "H": height, "W": width}
    sizes["D"] = tapes[0].output.image.shape[2]
    v_images = check_array("v_render_colors", v_render_colors, (("C", "H", "W", "D"),), sizes, dtype)
    v_alphas = check_array("v_render_alphas", v_render_alphas, (("C", "H", "W", 1),), sizes, dtype)[..., 0]

    v_given = [np.zeros_like(field) for field in batch.primitives]
    v_colors, v_viewmats = np.zeros_like(batch.colors), np.zeros((len(tapes), 4, 4), dtype)
    v_backgrounds = np.zeros_like(batch.backgrounds)
    for c, tape in enumerate(tapes):
        v_image, v_alpha = v_images[c], v_alphas[c]
        if batch.has_expected_depth:
            v_image, v_alpha = expected_depth_vjp(tape.output.image, tape.output.alpha, v_image, v_alpha)
        v = draw_vjp(batch, c, tape, v_image, v_alpha)
        for total, part in zip(v_given, v.primitives, strict=True):
            total += part
        v_own_colors = v_colors[c] if batch.has_own_colors else v_colors
        v_own_colors += v.colors
        v_viewmats[c], v_backgrounds[c] = v.viewmat, v.background
    names = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "v_viewmats", "v_backgrounds")
    gradients = dict(zip(names, (*v_given, v_colors, v_viewmats, v_backgrounds), strict=True))
    if backgrounds is None:
        del gradients["v_backgrounds"]
    return gradients


def _meta(tapes: list[SplatTape]) -> dict[str, Any]:
    """What gsplat tells about a batch, every array [C, N, ...]."""
    projections, camera = [tape.projection for tape in tapes], tapes[0].camera
    grid = TileGrid(camera.width, camera.height, META_TILE_SIZE, META_TILE_SIZE)
    bins = [bin_gaussians(tape.projection, grid, tape.conventions) for tape in tapes]
    n_pairs = np.cumsum([0] + [len(lists.gaussian_ids) for lists in bins])  # before each camera, and in all
    n, dtype = len(projections[0].depths), projections[0].depths.dtype
    largest = np.finfo(dtype).max  # kernels hold conics in float64
    ids = [lists.gaussian_ids + c * n for c, lists in enumerate(bins)]
    starts = [lists.tile_offsets[:-1] + before for lists, before in zip(bins, n_pairs, strict=False)]
    names = ("means2d", "depths", "opacities", "radii")
    return {
        **{name: np.stack([getattr(projection, name) for projection in projections]) for name in names},
        "conics": np.clip([projection.conics for projection in projections], -largest, largest).astype(dtype),
        "tiles_per_gauss": np.stack([np.diff(lists.gaussian_offsets) for lists in bins]).astype(np.int32),
        "flatten_ids": np.concatenate(ids).astype(np.int32),
        "isect_offsets": np.stack(starts).reshape(-1, grid.n_tiles_y, grid.n_tiles_x).astype(np.int32),
        "tile_width": grid.n_tiles_x,
        "tile_height": grid.n_tiles_y,
        "tile_size": META_TILE_SIZE,
        "width": camera.width,
        "height": camera.height,
        "n_cameras": len(tapes),
    }
