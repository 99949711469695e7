"""Claims of ``mixed`` (MP-GS, arXiv 2507.11321), measured."""

from data_tools.claims.kit.claim import OUT, argument, declare, downscale, iterations, seeds
from data_tools.claims.mixed import scene, shapes

_FITS = (OUT, iterations(400, "of each training"), seeds(3))


CLAIMS = (
    declare("shapes", "how many ellipses match a line or a triangle", shapes.run_shapes, *_FITS),
    declare("letter", "a letter and a ring by few ellipses, lines or triangles", shapes.run_letter, *_FITS),
    declare(
        "scene",
        "ellipses, lines and triangles against 3DGS of as many floats",
        scene.run,
        argument("scenes", nargs="+", metavar="SCENE", help="folders, or synthetic scenes such as room"),
        *(downscale(4), iterations(400), seeds(2), OUT),
    ),
)
