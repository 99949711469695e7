"""The bundles that stages pass to each other: shape, dtype, frame and unit of every field.

There are N Gaussians, K spherical-harmonic coefficients per channel, D image channels, M (tile, Gaussian) pairs and
H x W pixels. Arrays are C-contiguous; floating-point fields of one bundle share one dtype, float32 or float64, and
every stage returns the dtype that it is given; only conics and their derivative are float64 in the kernels. World and
camera frames are right-handed; camera axes are OpenCV's: x right, y down, z forward. Image coordinates are in pixels, x
right and y down, and the centre of the top-left pixel is (0.5, 0.5).
"""

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from minisplat_ref.interface.showing import as_bytes, one_line, to_png, to_sheet

Floats = NDArray[np.floating]
Ints = NDArray[np.integer]
Bools = NDArray[np.bool_]
Item = TypeVar("Item")  # of a list


class Gaussians(NamedTuple):
    """A population of Gaussians: the trained parameters, before their activations.

    Gradients and Adam moments have this type too. Any NamedTuple of arrays [N, ...] whose first field is ``means`` is a
    population; those of extensions have further fields.
    """

    means: Floats
    """[N, 3] centres, world frame, world units."""
    quats: Floats
    """[N, 4] rotations world_from_gaussian, wxyz, not normalised."""
    log_scales: Floats
    """[N, 3] natural logarithm of the standard deviations along the Gaussian's axes."""
    opacity_logits: Floats
    """[N] opacity = 1 / (1 + exp(-logit))."""
    sh_dc: Floats
    """[N, 3] spherical-harmonic coefficient of degree 0, RGB; colour = 0.5 + SH_C0 * sh_dc + ..."""
    sh_rest: Floats
    """[N, K-1, 3] coefficients of degree 1 and above; K = (degree + 1)^2, so K - 1 is 0, 3, 8 or 15."""

    def __repr__(self) -> str:
        return one_line(self)


class Optics(NamedTuple):
    """The lens of a camera that is no pinhole; :mod:`minisplat_ref.mechanisms.cameras` has the functions."""

    model: str
    """``brown``, ``fisheye``, ``orthographic`` or ``affine``."""
    coefficients: tuple[float, ...] = ()
    """Without unit: k1 to k6, p1, p2 of ``brown``; k1 to k4 of ``fisheye``. Of ``affine``, in a world
    whose z is up: the shear s in ``v = fy (y + s x) + cy``, metres per world unit, and the direction [3] to the sun,
    zeros for none."""

    @property
    def is_parallel(self) -> bool:
        """Whether all rays are parallel: then focal lengths are pixels per world unit, and the place says little."""
        return self.model in ("orthographic", "affine")


class Camera(NamedTuple):
    """A pinhole camera: x_cam = R x_world + t; u = fx x/z + cx; v = fy y/z + cy. With ``optics``, another one."""

    cam_from_world_R: Floats
    """[3, 3] rotation."""
    cam_from_world_t: Floats
    """[3] translation, world units."""
    fx: float
    """Focal length, pixels."""
    fy: float
    """Focal length, pixels."""
    cx: float
    """Principal point, pixels; width / 2 when centred."""
    cy: float
    """Principal point, pixels."""
    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    optics: Optics | None = None
    """None for a pinhole. Other cameras need a renderer that supports them (``Representation.takes_optics``)."""

    @property
    def center(self) -> Floats:
        """[3] position ``-R^T t``, world frame, in the dtype of the pose."""
        return -self.cam_from_world_R.T @ self.cam_from_world_t

    def astype(self, dtype: DTypeLike) -> "Camera":
        """Return the same camera with its pose in another precision."""
        R, t = np.asarray(self.cam_from_world_R, dtype), np.asarray(self.cam_from_world_t, dtype)
        return self._replace(cam_from_world_R=R, cam_from_world_t=t)


class View(NamedTuple):
    """A photograph with its camera; or a camera alone, from :func:`view_from`."""

    name: str
    """File name without its suffix, unique in a scene."""
    camera: Camera
    """Camera; its width and height are the image's."""
    image: NDArray[np.uint8]
    """[H, W, 3] sRGB as stored in the file; an alpha channel is already composited onto the scene's background, or has
    become the mask (COLMAP scenes). [0, 0, 3] where there is no photograph."""
    mask: Bools | None
    """[H, W] True where the pixel counts in the loss; None where all do."""
    point_ids: Ints | None = None
    """[Q] rows of :attr:`Scene.points` that structure from motion found in the photograph, ascending; None where that
    is not known."""
    view_id: int = -1
    """Index among the training views of its scene, and in arrays with one row per photograph; -1 for a view that is not
    trained on."""
    time: float = 0.0
    """When it was taken, in the scene's own unit, usually from 0 to 1; for scenes that move."""
    log_gain: Floats | None = None
    """[3] natural logarithm of its exposure over the mean of the training photographs, in sRGB, from
    :func:`minisplat_ref.strategy.track_gains.store_gains`; None where it is not known, or where they do not differ."""

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_png_(self) -> bytes | None:
        """Return the photograph for a notebook, if there is one."""
        image = self.load().image
        return to_png(image) if image.size else None

    def load(self) -> "View":
        """Return a view that holds its pixels: itself, or a copy if the view reads its pixels on demand.

        Scenes whose photographs do not fit into memory have such views:
        :class:`minisplat_ref.io.stored_views.StoredView`.
        """
        return self


