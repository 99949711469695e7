"""PLY files of Gaussians from programs other than 3DGS: their columns under the names of 3DGS.

- other names, in upper or lower case: ``scaling_0``, ``scale_x``, ``rotation_0``, ``quat_w``, ``features_dc_0``, ...;
- colours ``red, green, blue`` instead of ``f_dc_0..2``, as nerfstudio exports them in its mode ``rgb``;
- two scales, of flat Gaussians (2DGS): the third axis becomes a thousandth of the smaller one;
- opacities of plus or minus infinity, the logits of 1 and 0, and scales of minus infinity, the logarithm of 0.

Numbers after a name are in the order of 3DGS, so ``rot_0`` is w; letters are explicit. Values keep their meaning:
logarithms of scales, logits of opacities.
"""

import math
import re
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_C0
from minisplat_ref.errors import InputError, InputWarning, one_line

STEMS = {
    **{stem: "" for stem in ("pos", "position", "positions", "mean", "means", "xyz", "center", "centre")},
    **{stem: "f_dc" for stem in ("features_dc", "feature_dc", "sh_dc", "dc", "f_dc")},
    **{stem: "f_rest" for stem in ("features_rest", "feature_rest", "sh_rest", "f_rest")},
    **{stem: "opacity" for stem in ("opacity", "opacities", "opacity_logit", "opacity_logits", "logit_opacity")},
    **{stem: "scale" for stem in ("scale", "scales", "scaling", "log_scale", "log_scales", "s")},
    **{
        stem: "rot"
        for stem in ("rot", "rots", "rotation", "rotations", "quat", "quats", "quaternion", "q", "orientation")
    },
}
"""Other programs' names of the properties of 3DGS, without the number or letter at the end."""

LETTERS = {"": "xyz", "scale": "xyz", "rot": "wxyz"}
"""The order of the letters at the end of a name."""

NUMBERED = re.compile(r"(.*?)[_.\[(]*(\d+)[\])]?")
LETTERED = re.compile(r"(.*?)[_.]?([wxyz])")
DC, RGB = ("f_dc_0", "f_dc_1", "f_dc_2"), ("red", "green", "blue")
OPACITY_LOGIT_MAX = 16.0  # of an opacity of 1 - 1e-7, the largest below 1 in float32
LOG_SCALE_MIN = -30.0  # 1e-13 units; its square is still representable in float32
FLATNESS = 1000.0  # of a Gaussian with two scales


def usual_name(name: str) -> str:
    """Return the name of a property in 3DGS, or the name itself."""
    folded = name.casefold().replace(" ", "_")
    if folded in ("x", "y", "z"):
        return folded
    if STEMS.get(folded) == "opacity":
        return "opacity"
    numbered, lettered = NUMBERED.fullmatch(folded), LETTERED.fullmatch(folded)
    if numbered is not None and (stem := STEMS.get(numbered[1])) is not None:
        number = int(numbered[2])
        if stem == "opacity":
            return stem if number == 0 else name
        if stem:
            return f"{stem}_{number}"
        return "xyz"[number] if number < 3 else name
    if lettered is not None and (stem := STEMS.get(lettered[1])) in LETTERS:
        index = LETTERS[stem].find(lettered[2])
        return name if index < 0 else f"{stem}_{index}" if stem else lettered[2]
    return name


def renamed(names: Collection[str]) -> dict[str, str]:
    """Return by their names the properties of a file that 3DGS calls otherwise, and that are not there as it does."""
    found = {name: usual_name(name) for name in names}
    return {name: usual for name, usual in found.items() if usual != name and usual not in names}


def as_usual(path: str | Path, columns: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Return the columns of a PLY of Gaussians as 3DGS would have written them; a warning lists the changes.

    Parameters
    ----------
    path : str or Path
        The file, for messages.
    columns : mapping of str to ndarray of shape (P,)
        As the file has them. Those of other files than of Gaussians stay as they are.

    Raises
    ------
    InputError
        A colour is out of range.
    """
    names = renamed(columns)
    usual = {names.get(name, name): column for name, column in columns.items()}
    if not {"opacity", "scale_0", "scale_1", "rot_3"} <= usual.keys():
        return dict(columns)
    notes = []
    colors = {name.casefold(): name for name in columns}
    if not any(name in usual for name in DC) and all(name in colors for name in RGB):
        for dc, color in zip(DC, RGB, strict=True):
            usual[dc] = _coefficients(path, color, usual[colors[color]])
        notes.append("its colours are red, green, blue: the same from all sides")
    if "scale_2" not in usual:
        smaller = np.minimum(usual["scale_0"], usual["scale_1"])
        usual["scale_2"] = (smaller - math.log(FLATNESS)).astype(smaller.dtype)
        notes.append(f"its Gaussians have two scales: their third axis is 1/{FLATNESS:g} of the smaller one")
    notes += _make_finite(usual)
    if notes:
        warnings.warn(one_line(f"{path}: {'; '.join(notes)}"), InputWarning, stacklevel=3)
    return usual


def _coefficients(path: str | Path, name: str, values: NDArray) -> NDArray[np.float32]:
    """Return the harmonics' coefficients of degree 0 of colours, integers from 0 to 255 or floats from 0 to 1."""
    white = 1.0 if values.dtype.kind == "f" else 255.0
    low, high = values.min(initial=0), values.max(initial=0)
    if not (low >= 0 and high <= white):
        raise InputError(
            f"{path}: {name} goes from {low:g} to {high:g}; colours are integers from 0 to 255 or floats from 0 to 1:"
            " export them as uchar"
        )
    return ((values / white - 0.5) / SH_C0).astype(np.float32)


def _make_finite(columns: dict[str, NDArray]) -> list[str]:
    """Replace infinities that have a meaning by the nearest number that renders; return a list of the replacements."""
    notes = []
    opacity = columns["opacity"]
    if (n := np.count_nonzero(np.isinf(opacity))) > 0:
        columns["opacity"] = np.where(np.isinf(opacity), np.sign(opacity) * OPACITY_LOGIT_MAX, opacity).astype(
            opacity.dtype
        )
        notes.append(f"{n} of {len(opacity)} opacities are infinite, the logits of 0 or 1: taken as +-16")
    scales = [f"scale_{i}" for i in range(3)]
    is_zero = np.any([np.isneginf(columns[name]) for name in scales], axis=0)  # [P]
    if (n := np.count_nonzero(is_zero)) > 0:
        for name in scales:
            column = columns[name]
            columns[name] = np.where(np.isneginf(column), LOG_SCALE_MIN, column).astype(column.dtype)
        notes.append(f"{n} of {len(is_zero)} Gaussians have a scale of minus infinity, a size of 0: taken as e^-30")
    return notes
