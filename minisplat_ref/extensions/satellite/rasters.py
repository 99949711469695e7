"""Images that only rasterio reads: GeoTIFF and its relatives, and depths of 16 bits."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError, one_line

RASTERS = (".tif", ".tiff", ".jp2", ".ntf", ".nitf")  # whose metadata may hold an RPC, and which rasterio reads


@contextmanager
def open_raster(path: Path) -> Iterator[Any]:
    """Open an image by rasterio.

    Raises
    ------
    InputError
        It is damaged or in an unknown format, or rasterio is not installed.
    """
    rasterio = import_rasterio(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # its RPC is its place
            with rasterio.open(path) as file:
                yield file
    except rasterio.errors.RasterioError as error:
        raise InputError(f"{path}: cannot be read, {one_line(str(error))}; export it again") from error


def import_rasterio(path: Path) -> Any:
    """Return rasterio, which few need.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        import rasterio
    except ImportError as error:
        raise InputError(
            f"{path}: GeoTIFF and 16 bits need rasterio: pip install 'minisplat-ref[satellite]', or use texts,"
            " PNGs of 8 bits and .npy"
        ) from error
    return rasterio
