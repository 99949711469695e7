"""gsplat's call in NumPy: activated Gaussians and a batch of cameras in; images, opacities and gsplat's meta out.

Code and tests written against ``gsplat.rasterization`` can make the same call on NumPy arrays and, instead of autograd,
a second call that returns the gradients. There are N Gaussians, C cameras, D colour channels and K spherical-harmonic
coefficients per channel. Colours are D given channels, or spherical harmonics of the direction from the camera's centre
``o = -R^-1 t``. This is the inverse, not the transpose: the twelve free entries of a view matrix count as independent,
and R mu + t maps that point to the origin whatever they are. Arrays may have further sizes in front, one index for each
of several scenes. Further options of gsplat's call are refused by name (:mod:`minisplat_ref.gsplat.arguments`). Left
out of the meta: ``isect_ids``, the keys of gsplat's own sort.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import validation as check
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.gsplat.arguments import TILE_SIZE, Batch, Options, Views, are_shared, check_refused, split_batches
from minisplat_ref.reference.antialiasing import adjugates, compensations_vjp, determinants
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.reference.pinhole import pinhole_jacobians, pose, slope_limits, with_principal_point
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering.backends import Backend, get_backend
from minisplat_ref.rendering.splatting import Primitives, SplatTape, splat, splat_vjp
from minisplat_ref.types import (
    Camera,
    Floats,
    Ints,
    PrimitiveGradient,
    Projection,
    ProjectionGradient,
    TileGrid,
)

TILE_LISTS = ("tiles_per_gauss", "flatten_ids", "isect_offsets")  # keys of the meta


def rasterization(
    means: Floats,
    quats: Floats | None,
    scales: Floats | None,
    opacities: Floats,
    colors: Floats | None,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    near_plane: float | None = None,
    far_plane: float | None = None,
    radius_clip: float = 0.0,
    eps2d: float | None = None,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = TILE_SIZE,
    backgrounds: Floats | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    *,
    covars: Floats | None = None,
    backend: str | Backend = "cpu",
    profile: str | Conventions = GSPLAT_MAIN,
    **others: Any,
) -> tuple[Floats, Floats, "Meta"]:
    """Render Gaussians through C cameras.

    Parameters
    ----------
    means : ndarray of shape (N, 3)
        World frame. All arrays are float32, or all are float64; so is the result. N may be 0. Every array may have the
        same sizes in front of those that are given here, and so does the result: one scene for each index.
    quats : ndarray of shape (N, 4)
        wxyz, world_from_gaussian, any length but zero.
    scales : ndarray of shape (N, 3)
        Standard deviations, world units (activated).
    opacities : ndarray of shape (N,)
        In [0, 1] (activated).
    colors : ndarray of shape (N, D) or (C, N, D); with `sh_degree` of shape (N, K, 3) or (C, N, K, 3)
        Any D channels; or coefficients, degree by degree, of ``max(0, 0.5 + sum_k c_k Y_k)``. Coefficients [N, K, 3]
        may be those of all scenes. May be None for depth alone.
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
    packed : bool
        Whether the meta has rows for visible Gaussians only, as by gsplat's default; images are the same.
    radius_clip : float
        Gaussians whose radii are both at most this, pixels, are culled.
    tile_size : int
        Of the meta's lists, pixels; images are the same.
    sparse_grad, absgrad : bool
        False alone.
    covars : ndarray of shape (N, 3, 3), optional
        Covariances instead of `quats` and `scales`, which are not read and may be None; of a matrix the upper triangle
        is read.
    backend : {"cpu", "cpu-exact", "reference", "cuda"} or Backend
        Implementation of the stages.
    profile : str or Conventions
        Name in ``PROFILES``, or a value; its ``is_antialiased`` gives way to `rasterize_mode`.
    **others
        gsplat's other keywords, with their defaults; see :mod:`minisplat_ref.gsplat.arguments`.

    Returns
    -------
    render_colors : ndarray of shape (C, H, W, D), D + 1 with depth, or 1 for depth alone
    render_alphas : ndarray of shape (C, H, W, 1)
    meta : Meta
        Read-only mapping. ``means2d`` [C, N, 2], ``depths`` [C, N], ``conics`` [C, N, 3], ``opacities`` [C, N] as
        blended, ``radii`` [C, N, 2] int32; all 0 where culled. Tiles of ``tile_size`` pixels, ``tile_height`` rows of
        ``tile_width``: ``tiles_per_gauss`` [C, N], ``flatten_ids`` (c N + n, by camera, tile and depth),
        ``isect_offsets`` [C, tile_height, tile_width], where each tile's ids begin; these three are made when one of
        them is first read. ``width``, ``height``, ``n_batches`` (of scenes), ``n_cameras``. If packed, the M visible
        rows alone, scene by scene and camera by camera, and their ``batch_ids``, ``camera_ids`` and ``gaussian_ids``
        [M]; ``flatten_ids`` are rows of these.

    Raises
    ------
    InputError
        If an argument has a wrong shape, dtype or value, or requests something that is not computed. No Gaussians, or
        none in sight, is no error.
    """
    check_refused("rasterization", {"sparse_grad": sparse_grad, "absgrad": absgrad, **others})
    conventions = check.choose_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = _with_clip(get_backend(backend) if isinstance(backend, str) else backend, radius_clip)
    options = Options(sh_degree, render_mode, packed, tile_size, radius_clip)
    views = Views(viewmats, Ks, width, height)
    lead, batches = split_batches((means, quats, scales, opacities), covars, colors, views, backgrounds, options)
    tapes = [render_one(batch, c, conventions, stages) for batch in batches for c in range(len(batch.cameras))]
    images = _stack([tape.output.image for tape in tapes])  # [B C, H, W, D]
    alphas = _stack([tape.output.alpha for tape in tapes])  # [B C, H, W]
    options = batches[0].options
    if options.has_expected_depth:
        images[..., -1] = expected_depth(images[..., -1], alphas)
    of_scenes = (*lead, len(batches[0].cameras))
    meta = _meta(tapes, of_scenes, options)
    return images.reshape(*of_scenes, *images.shape[1:]), alphas.reshape(*of_scenes, *alphas.shape[1:], 1), meta


def rasterization_vjp(
    means: Floats,
    quats: Floats | None,
    scales: Floats | None,
    opacities: Floats,
    colors: Floats | None,
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
    packed: bool = False,
    radius_clip: float = 0.0,
    tile_size: int = TILE_SIZE,
    covars: Floats | None = None,
    backend: str | Backend = "cpu",
    profile: str | Conventions = GSPLAT_MAIN,
    **others: Any,
) -> dict[str, Floats]:
    """Gradient of :func:`rasterization`; renders the views once more.

    Parameters
    ----------
    means, quats, scales, opacities, colors, viewmats, Ks, width, height
        As for :func:`rasterization`, and so are all options.
    v_render_colors : ndarray of shape (C, H, W, D)
        Derivative of the loss with respect to ``render_colors``.
    v_render_alphas : ndarray of shape (C, H, W, 1)
        Derivative of the loss with respect to ``render_alphas``.

    Returns
    -------
    dict of ndarray
        ``v_means, v_quats, v_scales, v_opacities, v_colors, v_viewmats`` in the shapes of the arguments, summed over
        the cameras; ``v_backgrounds`` where there are backgrounds, ``v_covars`` instead of ``v_quats`` and ``v_scales``
        where there are covariances. The last row of ``v_viewmats`` is 0, and so is the lower triangle of ``v_covars``.
    """
    check_refused("rasterization_vjp", others)
    conventions = check.choose_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = _with_clip(get_backend(backend) if isinstance(backend, str) else backend, radius_clip)
    options = Options(sh_degree, render_mode, packed, tile_size, radius_clip)
    views = Views(viewmats, Ks, width, height)
    lead, batches = split_batches((means, quats, scales, opacities), covars, colors, views, backgrounds, options)
    is_shared = are_shared(colors, lead, options)
    found = []
    for index, batch in zip(np.ndindex(lead), batches, strict=True):
        tapes = [render_one(batch, c, conventions, stages) for c in range(len(batch.cameras))]
        v_images, v_alphas = (np.asarray(v)[index] if lead else v for v in (v_render_colors, v_render_alphas))
        found.append(_batch_vjp(batch, tapes, v_images, v_alphas))
    left_out = {"v_backgrounds"} if backgrounds is None else set()
    left_out |= {"v_colors"} if colors is None else set()
    left_out |= {"v_covars"} if covars is None else {"v_quats", "v_scales"}
    gradients = {}
    for name in (name for name in found[0] if name not in left_out):
        stacked = np.stack([of_scene[name] for of_scene in found])
        gradients[name] = (
            stacked.sum(axis=0) if name == "v_colors" and is_shared else stacked.reshape(*lead, *found[0][name].shape)
        )
    return gradients


def _batch_vjp(batch: Batch, tapes: Sequence[SplatTape], v_images: Any, v_alphas: Any) -> dict[str, Floats]:
    """Gradient of the views of one scene, by the names of :func:`rasterization_vjp`; all that there are."""
    camera = batch.cameras[0]
    dtype, sizes = batch.colors.dtype, {"C": len(tapes), "H": camera.height, "W": camera.width}
    sizes["D"] = tapes[0].output.image.shape[2]
    v_images = check.check_array("v_render_colors", v_images, (("C", "H", "W", "D"),), sizes, dtype)
    v_alphas = check.check_array("v_render_alphas", v_alphas, (("C", "H", "W", 1),), sizes, dtype)[..., 0]

    v_given = [np.zeros_like(field) for field in batch.primitives]
    v_colors, v_viewmats = np.zeros_like(batch.colors), np.zeros((len(tapes), 4, 4), dtype)
    v_backgrounds, v_covars = np.zeros_like(batch.backgrounds), np.zeros((len(v_given[0]), 3, 3), dtype)
    for c, tape in enumerate(tapes):
        v_image, v_alpha = v_images[c], v_alphas[c]
        if batch.options.has_expected_depth:
            depth = tape.output.image[..., -1]  # [H, W] still accumulated, not expected
            v_depth, v_alpha_of_depth = expected_depth_vjp(depth, tape.output.alpha, v_image[..., -1])
            v_image = np.concatenate([v_image[..., :-1], v_depth[..., None]], axis=-1)
            v_alpha = v_alpha + v_alpha_of_depth
        v = render_one_vjp(batch, c, tape, v_image, v_alpha)
        for total, part in zip(v_given, v.primitives, strict=True):
            total += part
        v_own_colors = v_colors[c] if batch.has_own_colors else v_colors
        v_own_colors += v.colors
        v_viewmats[c], v_backgrounds[c] = v.viewmat, v.background
        if v.covars is not None:
            v_covars += v.covars
    names = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "v_viewmats", "v_backgrounds", "v_covars")
    return dict(zip(names, (*v_given, v_colors, v_viewmats, v_backgrounds, v_covars), strict=True))


def _with_clip(stages: Backend, radius_clip: float) -> Backend:
    """Return the backend that culls Gaussians whose radii are both at most ``radius_clip``."""
    if radius_clip == 0:
        return stages

    @wraps(stages.project)
    def project(
        means: Floats, quats: Floats, scales: Floats, opacities: Floats, camera: Camera, conventions: Conventions
    ) -> Projection:
        projection = stages.project(means, quats, scales, opacities, camera, conventions)
        is_small = (projection.radii <= radius_clip).all(axis=1)  # [N]
        for field in projection:
            field[is_small] = 0
        return projection

    return replace(stages, project=project)


class Meta(Mapping[str, Any]):
    """gsplat's meta of a batch: a read-only mapping whose tile lists are made when one of them is first read.

    NumPy takes longer for the lists than the kernels take for the images, and most callers never read them. Asking for
    keys, length or containment makes no list.
    """

    def __init__(self, values: dict[str, Any], make_tile_lists: Callable[[], dict[str, Any]]) -> None:
        self._values = values  # None for lists that are not made yet
        self._make_tile_lists: Callable[[], dict[str, Any]] | None = make_tile_lists

    def __getitem__(self, key: str) -> Any:
        make = self._make_tile_lists
        if key in TILE_LISTS and make is not None:
            self._values.update(make())
            self._make_tile_lists = None  # frees the arrays that they were made of
        return self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Meta({', '.join(self)})"


class ViewGradient(NamedTuple):
    """Gradient of the loss with respect to a batch, through one of its views."""

    primitives: Primitives
    colors: Floats  # [N, D] or [N, K, 3]
    viewmat: Floats  # [4, 4], last row 0
    background: Floats  # [D]
    covars: Floats | None  # [N, 3, 3] upper triangles, where covariances were given


def render_one(batch: Batch, c: int, conventions: Conventions, backend: Backend) -> SplatTape:
    """Render view c; where an expected depth is wanted, the channel still holds the accumulated depth."""
    means, colors = batch.primitives.means, batch.colors_of(c)
    background = batch.backgrounds[c]

    def shade(radii: Ints) -> Floats:
        if not batch.options.has_colors:
            return np.zeros((len(means), 0), means.dtype)
        if batch.options.sh_degree is None:
            return colors
        return backend.sh_colors(
            means, *_split(colors), remove_rotation(batch.cameras[c]), batch.options.sh_degree, radii
        )

    return splat(
        batch.primitives,
        shade,
        batch.cameras[c],
        background if batch.options.has_colors else background[:0],
        conventions,
        backend,
        with_depth=batch.options.has_depth,
    )


def render_one_vjp(batch: Batch, c: int, tape: SplatTape, v_image: Floats, v_alpha: Floats) -> ViewGradient:
    """Gradient of :func:`render_one`.

    Spherical harmonics add, via the camera's centre::

        o = -R^-1 t,  w = R^-T v_o:  v_R = -w o^T,  v_t = -w

    ``v_image`` [H, W, D] is the derivative with respect to the image with the accumulated depth.
    """
    v_projections: list[ProjectionGradient] = []
    v = splat_vjp(tape if batch.covars is None else _watched(tape, v_projections), v_image, v_alpha)
    v_covars = None if batch.covars is None else covariances_vjp(batch.covars, tape, v_projections[0])
    v_means, v_colors, v_background = v.primitives.means, np.zeros_like(batch.colors_of(c)), v.background
    v_R, v_t = v.primitives.cam_from_world_R, v.primitives.cam_from_world_t
    if not batch.options.has_colors:
        v_background = np.zeros_like(batch.backgrounds[c])
    elif batch.options.sh_degree is None:
        v_colors = v.colors
    else:
        unrotated = remove_rotation(tape.camera)
        dc, rest = _split(batch.colors_of(c))
        v_sh = tape.backend.sh_colors_vjp(
            batch.primitives.means, dc, rest, unrotated, batch.options.sh_degree, tape.projection.radii, v.colors
        )
        v_means = v_means + v_sh.means
        v_colors = np.concatenate([v_sh.sh_dc[:, None], v_sh.sh_rest], axis=1)
        w = np.linalg.solve(tape.camera.cam_from_world_R.T, -v_sh.cam_from_world_t)  # t of the unrotated camera is -o
        v_R, v_t = v_R + np.outer(w, unrotated.cam_from_world_t), v_t - w
    v_viewmat = np.zeros((4, 4), v_t.dtype)
    v_viewmat[:3] = np.column_stack([v_R, v_t])
    v_primitives = Primitives(v_means, v.primitives.quats, v.primitives.scales, v.primitives.opacities)
    return ViewGradient(v_primitives, v_colors, v_viewmat, v_background, v_covars)


def _watched(tape: SplatTape, v_projections: list[ProjectionGradient]) -> SplatTape:
    """Return the tape with a backend that keeps the gradient with respect to the projection."""

    @wraps(tape.backend.project_vjp)
    def project_vjp(*args: Any, **named: Any) -> PrimitiveGradient:
        v_projections.append(named.get("v_projection", args[-1]))
        return tape.backend.project_vjp(*args, **named)

    return tape._replace(backend=replace(tape.backend, project_vjp=project_vjp))


def covariances_vjp(covars: Floats, tape: SplatTape, v_projection: ProjectionGradient) -> Floats:
    """Gradient of the projection with respect to covariances that were given.

    ::

        B = A Sigma A^T + eps I,  Q = B^-1:  v_Sigma = A^T (v_rho's share - Q V_Q Q) A

    That of the factors, which the backend returns, does not determine it where two of the scales are equal. An entry
    above the diagonal represents both, so it gets the derivatives of both.

    Parameters
    ----------
    covars : ndarray of shape (N, 3, 3)
        Symmetric, world frame.
    tape : SplatTape
        Of the view.
    v_projection : ProjectionGradient
        Derivative with respect to the projection.

    Returns
    -------
    ndarray of shape (N, 3, 3)
        Upper triangles; zeros for culled rows.
    """
    conventions, dtype = tape.conventions, covars.dtype
    camera = with_principal_point(tape.camera, conventions)
    rows = np.flatnonzero(tape.projection.radii[:, 0] > 0)  # [V]
    R, t = pose(camera, dtype)
    x = tape.primitives.means[rows] @ R.T + t
    A = pinhole_jacobians(x, camera, *slope_limits(camera, conventions, dtype)) @ R  # [V, 2, 3]
    C = A @ covars[rows] @ np.swapaxes(A, 1, 2)
    B = C + conventions.eps2d * np.eye(2, dtype=dtype)
    Q = adjugates(B) / determinants(B)[:, None, None]
    halves = v_projection.conics[rows].astype(dtype) * np.array([1, 0.5, 1], dtype)
    v_C = -Q @ halves[:, [0, 1, 1, 2]].reshape(-1, 2, 2) @ Q
    if conventions.is_antialiased:
        v_C = v_C + compensations_vjp(C, B, tape.primitives.opacities[rows] * v_projection.opacities[rows])
    v_Sigma = np.swapaxes(A, 1, 2) @ v_C @ A
    v = np.zeros_like(covars)
    v[rows] = np.triu(v_Sigma) + np.triu(np.swapaxes(v_Sigma, 1, 2), 1)
    return v


def _meta(tapes: list[SplatTape], of_scenes: tuple[int, ...], options: Options) -> Meta:
    """Return gsplat's meta, every array [*of_scenes, N, ...] with the scenes and their cameras in front."""
    projections, camera = [tape.projection for tape in tapes], tapes[0].camera
    grid = TileGrid(camera.width, camera.height, options.tile_size, options.tile_size)
    dtype = projections[0].depths.dtype
    largest = np.finfo(dtype).max  # kernels hold conics in float64
    with np.errstate(over="ignore"):
        conics = np.stack([projection.conics for projection in projections], dtype=dtype, casting="same_kind")
    names = ("means2d", "depths", "opacities", "radii")
    values: dict[str, Any] = {name: np.stack([getattr(p, name) for p in projections]) for name in names}
    values["conics"] = np.clip(conics, -largest, largest, out=conics)
    # The lists need only boxes and depths, which no caller can change. To keep all else would waste memory.
    shared = ("means2d", "opacities", "radii", "conics")
    kept = [p._replace(**{name: values[name][c] for name in shared}) for c, p in enumerate(projections)]
    common = {
        "tile_width": grid.n_tiles_x,
        "tile_height": grid.n_tiles_y,
        "tile_size": options.tile_size,
        "width": camera.width,
        "height": camera.height,
        "n_batches": len(tapes) // of_scenes[-1],
        "n_cameras": of_scenes[-1],
    }
    n = len(kept[0].depths)
    rows = np.arange(len(kept) * n)
    if options.packed:
        rows = np.flatnonzero(values["radii"][..., 0].ravel() > 0)  # [M]
        values = {name: array.reshape(-1, *array.shape[2:])[rows] for name, array in values.items()}
        image_ids, ids = np.divmod(rows, max(n, 1))
        scene_ids, camera_ids = np.divmod(image_ids, of_scenes[-1])
        numbers = {"batch_ids": scene_ids, "camera_ids": camera_ids, "gaussian_ids": ids}
        values |= {name: array.astype(np.int32) for name, array in numbers.items()}
    else:
        values = {name: array.reshape(*of_scenes, *array.shape[1:]) for name, array in values.items()}
    place = np.zeros(len(kept) * n, np.int32)  # of each Gaussian of each image among the rows
    place[rows] = np.arange(len(rows))
    conventions = tapes[0].conventions

    def tile_lists() -> dict[str, Any]:
        counts, ids, starts = _tile_lists(kept, grid, conventions)
        per_row = counts.ravel()[rows] if options.packed else counts.reshape(*of_scenes, n)
        arrays = per_row, place[ids], starts.reshape(*of_scenes, grid.n_tiles_y, grid.n_tiles_x)
        return {key: array.astype(np.int32) for key, array in zip(TILE_LISTS, arrays, strict=True)}

    return Meta({**values, **dict.fromkeys(TILE_LISTS), **common}, tile_lists)


def _tile_lists(projections: list[Projection], grid: TileGrid, conventions: Conventions) -> tuple[Ints, Ints, Ints]:
    """Return tiles [I, N] of each Gaussian in I images, the list of Gaussians [M], and where tiles [I, T] begin in it.

    The Gaussians of image i begin at i N.
    """
    n = len(projections[0].depths)
    bins = [bin_gaussians(projection, grid, conventions) for projection in projections]
    n_pairs = np.cumsum([0] + [len(lists.gaussian_ids) for lists in bins])  # before each image, and in total
    ids = [lists.gaussian_ids + i * n for i, lists in enumerate(bins)]
    starts = [lists.tile_offsets[:-1] + before for lists, before in zip(bins, n_pairs, strict=False)]
    return np.stack([np.diff(lists.gaussian_offsets) for lists in bins]), np.concatenate(ids), np.stack(starts)


def _stack(arrays: list[Floats]) -> Floats:
    """Stack C arrays to [C, ...]; that of a single camera is not copied."""
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)


def remove_rotation(camera: Camera) -> Camera:
    """Return a camera at the same centre with R = I: colours depend on the centre only."""
    R, t = camera.cam_from_world_R.astype(np.float64), camera.cam_from_world_t.astype(np.float64)
    return camera._replace(cam_from_world_R=np.eye(3), cam_from_world_t=np.linalg.solve(R, t))


def _split(coefficients: Floats) -> tuple[Floats, Floats]:
    """Split coefficients [N, K, 3] into those of degree 0 [N, 3] and the others [N, K-1, 3]."""
    return np.ascontiguousarray(coefficients[:, 0]), np.ascontiguousarray(coefficients[:, 1:])
