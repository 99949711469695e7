"""Satellite: affine cameras, the sun's shadows and the light of each photograph.

From 500 km away all rays are parallel but for a thousandth, so a satellite's camera is an affine map, fitted to the
rational polynomials that come with its images (:mod:`.cameras`). This follows EOGS, Aira et al. 2024,
"Gaussian Splatting for Efficient Satellite Image Photogrammetry", arXiv 2412.13047::

    mean = A x + b,   Sigma2 = A_xy Sigma A_xy^T + 0.3 I          exactly; the highest first
    s = exp(0.4 min(h - h_s, 0))                                  h_s: altitude in the sun's image, M A
    I = (s + (1 - s) k) (C a + c)                                 C, c, k of each photograph

h is the altitude that the camera renders and a the albedo. Besides ``L1 + D-SSIM``, the loss has the sum of opacities
(0.1) and, from iteration 1,000 of 5,000 on, the agreement with a camera that is sheared at random (altitude 0.01,
albedo 0.1, where they differ by less than 0.3) and the entropy of shadows (0.01), which begin then. There is no density
control but pruning, and no harmonics. At the end the radiometry of the first photograph goes into all colours. The
surface model is the altitude that a camera in the zenith renders.

    minisplat-ref satellite scene IMAGES --altitudes 0,80 --out SCENE
    minisplat-ref train SCENE --recipe satellite --out RUN
    minisplat-ref satellite dsm RUN --out dsm.npy
    python -m data_tools.claims satellite/boxes --out DIR
    python -m data_tools.claims satellite/distance --out DIR
    minisplat-ref oracle gradients --extension satellite

``docs/family/satellite.md`` has the measured figures.

This deviates from the paper as follows. Altitudes are divided by alpha; where almost nothing is, alpha counts as 0.05.
The exponent 0.4, the limit 0.3 and the shear's 0.01 are per metre. The nearly transparent start and the random
background are those of EOGS2, the successor's code, though opacities begin at 0.005 instead of 0.01, and sizes at half:
points in a volume begin as a fog, and on black a translucent surface of bright colours looks like an opaque one. This
start is worth half a metre on one of three synthetic scenes, and little on the others. The rates of means and
opacities, the light of the sky within bounds, and the opacity threshold of pruning are ours; means at the rate of 3DGS
end 0.9 m worse.

Left out are the registration of a surface model to a reference, panchromatic images and sensors whose RPC has to be
corrected (bundle adjustment); image positions have to be right already.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.satellite import scene, surface
from minisplat_ref.extensions.satellite.recipe import RECIPE, SEEN_FROM_ABOVE, stages

EXTENSION = Extension(
    "satellite",
    recipes=(RECIPE,),
    representation=SEEN_FROM_ABOVE,
    commands=(scene, surface),
    stages=stages,
)
