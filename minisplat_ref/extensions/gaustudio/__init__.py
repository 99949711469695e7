"""GauStudio: stages that are exchanged by name, and a background for what is far away.

This follows GauStudio, Ye et al. 2024, arXiv 2403.19632, and its code: a training is a chain of modules, each of which
has alternatives. A module here is a function, a stage a setting of the recipe that names one, and ``--set`` exchanges
it for another with the same parameters (:mod:`.alternatives` and :mod:`.backgrounds`; :mod:`.commands` lists them).

Gaussians cannot be infinitely far away, so a training hangs the sky in front of the cameras. The background takes its
place: a ball of K = 10,000 Gaussians on a Fibonacci lattice, white at first, or a map of directions, or harmonics.

    y_k = 1 - 2 k / (K - 1),  d_k = (sqrt(1 - y_k^2) cos theta_k, y_k, sqrt(1 - y_k^2) sin theta_k)
    theta_k = k pi (3 - sqrt 5),   c' = c + (1 - alpha) s(d)        alpha: opacity of the scene, s: the background
    sky_opacity = 1 / |M| sum_{p in M} alpha_p                      M: pixels that show the sky

    minisplat-ref gaustudio modules
    minisplat-ref train SCENE --recipe gaustudio --out runs/studio
    minisplat-ref train SCENE --recipe gaustudio --set background=harmonics --set representation=surfels
    minisplat-ref gaustudio masks SCENE --out masks
    minisplat-ref train SCENE --recipe gaustudio --set sky_mask=from_files --set mask_folder=masks
    minisplat-ref mesh runs/studio --out mesh.ply --depth expected
    python -m data_tools.claims gaustudio/sky SCENE --out DIR
    python -m data_tools.claims gaustudio/swaps SCENE --out DIR
    minisplat-ref oracle gradients --extension gaustudio

``docs/family/gaustudio.md`` has the measured figures.

This deviates from the code as follows. The ball has a radius of 100 extents there and its Gaussians may move; here it
is around each camera, infinitely far, its Gaussians are round, and they stay in their directions. They have no part in
density control, and a PLY does not hold them. The weight of the loss on the sky, 0.1, and the learning rate of the
background are ours. Masks are files or a rule on colours: there is no network for them.

Meshes are fused by ``minisplat-ref mesh``, which does for any recipe what the paper does for its own. Left out are
initialisers and depths that need a network, and the balls of several radii.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.gaustudio import commands
from minisplat_ref.extensions.gaustudio.model import RECIPE, STUDIO, stages

EXTENSION = Extension(
    "gaustudio",
    recipes=(RECIPE,),
    representation=STUDIO,
    commands=(commands,),
    stages=stages,
)
