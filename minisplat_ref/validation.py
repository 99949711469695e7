"""Checks of input, once, at the boundary; the stages trust their arguments.

Every failure is an :class:`InputError` of one line that names the argument or the file, the first bad element, and what
to do. Zero Gaussians are no failure, nor are Gaussians that no camera sees.
"""

import operator
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.constants import PROFILES, SH_DEGREE_MAX, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats, Gaussians

Shape = tuple[str | int, ...]
RASTERIZE_MODES = ("classic", "antialiased")


def check_gaussians(gaussians: Gaussians, source: str | Path) -> None:
    """Refuse parameters that are not finite, and zero quaternions.

    Parameters
    ----------
    gaussians : Gaussians
        Or any NamedTuple of arrays [N, ...] with a field ``quats``.
    source : str or Path
        File or argument that messages begin with.
    """
    for field, values in zip(gaussians._fields, gaussians, strict=True):
        check_finite(f"{source}: {field}", values)
    check_quats(source, gaussians.quats)


def check_finite(name: str, array: Floats) -> None:
    """Refuse NaN and infinity; the message holds the index of the first."""
    is_finite = np.isfinite(array)
    if not is_finite.all():
        is_bad = ~is_finite
        first = tuple(np.argwhere(is_bad)[0].tolist())
        index = ", ".join(map(str, first))
        raise InputError(
            f"{name} is {array[first]} at index [{index}] ({is_bad.sum()} of {array.size} values are not finite);"
            " remove or repair them"
        )


def check_quats(source: str | Path, quats: Floats) -> None:
    """Refuse quaternions [N, 4] of length zero, which are no rotation; any other length is fine."""
    half_turns = np.flatnonzero(quats[:, 0] == 0)  # few; a reduction along every row would take NumPy ten times as long
    zero_rows = half_turns[~quats[half_turns].any(axis=1)]
    if zero_rows.size:
        raise InputError(f"{source}: the rotation of row {zero_rows[0]} is a zero quaternion; remove that Gaussian")


def check_array(name: str, value: Any, shapes: tuple[Shape, ...], sizes: dict[str, int], dtype: np.dtype) -> Floats:
    """Return a C-contiguous array of finite numbers, of the given dtype and one of the shapes.

    Parameters
    ----------
    name : str
        Argument that messages begin with.
    value : array_like
        What was given.
    shapes : tuple of shapes
        Allowed shapes, of different lengths; a letter stands for a size, for example ``("N", 3)``.
    sizes : dict
        Sizes by letter; a new letter takes its size from this array.
    dtype : dtype
        Required; float32 or float64.
    """
    array = np.asarray(value)
    shape = next((shape for shape in shapes if len(shape) == array.ndim), None)
    if shape is None or any(
        actual != (size if isinstance(size, int) else sizes.get(size, actual))
        for size, actual in zip(shape, array.shape, strict=True)
    ):
        known = [f"{letter} = {size}" for letter, size in sizes.items() if any(letter in shape for shape in shapes)]
        raise InputError(f"{name} has shape {_brackets(array.shape)}; {_or(shapes)}{''.join(f', {k}' for k in known)}")
    sizes.update({size: actual for size, actual in zip(shape, array.shape, strict=True) if isinstance(size, str)})
    if array.dtype != dtype:
        raise InputError(f"{name} has dtype {array.dtype}, means has {dtype}; cast all arrays to one of them")
    check_finite(name, array)
    return np.ascontiguousarray(array)


def check_dtype(name: str, value: Any) -> np.dtype:
    """Return the dtype of an array, which must be float32 or float64."""
    dtype = np.asarray(value).dtype
    if dtype not in (np.float32, np.float64):
        raise InputError(f"{name} has dtype {dtype}; cast all arrays to float32 or float64")
    return dtype


def check_interval(name: str, array: Floats, low: float, high: float, way_out: str) -> None:
    """Refuse values outside [low, high], typically parameters that were given before their activation."""
    is_bad = (array < low) | (array > high)
    if is_bad.any():
        first = tuple(np.argwhere(is_bad)[0].tolist())
        index = ", ".join(map(str, first))
        raise InputError(f"{name} is {array[first]} at index [{index}], outside [{low:g}, {high:g}]; {way_out}")


