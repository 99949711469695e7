"""Compression: compact files of Gaussians, and what their bytes cost in quality.

No single paper is followed. What all compact formats of 3DGS share is here: sort the Gaussians so that neighbours are
alike, quantise each field as its meaning allows, and leave the rest to a packer.

``.msz`` (:mod:`minisplat_ref.extensions.compression.msz`) is the format of this project. The order is Morton's. Every
field is rounded to a lattice whose step is a power of two,

    q = rint(x / 2^e),   x' = 2^e q,   |x' - x| <= 2^(e-1)

which bounds the error of each number exactly, and which a second encoding does not change
(:mod:`minisplat_ref.extensions.compression.lattice`). Centres follow as differences, bytes of equal weight stand
together, and zstandard packs them. There are 13 levels; level 0 keeps each float32.

``.spz`` (:mod:`minisplat_ref.extensions.compression.spz`) is Niantic's, versions 2 and 3, for other programs.

    minisplat-ref convert runs/fox fox.msz --max-drop 0.1
    minisplat-ref convert fox.msz fox.ply
    minisplat-ref study compression/rate-distortion SCENE --out DIR

What to know: the order of the Gaussians is not kept, and nothing depends on it but ties in depth. Quaternions come back
with another length, which means nothing. Files keep the six fields of 3DGS; the fields of an extension need a PLY.

Measured on the room (``study compression/rate-distortion room``, three seeds): of 248 bytes a Gaussian in a PLY level 5
leaves 34 and loses 0.004 dB, level 10 leaves 18.5 and loses 0.10 dB; SPZ has 18.8 and loses 0.29 dB. On the fox, 1,500
iterations, SPZ loses 1.21 dB, of which 1.19 are its higher harmonics of 4 and 5 bits, and level 10 loses 0.21 dB at the
same size. Where the room is 512 times smaller, the fixed steps of SPZ lose 10.9 dB, and level 5 loses what it lost.

Left out: pruning, merging and training with the quantiser in the loop, which gain more than any packer; vector
quantisation, which ``.omg`` does; arithmetic coding.
"""

from minisplat_ref.extensions.compression.msz import MSZ
from minisplat_ref.extensions.compression.spz import SPZ
from minisplat_ref.extensions.compression.study import RATE_DISTORTION
from minisplat_ref.extensions.extension import Extension

EXTENSION = Extension("compression", formats=(MSZ, SPZ), studies=(RATE_DISTORTION,))
"""Two formats, and a study."""
