"""gsplat's call in NumPy: activated Gaussians and a batch of cameras in; images, opacities and gsplat's meta out.

Code and tests written against ``gsplat.rasterization`` can make the same call on NumPy arrays and, in place of
autograd, a second call that returns the gradients. There are N Gaussians, C cameras, D colour channels and K
spherical-harmonic coefficients per channel. Colours are D given channels, or spherical harmonics of the direction from
the camera's centre ``o = -R^-1 t``. This is the inverse, not the transpose: the twelve free entries of a view matrix
count as independent, and R mu + t maps that point to the origin whatever they are. Left out: cameras other than
pinholes, packed output, and ``isect_ids`` in the meta, the keys of gsplat's own sort.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import validation as check
from minisplat_ref.backends import Backend, get_backend
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.reference.depth import expected_depth, expected_depth_vjp
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.splatting import Primitives, SplatTape, splat, splat_vjp
from minisplat_ref.types import Camera, Floats, Ints, Projection, TileGrid

META_TILE_SIZE = 16  # pixels; the tiles of the meta's lists are gsplat's, whatever tiles the backend works with
TILE_LISTS = ("tiles_per_gauss", "flatten_ids", "isect_offsets")  # keys of the meta
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


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
) -> tuple[Floats, Floats, "Meta"]:
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
    meta : Meta
        Read-only mapping. ``means2d`` [C, N, 2], ``depths`` [C, N], ``conics`` [C, N, 3], ``opacities`` [C, N] as
        blended, ``radii`` [C, N, 2] int32; all 0 where culled. Tiles of ``tile_size`` pixels, ``tile_height`` rows of
        ``tile_width``: ``tiles_per_gauss`` [C, N], ``flatten_ids`` (c N + n, by camera, tile and depth),
        ``isect_offsets`` [C, tile_height, tile_width], where each tile's ids begin; these three are made when one of
        them is first read. ``width``, ``height``, ``n_cameras``.

    Raises
    ------
    InputError
        If an argument has a wrong shape, dtype or value. No Gaussians, or none in sight, is no error.
    """
    conventions = check.choose_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = get_backend(backend) if isinstance(backend, str) else backend
    primitives, views = Primitives(means, quats, scales, opacities), Views(viewmats, Ks, width, height)
    batch = check_batch(primitives, views, colors, sh_degree, backgrounds, render_mode)
    tapes = [render_one(batch, c, conventions, stages) for c in range(len(batch.cameras))]
    images = _stack([tape.output.image for tape in tapes])  # [C, H, W, D]
    alphas = _stack([tape.output.alpha for tape in tapes])  # [C, H, W]
    if batch.has_expected_depth:
        images[..., -1] = expected_depth(images[..., -1], alphas)
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
        the cameras; ``v_backgrounds`` where there are backgrounds. The last row of ``v_viewmats`` is 0.
    """
    conventions = check.choose_conventions(profile, near_plane, far_plane, eps2d, rasterize_mode)
    stages = get_backend(backend) if isinstance(backend, str) else backend
    primitives, views = Primitives(means, quats, scales, opacities), Views(viewmats, Ks, width, height)
    batch = check_batch(primitives, views, colors, sh_degree, backgrounds, render_mode)
    tapes = [render_one(batch, c, conventions, stages) for c in range(len(batch.cameras))]
    dtype, sizes = batch.colors.dtype, {"C": len(tapes), "H": height, "W": width}
    sizes["D"] = tapes[0].output.image.shape[2]
    v_images = check.check_array("v_render_colors", v_render_colors, (("C", "H", "W", "D"),), sizes, dtype)
    v_alphas = check.check_array("v_render_alphas", v_render_alphas, (("C", "H", "W", 1),), sizes, dtype)[..., 0]

    v_given = [np.zeros_like(field) for field in batch.primitives]
    v_colors, v_viewmats = np.zeros_like(batch.colors), np.zeros((len(tapes), 4, 4), dtype)
    v_backgrounds = np.zeros_like(batch.backgrounds)
    for c, tape in enumerate(tapes):
        v_image, v_alpha = v_images[c], v_alphas[c]
        if batch.has_expected_depth:
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
    names = ("v_means", "v_quats", "v_scales", "v_opacities", "v_colors", "v_viewmats", "v_backgrounds")
    gradients = dict(zip(names, (*v_given, v_colors, v_viewmats, v_backgrounds), strict=True))
    if backgrounds is None:
        del gradients["v_backgrounds"]
    return gradients


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
            self._make_tile_lists = None  # frees what they were made of
        return self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return f"Meta({', '.join(self)})"


class Views(NamedTuple):
    """C cameras in the form that gsplat takes."""

    viewmats: Floats  # [C, 4, 4] cam_from_world, OpenCV axes
    Ks: Floats  # [C, 3, 3] pixels
    width: int  # pixels
    height: int  # pixels


class Batch(NamedTuple):
    """The checked arguments of one call."""

    primitives: Primitives
    colors: Floats  # [N, D] or [N, K, 3], or one such array per camera
    has_own_colors: bool  # whether there is one per camera
    cameras: tuple[Camera, ...]  # [C]
    backgrounds: Floats  # [C, D]
    sh_degree: int | None
    render_mode: str

    @property
    def has_colors(self) -> bool:
        """Whether the image has colour channels."""
        return self.render_mode.startswith("RGB")

    @property
    def has_depth(self) -> bool:
        """Whether the last channel is a depth."""
        return self.render_mode != "RGB"

    @property
    def has_expected_depth(self) -> bool:
        """Whether that depth is divided by the accumulated opacity."""
        return self.render_mode.endswith("ED")

    def colors_of(self, c: int) -> Floats:
        """Return the colours or coefficients that camera c sees."""
        return self.colors[c] if self.has_own_colors else self.colors


class ViewGradient(NamedTuple):
    """Gradient of the loss with respect to a batch, through one of its views."""

    primitives: Primitives
    colors: Floats  # [N, D] or [N, K, 3]
    viewmat: Floats  # [4, 4], last row 0
    background: Floats  # [D]


def check_batch(
    primitives: Primitives,
    views: Views,
    colors: Any,
    sh_degree: int | None,
    backgrounds: Any,
    render_mode: str,
) -> Batch:
    """Check the arguments of :func:`rasterization` and pack them."""
    means, quats, scales, opacities = primitives
    viewmats, Ks, width, height = views
    dtype, sizes = check.check_dtype("means", means), dict[str, int]()

    def array(name: str, value: Any, *shapes: check.Shape) -> Floats:
        return check.check_array(name, value, shapes, sizes, dtype)

    means = array("means", means, ("N", 3))
    quats = array("quats", quats, ("N", 4))
    scales = array("scales", scales, ("N", 3))
    opacities = array("opacities", opacities, ("N",))
    viewmats = array("viewmats", viewmats, ("C", 4, 4))
    Ks = array("Ks", Ks, ("C", 3, 3))
    if sh_degree is None:
        colors = array("colors", colors, ("N", "D"), ("C", "N", "D"))
    else:
        colors = array("colors", colors, ("N", "K", 3), ("C", "N", "K", 3))
        check.check_sh_degree("sh_degree", sh_degree, sizes["K"])
        sizes["D"] = 3
    zeros = np.zeros((sizes["C"], sizes["D"]), dtype)
    backgrounds = zeros if backgrounds is None else array("backgrounds", backgrounds, ("C", "D"))

    check.check_quats("quats", quats)
    check.check_interval("scales", scales, 0, np.inf, "give exp(log_scales)")
    check.check_interval("opacities", opacities, 0, 1, "give sigmoid(opacity_logits)")
    check.check_viewmats("viewmats", viewmats)
    check.check_intrinsics("Ks", Ks)
    check.check_choice("render_mode", render_mode, RENDER_MODES)
    width, height = check.check_size("width", width), check.check_size("height", height)
    cameras = tuple(
        Camera(M[:3, :3], M[:3, 3], float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)
        for M, K in zip(viewmats, Ks, strict=True)
    )
    has_own_colors = colors.ndim == (3 if sh_degree is None else 4)
    given = Primitives(means, quats, scales, opacities)
    return Batch(given, colors, has_own_colors, cameras, backgrounds, sh_degree, render_mode)


def render_one(batch: Batch, c: int, conventions: Conventions, backend: Backend) -> SplatTape:
    """Render view c; where an expected depth is wanted, the channel still holds the accumulated depth."""
    means, colors = batch.primitives.means, batch.colors_of(c)
    background = batch.backgrounds[c]

    def shade(radii: Ints) -> Floats:
        if not batch.has_colors:
            return np.zeros((len(means), 0), means.dtype)
        if batch.sh_degree is None:
            return colors
        return backend.sh_colors(means, *_split(colors), _remove_rotation(batch.cameras[c]), batch.sh_degree, radii)

    return splat(
        batch.primitives,
        shade,
        batch.cameras[c],
        background if batch.has_colors else background[:0],
        conventions,
        backend,
        with_depth=batch.has_depth,
    )


def render_one_vjp(batch: Batch, c: int, tape: SplatTape, v_image: Floats, v_alpha: Floats) -> ViewGradient:
    """Gradient of :func:`render_one`.

    Spherical harmonics add, via the camera's centre::

        o = -R^-1 t,  w = R^-T v_o:  v_R = -w o^T,  v_t = -w

    ``v_image`` [H, W, D] is the derivative with respect to the image with the accumulated depth.
    """
    v = splat_vjp(tape, v_image, v_alpha)
    v_means, v_colors, v_background = v.primitives.means, np.zeros_like(batch.colors_of(c)), v.background
    v_R, v_t = v.primitives.cam_from_world_R, v.primitives.cam_from_world_t
    if not batch.has_colors:
        v_background = np.zeros_like(batch.backgrounds[c])
    elif batch.sh_degree is None:
        v_colors = v.colors
    else:
        unrotated = _remove_rotation(tape.camera)
        dc, rest = _split(batch.colors_of(c))
        v_sh = tape.backend.sh_colors_vjp(
            batch.primitives.means, dc, rest, unrotated, batch.sh_degree, tape.projection.radii, v.colors
        )
        v_means = v_means + v_sh.means
        v_colors = np.concatenate([v_sh.sh_dc[:, None], v_sh.sh_rest], axis=1)
        w = np.linalg.solve(tape.camera.cam_from_world_R.T, -v_sh.cam_from_world_t)  # t of the unrotated camera is -o
        v_R, v_t = v_R + np.outer(w, unrotated.cam_from_world_t), v_t - w
    v_viewmat = np.zeros((4, 4), v_t.dtype)
    v_viewmat[:3] = np.column_stack([v_R, v_t])
    v_primitives = Primitives(v_means, v.primitives.quats, v.primitives.scales, v.primitives.opacities)
    return ViewGradient(v_primitives, v_colors, v_viewmat, v_background)


def _meta(tapes: list[SplatTape]) -> Meta:
    """Return gsplat's meta of a batch, every array [C, N, ...]."""
    projections, camera = [tape.projection for tape in tapes], tapes[0].camera
    grid = TileGrid(camera.width, camera.height, META_TILE_SIZE, META_TILE_SIZE)
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
    return Meta(
        {
            **values,
            **dict.fromkeys(TILE_LISTS),
            "tile_width": grid.n_tiles_x,
            "tile_height": grid.n_tiles_y,
            "tile_size": META_TILE_SIZE,
            "width": camera.width,
            "height": camera.height,
            "n_cameras": len(tapes),
        },
        partial(_tile_lists, kept, grid, tapes[0].conventions),
    )


