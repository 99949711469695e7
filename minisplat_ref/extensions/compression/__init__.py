"""Compression: compact files of Gaussians, and the loss of quality at their sizes.

No single paper is followed. Like all compact formats of 3DGS, this one sorts the Gaussians so that neighbours are
similar, quantises each field according to its meaning, and leaves the rest to an entropy coder.

``.msz`` (:mod:`minisplat_ref.extensions.compression.msz`) is the format of this project. Gaussians are in Morton order,
and every field is rounded to a lattice whose step is a power of two,

    q = rint(x / 2^e),   x' = 2^e q,   |x' - x| <= 2^(e-1)

which bounds the error of each number exactly, and which a second encoding does not change
(:mod:`minisplat_ref.extensions.compression.lattice`). Centres are stored as differences, bytes of equal significance
are stored together, and zstandard packs them. There are 13 levels; level 0 keeps each float32.

    minisplat-ref convert runs/fox fox.msz --max-drop 0.1
    minisplat-ref convert fox.msz fox.ply
    python -m data_tools.claims compression/rate-distortion SCENE --out DIR

The order of the Gaussians is not preserved; only ties in depth depend on it. Quaternions come back with another length,
which has no meaning. Files hold the six fields of 3DGS; the fields of an extension need a PLY. An extension that
renders these six in another way is recorded in the header. Other programs' formats are in
:mod:`minisplat_ref.io.formats`.

Left out are pruning, merging and training with the quantiser in the loop, which gain more than any entropy coder;
vector quantisation, which ``.omg`` does; and arithmetic coding. ``docs/family/compression.md`` has the measured
figures.
"""

from minisplat_ref.extensions.compression.msz import MSZ
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("compression", formats=(MSZ,))
"""The format of this project."""
