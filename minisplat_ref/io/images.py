"""Photographs in, renders out: 8-bit sRGB arrays of shape [H, W, 3], [H, W, 4] with alpha, or masks [H, W].

Pixels come as the file stores them: an EXIF orientation is not applied, because cameras describe the stored grid
(``minisplat-ref sfm`` turns photographs upright before it estimates cameras). Files of 16 bits a channel keep the upper
8. Resizing uses Pillow's LANCZOS for colours, which averages over the widened filter when it shrinks and so does not
alias, and area means for masks. Left out: colour profiles, raw formats, high dynamic range.
"""

import io
import os
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.types import Bools, Floats

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Files that count as photographs."""

SAVE_OPTIONS: dict[str, dict[str, Any]] = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"quality": 95}}
PIXELS_MAX = 2**29  # per image: more than cameras have, and 1.6 GB in memory
PLAUSIBLE_PIXELS = 100_000_000  # up to this size, an image may be compressed into any number of bytes
PIXELS_PER_BYTE = 10_000  # limit for larger ones: a white 1-bit PNG has 8256 pixels per byte
DAMAGE_ERRORS = (  # what Pillow's decoders raise for damaged files
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError),
    *(RuntimeError, struct.error, zlib.error),
)
_LOCK = threading.Lock()  # Pillow's limit and Python's warning filters are shared by all threads
MASK_THRESHOLD = 128  # a mask pixel counts from half white on; masks saved as JPEG are not exactly 0 and 255


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image file with Pillow; any error in decoding becomes an InputError that names the file.

    Pillow's limit of pixels, beyond which it reports a decompression bomb, is below the size of phone photographs; ours
    is :data:`PIXELS_MAX`. Pillow's warnings, such as damaged EXIF data, do not matter here. One thread at a time.
    """
    try:
        with _LOCK, _File(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with _without_limit():
                opened = Image.open(file)
            with opened as image:
                check_n_pixels(path, *image.size)
                if image.width * image.height > max(PLAUSIBLE_PIXELS, PIXELS_PER_BYTE * file.n_bytes):
                    raise InputError(
                        f"{path}: {image.width} x {image.height} pixels cannot be in {file.n_bytes} bytes; copy or"
                        " export the file again"
                    )
                yield image
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such image") from None
    except UnidentifiedImageError:
        raise InputError(f"{path}: not an image that Pillow can read; convert it to PNG or JPEG") from None
    except MemoryError:
        raise InputError(f"{path}: its pixels do not fit in memory; make the image smaller") from None
    except DAMAGE_ERRORS as error:
        raise InputError(f"{path}: cannot be decoded ({error}); copy or export the file again") from error


class _File(io.BufferedReader):
    """A file that never reads more bytes than it has: Pillow requests as many as a damaged PNG claims."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.n_bytes = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most the whole file."""
        return super().read(size if size is None or size < 0 else min(size, self.n_bytes))


@contextmanager
def _without_limit() -> Iterator[None]:
    """Lift Pillow's limit of pixels while a file is opened, which reads no pixels."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def check_n_pixels(what: str | Path, width: int, height: int) -> None:
    """Refuse an image that is larger than any photograph."""
    if width * height > PIXELS_MAX:
        raise InputError(
            f"{what}: {width} x {height} pixels, more than the {PIXELS_MAX:,} that are read; make it smaller"
        )


def image_size(path: str | Path) -> tuple[int, int]:
    """Return width and height in pixels, from the file's header alone."""
    with open_image(Path(path)) as image:
        return image.size


def is_turned(path: str | Path) -> bool:
    """Return whether the file's EXIF orientation exchanges width and height."""
    with open_image(Path(path)) as image:
        return image.getexif().get(ExifTags.Base.Orientation, 1) in (5, 6, 7, 8)


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """Read an image file as 8-bit RGB, or RGBA where the file has transparency.

    Parameters
    ----------
    path : str or Path
        PNG, JPEG or whatever else Pillow decodes; gray, palette, CMYK and 16-bit files are converted.

    Returns
    -------
    ndarray of shape (H, W, 3) or (H, W, 4)
        uint8, sRGB as stored; alpha straight, not multiplied in.

    Raises
    ------
    InputError
        If the file is missing, is not an image or is truncated.
    """
    with open_image(Path(path)) as image:
        return pixels_of(image)


def pixels_of(image: Image.Image) -> NDArray[np.uint8]:
    """Return the pixels of an opened image as :func:`read_image` does, [H, W, 3] or [H, W, 4]."""
    if image.mode.startswith("I"):  # gray of 16 bits; Pillow itself keeps the upper byte of 16-bit colour files
        gray = (np.asarray(image) >> 8).clip(0, 255).astype(np.uint8)  # [H, W]
        return np.repeat(gray[..., None], 3, axis=2)  # [H, W, 3]
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.array(image if image.mode == mode else image.convert(mode))  # converting would copy it in any case


def read_mask(path: str | Path) -> Bools:
    """Read a mask file: True where it is white (and opaque, if it has alpha).

    Returns
    -------
    ndarray of shape (H, W)
        bool.
    """
    pixels = read_image(path)
    is_opaque = np.all(pixels[..., 3:] >= MASK_THRESHOLD, axis=2)  # [H, W], True without alpha
    is_white = np.any(pixels[..., :3] >= MASK_THRESHOLD, axis=2)
    return np.asarray(is_opaque & is_white)


def composite_alpha(image: NDArray[np.uint8], background: Floats) -> NDArray[np.uint8]:
    """Lay a straight-alpha image over one colour: ``alpha rgb + (1 - alpha) background``, in stored (sRGB) values.

    Parameters
    ----------
    image : ndarray of shape (H, W, 4)
        RGBA, uint8.
    background : ndarray of shape (3,)
        Colour in [0, 1].

    Returns
    -------
    ndarray of shape (H, W, 3)
        uint8, rounded.
    """
    alpha = image[..., 3:] / 255.0  # [H, W, 1]
    return np.rint(alpha * image[..., :3] + (1.0 - alpha) * (255.0 * background)).astype(np.uint8)


def resize_image(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Resize [H, W, 3] to [height, width, 3] with Pillow's LANCZOS filter."""
    return np.array(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))


def resize_mask(mask: Bools, width: int, height: int) -> Bools:
    """Resize [H, W] to [height, width]; a pixel counts when at least half of its area does."""
    area = Image.fromarray(mask.astype(np.float32)).resize((width, height), Image.Resampling.BOX)
    return np.asarray(area) >= 0.5


def downscaled_size(width: int, height: int, factor: int) -> tuple[int, int]:
    """Return width and height in pixels after division by ``factor``, rounded, at least 1."""
    return max(1, round(width / factor)), max(1, round(height / factor))


def write_image(path: str | Path, image: NDArray) -> None:
    """Write an image file, complete or not at all.

    Parameters
    ----------
    path : str or Path
        File to make or replace; its suffix chooses the format. JPEGs are of quality 95 without chroma subsampling,
        WebPs of quality 95.
    image : ndarray of shape (H, W), (H, W, 3) or (H, W, 4)
        uint8, bool as black and white, or floats, clipped to [0, 1] and rounded to the nearest of 256 levels.

    Raises
    ------
    InputError
        If a value is NaN, the suffix is not an image's, or the folder does not exist.
    """
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * np.uint8(255)
    elif image.dtype != np.uint8:
        if np.isnan(image).any():
            raise InputError(f"{path}: the image has {np.isnan(image).sum()} NaN values; nothing was written")
        image = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    image_format = Image.registered_extensions().get(Path(path).suffix.lower())
    if image_format is None:
        raise InputError(f"{path}: no image format has this suffix; use .png or .jpg")
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format=image_format, **SAVE_OPTIONS.get(image_format, {}))
