"""Wave splatting: holograms of flat Gaussians."""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.wave import focus, hologram
from minisplat_ref.extensions.wave.stages import stages

EXTENSION = Extension("wave", commands=(hologram, focus), stages=stages)
