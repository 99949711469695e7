"""Fans: each Gaussian as translucent coloured triangles, a mesh for any modelling program.

MeshSplats, Tobiasz et al. 2025, arXiv 2502.07754.
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
