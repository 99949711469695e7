"""Pixel order: footprints on tangent planes, each pixel in the order of its own ray.

EXTENSION draft
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.pixel_order.method import ORDERED, PIXEL_ORDER
from minisplat_ref.extensions.pixel_order.stages import stages

EXTENSION = Extension("pixel-order", recipes=(PIXEL_ORDER,), representation=ORDERED, stages=stages)
