"""Claims of ``vdgs`` (VDGS, arXiv 2312.13729), measured."""

from data_tools.claims.kit.claim import OUT, RESUMED_OUT, declare, downscale, iterations, number, scene, seeds
from data_tools.claims.vdgs import floats, pane

CLAIMS = (
    declare(
        "pane",
        "a pane whose opacity follows Schlick's formula: learned against true",
        pane.run,
        *(OUT, iterations(600), seeds(3)),
    ),
    declare(
        "floats",
        "held-out PSNR of four modes with as many floats as harmonics alone",
        floats.run,
        *(scene(), RESUMED_OUT, downscale(), iterations(1000), seeds(3)),
        number("--gaussians", 10_000, "of harmonics alone, at most one for each point"),
    ),
)
