"""Representations of bundles: one line in a terminal, an image in a notebook.

A NamedTuple of arrays would print every number of them. A bundle that takes its ``__repr__`` from here prints the shape
and the dtype of each; one with ``_repr_png_``, which notebooks look for, is shown as its image.
"""

import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

LENGTH_MAX = 60  # letters of a value that is no array
THUMBNAIL = 160  # pixels of the longer side of each photograph of a sheet
SHEET_MAX, PER_ROW = 12, 6  # photographs


def one_line(bundle: Any) -> str:
    """Return the type of a NamedTuple with its fields: arrays as dtype and shape, others shortened."""
    fields = zip(bundle._fields, bundle, strict=True)
    return f"{type(bundle).__name__}({', '.join(f'{name}={_described(value)}' for name, value in fields)})"


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return f"{type(value).__name__}(...)"
    if isinstance(value, tuple | list) and len(value) > 3:
        return f"{len(value)} x {type(value[0]).__name__}"
    if isinstance(value, Mapping) and value:
        return f"{{{', '.join(map(str, value))}}}"
    text = " ".join(repr(value).split())
    return text if len(text) <= LENGTH_MAX else f"{text[: LENGTH_MAX - 3]}..."


def as_bytes(image: NDArray) -> NDArray[np.uint8]:
    """Return the first channels of an image [H, W, D] as sRGB bytes [H, W, 3]; floats are clipped to [0, 1]."""
    if image.dtype != np.uint8:
        image = np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)
    rgb: NDArray[np.uint8] = image[..., :3] if image.shape[-1] >= 3 else np.repeat(image[..., :1], 3, axis=-1)
    return rgb


def to_png(image: NDArray[np.uint8]) -> bytes:
    """Return an image [H, W, 3] as a PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "PNG")
    return buffer.getvalue()


def to_sheet(images: Iterable[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return the first photographs [H, W, 3] as thumbnails in rows, on white."""
    from PIL import Image

    thumbnails = []
    for image, _ in zip(images, range(SHEET_MAX), strict=False):
        small = Image.fromarray(image)
        small.thumbnail((THUMBNAIL, THUMBNAIL))
        thumbnails.append(np.asarray(small))
    rows = -(-len(thumbnails) // PER_ROW)
    columns = min(len(thumbnails), PER_ROW)
    height, width = (max((image.shape[axis] for image in thumbnails), default=1) for axis in (0, 1))
    sheet = np.full((max(rows, 1) * (height + 4), max(columns, 1) * (width + 4), 3), 255, np.uint8)
    for k, image in enumerate(thumbnails):
        y, x = k // PER_ROW * (height + 4), k % PER_ROW * (width + 4)
        sheet[y : y + image.shape[0], x : x + image.shape[1]] = image
    return sheet
