"""Photographs in, renders out: 8-bit sRGB arrays of shape [H, W, 3], [H, W, 4] with alpha, or masks [H, W].

Pixels come as the file stores them: an EXIF orientation is not applied, because cameras describe the stored grid
(``minisplat-ref sfm`` turns photographs upright before it estimates cameras). Files of 16 bits a channel keep the upper
8, floats from 0 to 1 become 0 to 255. Which value is white is never guessed from the values of a file: 32-bit integers,
and floats beyond 0 to 1, are refused. Resizing uses Pillow's LANCZOS for colours, which averages over the widened
filter when it shrinks and so does not alias, and area means for masks. Left out: colour profiles, raw formats, high
dynamic range.
"""

import io
import os
import re
import struct
import threading
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, UnidentifiedImageError

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.types import Bools, Floats

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".insp", ".webp", ".tif", ".tiff", ".bmp", ".dib", ".apng"),
    *(".gif", ".ppm", ".pgm", ".pbm", ".pnm", ".pfm", ".tga", ".jp2", ".j2k", ".jpf", ".jpx", ".jpc", ".j2c", ".avif"),
    *(".pcx", ".psd", ".qoi", ".sgi", ".ras"),
)
"""Files that count as photographs: what Pillow opens of images of pixels. Of several in one file the first counts."""

HEIF_SUFFIXES = (".heic", ".heif", ".hif")
"""Photographs of telephones, which pillow-heif reads, the extra ``heic``."""

PHOTOGRAPHS = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)
"""All of these, whether their packages are installed or not."""

UNREAD_SUFFIXES = (
    *(".jxl", ".jxr", ".exr", ".hdr", ".psb"),
    *(".dng", ".raw", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".rwl"),
    *(".pef", ".srw", ".3fr", ".fff", ".erf", ".kdc", ".dcr", ".mrw", ".mef", ".mos", ".iiq", ".x3f", ".gpr"),
)
"""Formats of photographs that are not read."""

FORMATS_BY_SUFFIX = {".insp": "JPEG"}
"""Formats of suffixes that Pillow does not know."""
PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(equirectangular|cylindrical)", re.IGNORECASE)
"""In a file's XMP data: it is a panorama."""

BY_PRODUCT = re.compile(r"\..+|@eaDir|__MACOSX|thumbnails?|thumbs", re.IGNORECASE)
"""Names of hidden files and folders, and of those that programs put next to photographs."""

SAVE_OPTIONS: dict[str, dict[str, Any]] = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"quality": 95}}
SOURCE = "minisplat_ref source"  # key of an opened image's path among its data, for messages on its values
SIXTEEN_BIT_FORMATS = ("PNG", "PPM")  # whose 16-bit images some versions of Pillow keep in 32 bits
HALF_LEVEL = 0.5 / 255.0  # by which a float may be outside 0 to 1: it rounds to black or white all the same
PIXELS_MAX = 2**29  # per image: more than cameras have, and 1.6 GB in memory
PLAUSIBLE_PIXELS = 100_000_000  # up to this size, an image may be compressed into any number of bytes
PIXELS_PER_BYTE = 10_000  # limit for larger ones: a white 1-bit PNG has 8256 pixels per byte
DAMAGE_ERRORS = (  # errors of Pillow's decoders for damaged files
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, EOFError),
    *(RuntimeError, struct.error, zlib.error),
)
_LOCK = threading.Lock()  # Pillow's limit and Python's warning filters are shared by all threads
SIDE_MIN = 16  # pixels; SSIM compares windows of 11 x 11, and 3DGS cuts an image into tiles of 16 x 16
MASK_THRESHOLD = 128  # a mask pixel counts from half white on; masks saved as JPEG are not exactly 0 and 255


def readable_suffixes() -> tuple[str, ...]:
    """Return the suffixes of photographs that can be read here, with those of packages that are installed."""
    return (*IMAGE_SUFFIXES, *(HEIF_SUFFIXES if find_spec("pillow_heif") else ()))


def flat_size(path: str | Path) -> tuple[int, int]:
    """Return width and height in pixels of a photograph, from the file's header alone.

    Raises
    ------
    InputError
        The file cannot be opened, or is a panorama.
    """
    with open_image(Path(path)) as image:
        check_flat(image)
        return image.size