def _tile_lists(projections: list[Projection], grid: TileGrid, conventions: Conventions) -> dict[str, Any]:
    """Return each tile's Gaussians under the keys of ``TILE_LISTS``; the Gaussians of camera c begin at c N."""
    n = len(projections[0].depths)
    bins = [bin_gaussians(projection, grid, conventions) for projection in projections]
    n_pairs = np.cumsum([0] + [len(lists.gaussian_ids) for lists in bins])  # before each camera, and in total
    ids = [lists.gaussian_ids + c * n for c, lists in enumerate(bins)]
    starts = [lists.tile_offsets[:-1] + before for lists, before in zip(bins, n_pairs, strict=False)]
    arrays = (
        np.stack([np.diff(lists.gaussian_offsets) for lists in bins]),  # [C, N]
        np.concatenate(ids),  # [M]
        np.stack(starts).reshape(-1, grid.n_tiles_y, grid.n_tiles_x),  # [C, tile_height, tile_width]
    )
    return {key: array.astype(np.int32) for key, array in zip(TILE_LISTS, arrays, strict=True)}


def _stack(arrays: list[Floats]) -> Floats:
    """Stack C arrays to [C, ...]; that of a single camera is not copied."""
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)


def _remove_rotation(camera: Camera) -> Camera:
    """Return a camera at the same centre with R = I: colours depend on the centre only."""
    R, t = camera.cam_from_world_R.astype(np.float64), camera.cam_from_world_t.astype(np.float64)
    return camera._replace(cam_from_world_R=np.eye(3), cam_from_world_t=np.linalg.solve(R, t))


def _split(coefficients: Floats) -> tuple[Floats, Floats]:
    """Split coefficients [N, K, 3] into those of degree 0 [N, 3] and the others [N, K-1, 3]."""
    return np.ascontiguousarray(coefficients[:, 0]), np.ascontiguousarray(coefficients[:, 1:])
