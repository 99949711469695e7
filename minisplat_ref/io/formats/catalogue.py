"""The compact formats of other programs: every command reads them, and ``convert`` writes all but ``.ksplat``."""

from minisplat_ref.io.formats import Format
from minisplat_ref.io.formats.compressed_ply import COMPRESSED_PLY
from minisplat_ref.io.formats.glb import GLB
from minisplat_ref.io.formats.ksplat import KSPLAT
from minisplat_ref.io.formats.sog import SOG
from minisplat_ref.io.formats.splat import SPLAT
from minisplat_ref.io.formats.spz import SPZ

FORMATS: tuple[Format, ...] = (SPZ, SPLAT, SOG, COMPRESSED_PLY, GLB, KSPLAT)
