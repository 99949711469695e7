"""How much the image would change without each Gaussian. Not yet on the device: the CPU's kernels, on its own tiles."""

from minisplat_ref.constants import Conventions
from minisplat_ref.cpu import removal, tiling
from minisplat_ref.types import Floats, Projection, RenderOutput, TileBins


def removal_changes(
    projection: Projection,
    colors: Floats,
    bins: TileBins,
    conventions: Conventions,
    output: RenderOutput,
) -> Floats:
    """Return the squared change of the image without each Gaussian; see ``reference.removal.removal_changes``."""
    grid = bins.grid._replace(tile_width=tiling.TILE_WIDTH, tile_height=tiling.TILE_HEIGHT)
    own_bins = tiling.bin_gaussians(projection, grid, conventions)
    return removal.removal_changes(projection, colors, own_bins, conventions, output)
