"""Polygons that carry flat Gaussians: drawn by rays through their triangles, edited as a mesh, carried back."""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.polygons import edit, export
from minisplat_ref.extensions.polygons.method import POLYGONS, TRACED
from minisplat_ref.extensions.polygons.stages import stages
from minisplat_ref.extensions.polygons.study import STUDIES

EXTENSION = Extension(
    "polygons",
    recipes=(POLYGONS,),
    representation=TRACED,
    commands=(export, edit),
    stages=stages,
    studies=STUDIES,
)
"""Flat Gaussians in polygons, the recipe that trains them, two commands that edit them, and two studies."""
