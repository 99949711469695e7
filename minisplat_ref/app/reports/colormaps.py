"""The colour maps of images for inspection: viridis, magma and inferno by anchors, between which colours are linear.

They are those of Nathaniel Smith and Stefan van der Walt (CC0), which matplotlib has as well; a training, which colours
errors, does not need it. Of the 256 colours none differs by more than two levels of 255.
"""

import numpy as np

from minisplat_ref.types import Floats

N_LEVELS = 256
ANCHORS = {
    "viridis": (
        "440154470d6048186a482374472d7b4536814240863f49893b528b375a8d33638d2f6a8e2c728e297a8e26818e23898e"
        "21908c1f988b1f9f8821a68528ae8031b57b3ebc744cc26c5dc9636ece5882d34c96d83fabdc32c0df24d5e21aeae51a"
        "fde725"
    ),
    "magma": (
        "0000040303110a0822130d331d114628115a36106a430f7650127c5d177f691c817621818226818f2a819c2e7fa9327d"
        "b63779c33b75cf4170db486ae65163ee5c5ef5695cf9785dfb8761fd9668fea571feb47bfec387fed194fde0a2fceeb0"
        "fcfdbf"
    ),
    "inferno": (
        "0000040403120b0724150b37210c4a2e0a5a3c09654a0c6b57106d63146e70196e7d1e6d89226a962766a32b61af315c"
        "bb3755c63e4dd14644db4f3be35932eb6528f1711ef67f14f98d0afb9c06fcab0ffbba1ff9ca32f5d949f2e865f3f586"
        "fcffa4"
    ),
    "gray": "000000ffffff",
}
"""Colours as hexadecimal digits, at equal distances from the lowest value to the highest."""


def table(name: str) -> Floats:
    """Return the colours [256, 3] of a map, in levels of 0 to 255."""
    anchors = np.frombuffer(bytes.fromhex(ANCHORS[name]), np.uint8).reshape(-1, 3)  # [A, 3]
    places = np.linspace(0.0, len(anchors) - 1.0, N_LEVELS)
    return np.stack([np.interp(places, np.arange(len(anchors)), channel) for channel in anchors.T], axis=1)