def number_views(views: Iterable[View]) -> tuple[View, ...]:
    """Return training views with their indices as ``view_id``."""
    return tuple(view._replace(view_id=i) for i, view in enumerate(views))


def some_of(items: Sequence[Item], n: int) -> list[Item]:
    """Return at most ``n`` of the items, spread evenly over the list from the first to the last."""
    rows = np.linspace(0, len(items) - 1, min(len(items), n)).round().astype(int)
    return [items[row] for row in rows]


def view_from(camera: Camera, *, name: str = "", time: float = 0.0) -> View:
    """Return a view without a photograph, to render from."""
    return View(name, camera, np.zeros((0, 0, 3), np.uint8), None, time=time)


class Frame(NamedTuple):
    """Origin and unit of a scene's coordinates in memory, in its files' frame: ``x_file = origin + unit x``."""

    origin: tuple[float, float, float]
    """In the files' frame and unit."""
    unit: float
    """In the files' unit, above 0."""


FILE_FRAME = Frame((0.0, 0.0, 0.0), 1.0)
"""The frame of the files itself."""


class Scene(NamedTuple):
    """Photographs split into training and test views, with the sparse points of structure from motion."""

    name: str
    """Name for reports."""
    train_views: tuple[View, ...]
    """Views that are trained on."""
    test_views: tuple[View, ...]
    """Held-out views; may be empty."""
    points: Floats
    """[P, 3] float64 SfM points, world frame; P may be 0."""
    point_colors: NDArray[np.uint8]
    """[P, 3] sRGB."""
    background: Floats
    """[3] in [0, 1], the colour behind everything; black by default."""
    extent: float
    """1.1 x the largest distance of a training camera from their mean, world units: scales position learning rates."""
    frame: Frame = FILE_FRAME
    """The frame of cameras, points and extent: that of the files, unless :func:`minisplat_ref.io.frames.place_scene`
    has moved or scaled the scene."""
    random_box: Floats | None = None
    """[2, 3] lowest and highest corner of the box in which random points are drawn where there are no points, world
    frame; None: around the cameras."""

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_png_(self) -> bytes:
        """Return a sheet of the first photographs for a notebook."""
        images = (view.load().image for view in (*self.train_views, *self.test_views))
        return to_png(to_sheet(image for image in images if image.size))


NOTHING: Mapping[str, Any] = MappingProxyType({})
"""An empty mapping, the default for fields and arguments that are mappings."""


class Model(NamedTuple):
    """The trained parameters: a population of primitives, and parameters that belong to none of them."""

    gaussians: Any
    """A population: :class:`Gaussians`, or another NamedTuple of arrays [N, ...] whose first field is ``means``."""
    shared: Mapping[str, Floats] = NOTHING
    """Arrays without rows, by name: an exposure or a pose for each photograph, the weights of a network."""

    def __repr__(self) -> str:
        return one_line(self)


class BlendStats(NamedTuple):
    """Per-Gaussian statistics of compositing one view (Mini-Splatting); w = alpha T is the weight of a hit."""

    blend_weight_sum: Floats
    """[N] sum of w over the pixels."""
    blend_weight_max: Floats
    """[N] largest w over the pixels."""
    hit_count: Ints
    """[N] int32 number of pixels with a blended hit."""
    dominant_count: Ints
    """[N] int32 number of pixels at which the Gaussian has the largest w (the front-most of equals)."""
    dominant_ids: Ints
    """[H, W] int32 Gaussian of the largest w; -1 where nothing was hit."""


class RenderOutput(NamedTuple):
    """One composited view."""

    image: Floats
    """[H, W, D] blended channels, background included."""
    alpha: Floats
    """[H, W] accumulated opacity, 1 - final transmittance."""
    median_depth: Floats | None
    """[H, W] depth of the hit that takes the transmittance below one half, 0 where none does; None unless requested."""
    stats: BlendStats | None
    """Blend statistics; None unless requested."""
    saved: Any = None
    """Intermediate results that the backend saves for its gradient; without them it is slower but just as correct."""
    visible_ids: Ints | None = None
    """[V] rows of the population that the view does not cull, ascending; None from a compositor alone."""
    extras: Mapping[str, Any] = NOTHING
    """Results requested by name that are not channels, such as ``surface``, a :class:`SurfacePoints`."""
    n_pairs: int = 0
    """Pairs (tile, Gaussian) of the view, or what a renderer lists instead; memory grows with them."""

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_png_(self) -> bytes:
        """Return the image for a notebook."""
        return to_png(as_bytes(self.image))