def check_size(name: str, value: Any) -> int:
    """Return a positive integer number of pixels."""
    try:
        size = operator.index(value)
    except TypeError:
        size = 0
    if size <= 0:
        raise InputError(f"{name} is {value!r}; it must be a whole number of pixels, at least 1")
    return size


def check_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Refuse a string that is not one of the choices."""
    if value not in choices:
        raise InputError(f"{name} {value!r} is unknown; choose one of {', '.join(choices)}")


def check_sh_degree(name: str, degree: Any, n_coefficients: int) -> None:
    """Refuse an active degree outside 0 to 3, or one that needs more coefficients than there are."""
    if not isinstance(degree, int | np.integer) or not 0 <= degree <= SH_DEGREE_MAX:
        raise InputError(f"{name} is {degree!r}; it must be 0 to {SH_DEGREE_MAX}")
    if (degree + 1) ** 2 > n_coefficients:
        raise InputError(
            f"{name} is {degree}, which needs {(degree + 1) ** 2} coefficients a channel, but there are"
            f" {n_coefficients}; give a lower degree or more coefficients"
        )


def check_viewmats(name: str, viewmats: Floats) -> None:
    """Refuse matrices [C, 4, 4] that are not cam_from_world: bottom row 0 0 0 1, invertible 3 x 3 part."""
    if not len(viewmats):
        raise InputError(f"{name} holds no camera; give at least one")
    for c, matrix in enumerate(viewmats):
        if tuple(matrix[3]) != (0, 0, 0, 1):
            raise InputError(
                f"{name}[{c}] has the bottom row {' '.join(f'{x:g}' for x in matrix[3])}, not 0 0 0 1; give"
                " cam_from_world as [[R, t], [0, 1]], transposed if yours has t in its last row"
            )
        if np.linalg.matrix_rank(matrix[:3, :3]) < 3:
            raise InputError(f"{name}[{c}] has a singular 3 x 3 part; give a rotation")


def check_intrinsics(name: str, Ks: Floats) -> None:
    """Refuse matrices [C, 3, 3] that are not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy."""
    for c, K in enumerate(Ks):
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise InputError(f"{name}[{c}] has focal lengths {K[0, 0]:g} and {K[1, 1]:g}; they must be positive pixels")
        if K[0, 1] != 0:
            raise InputError(f"{name}[{c}] has skew {K[0, 1]:g}, which is not supported; rectify the image")
        if K[1, 0] != 0 or tuple(K[2]) != (0, 0, 1):
            raise InputError(f"{name}[{c}] is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; rewrite it so")


def choose_conventions(
    profile: str | Conventions,
    near_plane: float | None,
    far_plane: float | None,
    eps2d: float | None,
    rasterize_mode: str,
) -> Conventions:
    """Return the profile, given itself or by name, with the other values that were given instead of its own."""
    if isinstance(profile, str):
        check_choice("profile", profile, tuple(PROFILES))
        profile = PROFILES[profile]
    check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    near = profile.near_plane if near_plane is None else near_plane
    far = profile.far_plane if far_plane is None else far_plane
    blur = profile.eps2d if eps2d is None else eps2d
    if not 0 <= near < far:
        raise InputError(f"near_plane {near:g} and far_plane {far:g} are wrong; they must be 0 <= near < far")
    if not 0 <= blur < np.inf:
        raise InputError(f"eps2d is {blur:g}; it must be a finite number of px^2, at least 0")
    is_antialiased = rasterize_mode == "antialiased"
    return profile._replace(near_plane=near, far_plane=far, eps2d=blur, is_antialiased=is_antialiased)


def _brackets(shape: Shape | tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, shape))}]"


def _or(shapes: tuple[Shape, ...]) -> str:
    return "it must be " + " or ".join(map(_brackets, shapes))
