"""VR: Mini-Splatting on tangent planes, sorted per pixel, with fewer rays away from the gaze.

This follows VRSplat, Tu et al. 2025, arXiv 2505.10144, which combines three methods, so that a headset shows few
Gaussians without popping and without stretched edges: Mini-Splatting's small model; StopThePop's order and Optimal
Projection (:mod:`minisplat_ref.mechanisms.tangent.planes`, which the extension ``pixel-order`` uses on their own); and
foveated rendering (:mod:`.foveation`). As in the paper, the recipe ``vr-fine-tuning`` trains a finished model of
Mini-Splatting for 5,000 iterations with the footprints and the order with which it is rendered, and changes no number
of Gaussians; ``vr`` is Mini-Splatting2 with them from the start.

    minisplat-ref train SCENE --recipe mini-splatting --out runs/few
    minisplat-ref train SCENE --recipe vr-fine-tuning --init runs/few --iterations 5000 --out runs/vr
    minisplat-ref train SCENE --recipe vr --out runs/whole
    minisplat-ref vr render runs/vr/point_cloud.ply --gaze 320,240 --out images
    python -m data_tools.claims vr/foveation SCENE --ply runs/vr/point_cloud.ply --out DIR
    python -m data_tools.claims vr/queues --ply runs/vr/point_cloud.ply --out DIR
    python -m data_tools.claims vr/yaw --ply runs/vr/point_cloud.ply --out DIR

``docs/family/vr.md`` has the measured figures.

This deviates from the paper. One buffer of 16 hits replaces StopThePop's queues of tiles, blocks and pixels, with which
:mod:`data_tools.claims.vr.queues` compares it. We did not find figures of the paper's rates by eccentricity;
here there are three zones, whose ends follow an acuity that is linear in the eccentricity. Importance, surfaces and
median depths of ``vr`` are those of its own footprints in each pixel's order. Frame rates, which are a GPU's, are left
out; work is counted in rays, tiles and pairs. The user study cannot be repeated.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.vr import render
from minisplat_ref.extensions.vr.model import HEADSET, VR, VR_FINE_TUNING, stages

EXTENSION = Extension(
    "vr",
    recipes=(VR, VR_FINE_TUNING),
    representation=HEADSET,
    commands=(render,),
    stages=stages,
)
