"""Translucent triangle meshes, and the result of peeling their layers: bundles of the reference and the kernels.

A mesh has a colour and an opacity at each vertex, (r, g, b, a), which are linear on its triangles: with the barycentric
coordinates b of the point where a pixel's ray meets a triangle, ``(c, alpha) = sum_i b_i (c_i, a_i)``. Both sides of a
triangle are rendered. A pixel blends the triangles that its ray hits, nearest first::

    image = sum_l c_l alpha_l T_l + T_end background,   T_l = prod_{j before l} (1 - alpha_j),   alpha = 1 - T_end

That is 3DGS's compositing, but without its thresholds: no alpha is clamped or skipped, and an opaque mesh is rendered
as by a z-buffer. Depth peeling (Everitt 2001) finds the layers of all pixels one after the other; a graphics program
peels a fixed number of them, and leaves out the layers behind.

- A pixel belongs to a triangle if its centre lies inside. On an edge, exactly, it belongs to the one of two neighbours
  that also contains the point a little to the right, or else below: neither to both nor to none.
- Of equally distant triangles the first in the list is in front.
- Fragments not beyond the near plane are left out, pixel by pixel: a triangle may pass through it.
- A triangle that is seen at less than ``ANGLE_MIN``, or has no area, is not rendered.

The gradient holds coverage and order fixed: at the border of a mesh that is not transparent there, the image jumps.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.errors import InputError
from minisplat_ref.types import Bools, Camera, Floats, Ints

ANGLE_MIN = 1e-9  # radians between a triangle's plane and the ray to its first corner: less is noise in float64
ALL_LAYERS = 1 << 30


class TranslucentMesh(NamedTuple):
    """Triangles with colours and opacities at their vertices."""

    vertices: Floats
    """[P, 3] world frame, world units."""
    rgba: Floats
    """[P, 4] red, green, blue and opacity; an image is meaningful where all are in [0, 1]."""
    faces: Ints
    """[T, 3] int64 rows of the vertices that are the corners of each triangle."""


class Frame(NamedTuple):
    """From where a mesh is seen, and how deep."""

    camera: Camera
    near: float
    """Camera z of the near plane, world units."""
    max_layers: int = ALL_LAYERS
    """Of a pixel, at least 1; layers behind them are left out."""


class Peeled(NamedTuple):
    """An image of a mesh."""

    image: Floats
    """[H, W, 3] background included."""
    alpha: Floats
    """[H, W] accumulated opacity."""
    n_layers: Ints
    """[H, W] triangles that the pixel's ray meets, also those beyond ``max_layers``."""
    is_seen: Bools
    """[T] whether a pixel's ray meets the triangle."""
    tape: Any
    """For the gradient, of the implementation that rendered it."""


class PeelGradient(NamedTuple):
    """Gradient of the loss with respect to the inputs of a mesh's image."""

    vertices: Floats
    """[P, 3] world frame."""
    rgba: Floats
    """[P, 4]."""
    background: Floats
    """[3]."""
    cam_from_world_R: Floats
    """[3, 3] with respect to the nine entries, unconstrained."""
    cam_from_world_t: Floats
    """[3]."""


def gradient_of(
    mesh: TranslucentMesh, frame: Frame, v_camera: Floats, v_rgba: Floats, v_background: Floats
) -> PeelGradient:
    """Return the whole gradient, given that with respect to the vertices [P, 3] in the camera frame, ``R x + t``."""
    dtype, R = mesh.vertices.dtype, frame.camera.cam_from_world_R.astype(np.float64)
    v_R = v_camera.T @ mesh.vertices.astype(np.float64)
    arrays = v_camera @ R, v_rgba, v_background, v_R, v_camera.sum(axis=0)
    return PeelGradient(*(array.astype(dtype) for array in arrays))


def check_translucent(mesh: TranslucentMesh, source: object) -> None:
    """Refuse a mesh whose numbers do not make an image; ``source`` is the beginning of messages.

    Raises
    ------
    InputError
        A face has a vertex that does not exist, or a colour or an opacity is not in [0, 1].
    """
    if mesh.faces.size and not (0 <= mesh.faces.min() and mesh.faces.max() < len(mesh.vertices)):
        raise InputError(f"{source}: a face has a vertex that does not exist; export the mesh again")
    is_bad = ~((mesh.rgba >= 0) & (mesh.rgba <= 1))
    if is_bad.any():
        row, column = np.argwhere(is_bad)[0]
        name = ("red", "green", "blue", "opacity")[column]
        raise InputError(f"{source}: {name} of vertex {row} is {mesh.rgba[row, column]:g}, not in [0, 1]")


def to_bytes(rgba: Floats) -> NDArray[np.uint8]:
    """Return colours and opacities as mesh files have them, 0 to 255, after clipping to [0, 1]."""
    return np.rint(255 * np.clip(rgba, 0, 1)).astype(np.uint8)