def check_flat(image: Image.Image) -> None:
    """Refuse a panorama, which no pinhole and no lens shows, by what its data say of its projection."""
    texts = [image.info.get(key, b"") for key in ("xmp", "XML:com.adobe.xmp")]
    texts = [text.encode(errors="replace") if isinstance(text, str) else text for text in texts]
    projections = [match[1].decode().lower() for text in texts if (match := PROJECTION.search(bytes(text)))]
    if projections:
        raise InputError(
            f"{_source(image)}: a panorama ({projections[0]}), of which there is no pinhole view: cut flat views out of"
            " it, for example by ffmpeg -i PANORAMA -vf v360=e:flat:yaw=Y:h_fov=90:v_fov=90 VIEW.jpg for Y = -90, 0, 90"
            " and 180, and give those"
        )


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image file with Pillow; any error in decoding becomes an InputError that names the file.

    Pillow's limit of pixels, beyond which it reports a decompression bomb, is below the size of phone photographs; ours
    is :data:`PIXELS_MAX`. Pillow's warnings, such as damaged EXIF data, do not matter here. One thread at a time.
    """
    if path.suffix.lower() in HEIF_SUFFIXES and find_spec("pillow_heif"):
        import pillow_heif

        pillow_heif.register_heif_opener()
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
                image.info[SOURCE] = str(path)
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


def has_transparency(path: str | Path) -> bool:
    """Return whether the file has an alpha channel or a transparent colour, from its header alone."""
    with open_image(Path(path)) as image:
        return image.has_transparency_data


def white_level(image: Image.Image) -> float:
    """Return the value that is white in an open image file.

    Raises
    ------
    InputError
        The value of white is undefined: integers of 32 bits have no agreed range.
    """
    if image.mode == "F":
        return 1.0
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format in SIXTEEN_BIT_FORMATS):
        return 65535.0
    if image.mode == "I":
        low, high = image.getextrema()
        raise InputError(
            f"{_source(image)}: integers of 32 bits, from {low} to {high}, do not say which value is white; export the"
            " image with 8 or 16 bits a channel"
        )
    return 255.0


def read_image(path: str | Path) -> NDArray[np.uint8]:
    """Read an image file as 8-bit RGB, or RGBA where the file has transparency.

    Parameters
    ----------
    path : str or Path
        PNG, JPEG or whatever else Pillow decodes; gray, palette, CMYK and 16-bit files are converted, and floats from
        0 to 1.

    Returns
    -------
    ndarray of shape (H, W, 3) or (H, W, 4)
        uint8, sRGB as stored; alpha straight, not multiplied in.

    Raises
    ------
    InputError
        If the file is missing, is not an image, is truncated, or has no defined value of white.
    """
    with open_image(Path(path)) as image:
        return decode_pixels(image)


def decode_pixels(image: Image.Image) -> NDArray[np.uint8]:
    """Return the pixels of an opened image as :func:`read_image` does, [H, W, 3] or [H, W, 4]."""
    white = white_level(image)
    if white != 255.0:  # gray; Pillow itself keeps the upper byte of 16-bit colour files
        levels = np.asarray(image)  # [H, W]
        gray = _floats_as_bytes(_source(image), levels) if white == 1.0 else (levels >> 8).clip(0, 255).astype(np.uint8)
        return np.repeat(gray[..., None], 3, axis=2)  # [H, W, 3]
    mode = "RGBA" if image.has_transparency_data else "RGB"
    return np.array(image if image.mode == mode else image.convert(mode))  # converting would copy it in any case


def _source(image: Image.Image) -> str:
    """Return the path of an opened image, for messages."""
    return str(image.info.get(SOURCE, "an image"))


def _floats_as_bytes(path: str, levels: Floats) -> NDArray[np.uint8]:
    """Return floats from 0 to 1 as bytes; refuse others, except for what rounding would hide."""
    low, high = levels.min(), levels.max()
    if not (low >= -HALF_LEVEL and high <= 1.0 + HALF_LEVEL):  # True for NaN
        raise InputError(
            f"{path}: floats from {low:g} to {high:g}, but 1 is white and 0 black; scale the values to 0 to 1 and clip"
            " them, or export the image with 8 or 16 bits a channel"
        )
    return np.rint(255.0 * levels.clip(0.0, 1.0)).astype(np.uint8)


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
    return mask_areas(mask, width, height) >= 0.5


def mask_areas(mask: Bools, width: int, height: int) -> Floats:
    """Return the share of each pixel [height, width] that a mask [H, W] covers."""
    return np.asarray(Image.fromarray(mask.astype(np.float32)).resize((width, height), Image.Resampling.BOX))


def downscaled_size(width: int, height: int, factor: int) -> tuple[int, int]:
    """Return width and height in pixels after division by ``factor``, rounded, at least 1."""
    return max(1, round(width / factor)), max(1, round(height / factor))


def check_downscale(source: str | Path, sizes: Iterable[tuple[int, int]], factor: int) -> None:
    """Refuse to make photographs smaller than :data:`SIDE_MIN`; those that are so small themselves pass.

    Parameters
    ----------
    source : str or Path
        Scene or folder, for the message.
    sizes : iterable of (int, int)
        Width and height of the photographs, pixels.
    factor : int
        At least 1.

    Raises
    ------
    InputError
        Names the size, and the largest factor that all photographs allow.
    """
    smallest = min(sizes, key=min, default=None)
    if smallest is None or factor == 1 or min(downscaled_size(*smallest, factor)) >= SIDE_MIN:
        return
    width, height = downscaled_size(*smallest, factor)
    largest = max(1, min(smallest) // SIDE_MIN)
    raise InputError(
        f"{source}: --downscale {factor} leaves {width} x {height} pixels of a photograph, and hardly any structure can"
        f" be learned from fewer than {SIDE_MIN} x {SIDE_MIN}: give at most {largest}"
    )


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
    suffix = Path(path).suffix.lower()
    image_format = Image.registered_extensions().get(suffix, FORMATS_BY_SUFFIX.get(suffix))
    if image_format is None:
        raise InputError(f"{path}: no image format has this suffix; use .png or .jpg")
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format=image_format, **SAVE_OPTIONS.get(image_format, {}))
