"""Fans: each Gaussian as translucent coloured triangles, a mesh for any modelling program.

MeshSplats, Tobiasz et al. 2025, arXiv 2502.07754. A trained Gaussian becomes a fan of n triangles about its centre, or
three fans in the planes of its axes, with a colour and an opacity at each vertex
(:mod:`minisplat_ref.extensions.fans.shapes`):

    rim vertex j:  mu + k (s_a cos(2 pi j / n) e_a + s_b sin(2 pi j / n) e_b)
    opacity:       o at the centre, rim o on the rim, linear in between;  colour: that of degree 0

The mesh is drawn as a graphics program would, by depth peeling (``mechanisms.peeling.layers``), with gradients, so that
its vertices can be trained on photographs: position, colour and opacity of each, by the loss of 3DGS.

    minisplat-ref fans export runs/fox fox.glb
    minisplat-ref fans fine-tune photos/fox runs/fox fans.ply
    minisplat-ref render fans.ply --extension fans --cameras runs/fox/cameras.json
    minisplat-ref train SCENE --recipe fans --set is_flat=false
    minisplat-ref study fans/profile --out DIR
    minisplat-ref study fans/refit SCENE --out DIR
    minisplat-ref bench --extension fans
    minisplat-ref oracle gradients --extension fans

Measured: seen from the front, the best fan of 8 sides (k = 2.48, rim 0) errs by 12 % of the Gaussian's root mean
square, one of k = 2.3 and rim 0.2 by 26 % (``study fans/profile``). In a scene that is not the best. The fox at 68 x
120, 2,823 Gaussians, test views (``study fans/refit fox --downscale 4 --ply PLY --fine-tune 250``): splats 27.03 dB,
and 25.24 dB without view dependence; flat fans of k = 2.5 18.64 dB, of the fitted k = 3.34 21.94 dB, because holes cost
more than overlap; solid fans 22.54 and, with k = 2.77, 23.13 dB. Trained for 250 iterations, flat fans reach 27.51 dB
and solid ones 28.05 dB, without view dependence; splats that were trained on as long 27.96 dB, and 26.82 dB without.
These are 22,566 and 67,707 triangles, 0.7 and 1.7 MB. A pixel has 21 and 32 layers: the nearest 16 alone are off by 5
and 16 of 255 levels, the nearest 32 by less than one. Fans of 5,000 Gaussians are drawn and differentiated 1.9 times as
fast as these by 3DGS's textbook loop; in float32 they cover the pixels that they cover in float64 (``bench``).

Where this deviates: colours and opacities are clipped to [0, 1] after every step, so that a file holds what is drawn.
Fans are pruned whole, by their most opaque vertex; single triangles are left out when a mesh is exported. A flat fan
lies in the plane of the two larger axes, also of a Gaussian that is not flat, and vanishes when it is seen edge on;
three fans do not, but overlap: turned by 50 degrees, those of a ball err by 34 % (``study fans/profile``).

Left out: textures, view-dependent colour, growing new fans, pruning by gradients; .obj files have no opacities.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.fans import export, fine_tune
from minisplat_ref.extensions.fans.mesh_files import load_fans, save_fans
from minisplat_ref.extensions.fans.method import FANS, FANS_OF_GAUSSIANS
from minisplat_ref.extensions.fans.stages import stages
from minisplat_ref.extensions.fans.study import PROFILE, REFIT

EXTENSION = Extension(
    "fans",
    recipes=(FANS,),
    representation=FANS_OF_GAUSSIANS,
    save=save_fans,
    load=load_fans,
    commands=(export, fine_tune),
    stages=stages,
    studies=(PROFILE, REFIT),
)
