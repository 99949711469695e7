"""Fans: each Gaussian as translucent coloured triangles, a mesh for any modelling program.

This follows MeshSplats, Tobiasz et al. 2025, arXiv 2502.07754. A trained Gaussian becomes a fan of n triangles about
its centre, or three fans in the planes of its axes, with a colour and an opacity at each vertex
(:mod:`minisplat_ref.extensions.fans.model`):

    rim vertex j:  mu + k (s_a cos(2 pi j / n) e_a + s_b sin(2 pi j / n) e_b)
    opacity:       o at the centre, rim o on the rim, linear in between;  colour: that of degree 0

The mesh is rendered as a graphics program would do it, by depth peeling (``mechanisms.peeling.layers``), with
gradients, so that the position, colour and opacity of each vertex can be trained on photographs, by the loss of 3DGS.

    minisplat-ref fans export runs/fox fox.glb
    minisplat-ref fans fine-tune photos/fox runs/fox fans.ply
    minisplat-ref render fans.ply --cameras runs/fox/cameras.json
    minisplat-ref train SCENE --recipe fans --set is_flat=false
    python -m data_tools.claims fans/profile --out DIR
    python -m data_tools.claims fans/refit SCENE --out DIR
    minisplat-ref bench --extension fans
    minisplat-ref oracle gradients --extension fans

``docs/family/fans.md`` has the measured figures.

This deviates from the paper as follows. Colours and opacities are clipped to [0, 1] after every step, so that a file
holds the values that are rendered. Fans are pruned whole, by their most opaque vertex; single triangles are left out
when a mesh is exported. A flat fan lies in the plane of the two larger axes, even of a Gaussian that is not flat, and
vanishes when it is seen edge on; three fans do not, but overlap.

Left out are textures, view-dependent colour, growing new fans, and pruning by gradients; .obj files have no opacities.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.fans import commands
from minisplat_ref.extensions.fans.mesh_files import load_fans, save_fans
from minisplat_ref.extensions.fans.model import FANS, FANS_OF_GAUSSIANS, stages

EXTENSION = Extension(
    "fans",
    recipes=(FANS,),
    representation=FANS_OF_GAUSSIANS,
    save=save_fans,
    load=load_fans,
    commands=(commands,),
    stages=stages,
)
