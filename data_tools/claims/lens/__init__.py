"""Claims of ``lens`` (3DGUT, arXiv 2412.12507), measured."""

from data_tools.claims.kit.claim import OUT, RESUMED_OUT, declare, iterations, number, seed, seeds
from data_tools.claims.lens import fisheye, footprints

CLAIMS = (
    declare(
        "footprints",
        "EWA, UT and exact footprints off the axis of a lens",
        footprints.run,
        OUT,
        number("--gaussians", 20, "number of Gaussians"),
        seed("of the Gaussians"),
    ),
    declare(
        "fisheye",
        "a fisheye of 150 degrees as photographed and undistorted",
        fisheye.run,
        RESUMED_OUT,
        number("--width", 160, "of the photographs, pixels; their height is 3/4 of it", minimum=16, metavar="W"),
        iterations(1000),
        seeds(3),
    ),
)
