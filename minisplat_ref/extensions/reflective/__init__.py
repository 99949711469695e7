"""Reflective surfels."""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.reflective.method import RECIPE, SHADED

EXTENSION = Extension("reflective", recipes=(RECIPE,), representation=SHADED)
