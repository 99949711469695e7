"""Polygons that carry flat Gaussians: drawn by rays through their triangles, edited as a mesh, carried back."""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.polygons import edit, export
from minisplat_ref.extensions.polygons.method import POLYGONS, TRACED
from minisplat_ref.extensions.polygons.stages import stages

EXTENSION = Extension("polygons", recipes=(POLYGONS,), representation=TRACED, stages=stages, commands=(export, edit))
