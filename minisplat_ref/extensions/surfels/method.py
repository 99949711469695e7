"""The recipe of 2D Gaussian Splatting: surfels, their density control, and the paper's two losses."""

from minisplat_ref.mechanisms.surfels.discs import DISC_EVENTS
from minisplat_ref.mechanisms.surfels.losses import LOSSES
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL

RECIPE = GS_ACCEL._replace(name="surfels", losses=(*GS_ACCEL.losses, *LOSSES), events=DISC_EVENTS)
"""``surfels``: the schedule and the density control of 3DGS with the paper's two losses."""
