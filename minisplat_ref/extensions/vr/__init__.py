"""VR: Mini-Splatting on tangent planes, sorted per pixel, with fewer rays away from the gaze.

VRSplat, Tu et al. 2025, arXiv 2505.10144, combines three methods, so that a headset shows few Gaussians without popping
and without stretched edges: Mini-Splatting's small model; StopThePop's order and Optimal Projection
(:mod:`minisplat_ref.mechanisms.tangent.planes`, which the extension ``pixel-order`` uses on their own); and
foveated rendering (:mod:`minisplat_ref.extensions.vr.foveation`). The recipe ``vr`` is Mini-Splatting2, trained with
the footprints and the order with which it is drawn.

    minisplat-ref train SCENE --recipe vr --out runs/vr
    minisplat-ref vr render runs/vr/point_cloud.ply --gaze 320,240 --out pictures
    minisplat-ref study vr/foveation SCENE --ply runs/vr/point_cloud.ply --out DIR
    minisplat-ref study vr/yaw --ply runs/vr/point_cloud.ply --out DIR

Measured on the fox at 135 x 240 with 4,572 Gaussians of Mini-Splatting2 (``study vr/foveation fox --downscale 2``):
with 8 degrees in full, 40 % of the rays are drawn; this costs 0.4 dB of the PSNR weighted by acuity, 0.8 dB of the
plain one. It saves no time there, because each zone projects all Gaussians again, and a zone of large tiles lists as
many pairs. When the camera turns by half a degree, fixed rays change by up to 1.3e-2 under 3DGS and by 3e-15 here
(``study vr/yaw``).

This deviates from the paper, which trains Mini-Splatting first and fine-tunes with its renderer for 5,000 iterations;
here the whole training draws as the headset does, and importance, surfaces and median depths are those of 3DGS's
footprints. One buffer of 16 hits replaces the queues of tiles, blocks and pixels. We did not find the paper's rates by
eccentricity in numbers; here there are three zones, whose ends follow an acuity that is linear in the eccentricity.
Frame rates, which are a GPU's, are left out; work is counted in rays, tiles and pairs. The user study cannot be
repeated.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.vr import render
from minisplat_ref.extensions.vr.method import HEADSET, VR
from minisplat_ref.extensions.vr.stages import stages
from minisplat_ref.extensions.vr.study import FOVEATION, YAW

EXTENSION = Extension(
    "vr", recipes=(VR,), representation=HEADSET, commands=(render,), stages=stages, studies=(FOVEATION, YAW)
)
