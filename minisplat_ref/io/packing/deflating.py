"""Gzip streams whose bytes depend on their content alone, at a level that their size allows.

Of quantised numbers, which hardly repeat, level 9 of zlib packs a megabyte a second and level 6 ten; the file becomes
2 to 3 % larger. So large files, of which nobody would wait for level 9, are packed at level 6.
"""

import zlib
from typing import Any

FINEST, USUAL = 9, 6  # levels of zlib
LARGE = 1 << 24  # bytes before packing, of some 250,000 Gaussians of degree 3; ours
GZIP = 31  # window bits of a gzip stream, without a file name and a time


def gzip_compressor(n_bytes: int) -> Any:
    """Return a compressor of zlib for a gzip stream that holds so many bytes."""
    return zlib.compressobj(FINEST if n_bytes <= LARGE else USUAL, zlib.DEFLATED, GZIP)