class Primitives(NamedTuple):
    """Gaussians after their activations, ready to be rendered."""

    means: Floats
    """[N, 3] world frame, world units."""
    quats: Floats
    """[N, 4] wxyz, any length but zero."""
    scales: Floats
    """[N, 3] standard deviations, world units."""
    opacities: Floats
    """[N] in [0, 1]."""


class Projection(NamedTuple):
    """The footprint of each Gaussian in the image of one camera. Culled Gaussians have zeros everywhere."""

    means2d: Floats
    """[N, 2] projected centres, pixels."""
    depths: Floats
    """[N] camera z of the means, world units."""
    conics: Floats
    """[N, 3] inverse projected covariance (a, b, c) of a dx^2 + 2 b dx dy + c dy^2, px^-2.

    The kernels give it in float64 whatever the data: of a needle 500 pixels long and half a pixel wide, a c and b^2
    agree to six digits, and float32 would leave one of the difference, or none.
    """
    opacities: Floats
    """[N] opacities, multiplied by the antialiasing compensation where the conventions have it."""
    radii: Ints
    """[N, 2] int32 half-extents along x and y, pixels; 0 where culled."""
    boxes: Ints
    """[N, 4] int32 pixels x0, y0, x1, y1 (half-open, in the image) that the Gaussian may touch; empty where culled."""


class TileGrid(NamedTuple):
    """The division of an image into tiles; the last column and row of tiles may extend beyond the image."""

    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    tile_width: int
    """Pixels."""
    tile_height: int
    """Pixels."""

    @property
    def n_tiles_x(self) -> int:
        """Number of tile columns."""
        return -(-self.width // self.tile_width)

    @property
    def n_tiles_y(self) -> int:
        """Number of tile rows."""
        return -(-self.height // self.tile_height)


class TileBins(NamedTuple):
    """The Gaussians that may touch each tile, front to back; tiles in row-major order."""

    gaussian_ids: Ints
    """[M] int32, ordered by (tile, depth, index)."""
    tile_offsets: Ints
    """[n_tiles + 1] int64; tile t owns gaussian_ids[tile_offsets[t]:tile_offsets[t + 1]]."""
    slots: Ints
    """[M] int32 index of each pair when the pairs are grouped by Gaussian instead of by tile."""
    gaussian_offsets: Ints
    """[N + 1] int64; Gaussian n owns the slots gaussian_offsets[n]:gaussian_offsets[n + 1]."""
    grid: TileGrid
    """The tiling."""


class SurfacePoints(NamedTuple):
    """Points where each pixel's ray meets its dominant Gaussian (Mini-Splatting, depth reinitialisation)."""

    points: Floats
    """[H, W, 3] world frame; 0 where there is none."""
    depths: Floats
    """[H, W] camera z, world units; 0 where there is none or the point lies behind the camera."""


class AdamStep(NamedTuple):
    """The constants of one step of Adam, the same for a whole array."""

    rate: float
    """Learning rate, bias corrections included."""
    beta1: float
    """Decay of the mean gradient."""
    beta2: float
    """Decay of the mean squared gradient."""
    eps: float
    """Added to the root, bias corrections included."""


class PrimitiveGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`project`."""

    means: Floats
    """[N, 3]."""
    quats: Floats
    """[N, 4]."""
    scales: Floats
    """[N, 3] with respect to the activated scales."""
    opacities: Floats
    """[N] with respect to the activated opacities."""
    cam_from_world_R: Floats
    """[3, 3] with respect to the nine entries, unconstrained."""
    cam_from_world_t: Floats
    """[3]."""


class SHGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`sh_colors`."""

    means: Floats
    """[N, 3] through the viewing direction."""
    sh_dc: Floats
    """[N, 3]."""
    sh_rest: Floats
    """[N, K-1, 3]; zero above the active degree."""
    cam_from_world_R: Floats
    """[3, 3] through the camera centre -R^T t."""
    cam_from_world_t: Floats
    """[3]."""


class ProjectionGradient(NamedTuple):
    """Gradient of the loss with respect to the differentiable fields of a :class:`Projection`."""

    means2d: Floats
    """[N, 2] per pixel."""
    depths: Floats
    """[N]."""
    conics: Floats
    """[N, 3]; the entry of b is the derivative with respect to b itself, which occurs twice in the symmetric matrix."""
    opacities: Floats
    """[N]."""


class CompositeGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of :func:`composite`."""

    means2d: Floats
    """[N, 2] per pixel."""
    conics: Floats
    """[N, 3]; see :class:`ProjectionGradient`."""
    opacities: Floats
    """[N]."""
    colors: Floats
    """[N, D]."""
    background: Floats
    """[D]."""


class BlendGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of blending, for primitives of any kind."""

    primitives: tuple[Floats, ...]
    """One array for each field of the primitives that has a derivative in their response."""
    colors: Floats
    """[N, S] coefficients of colour."""
    background: Floats
    """[D]."""
