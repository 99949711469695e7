"""The plan seen from above: the coarse model, the cores, and the cameras in the colours of their blocks."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.app.blocks.plan import Plan
from minisplat_ref.app.reports.plots import plot, save_png
from minisplat_ref.app.runs.scene_part import Box
from minisplat_ref.interface.palette import TITLE_COLOR
from minisplat_ref.types import Floats

SIZE = (6.4, 5.6)  # inches
MARGIN = 0.25  # of the cameras' extent, shown around them
N_POINTS_MAX = 20000  # of the coarse model, so that the picture stays small
COLOR_MAP = "tab20"


def draw_plan(plan: Plan, centers: Floats, means: Floats, path: Path) -> None:
    """Write the picture.

    Parameters
    ----------
    plan : Plan
    centers : ndarray of shape (V, 3)
        Of the training cameras, in the frame of the files.
    means : ndarray of shape (N, 3)
        Of the coarse model's Gaussians, likewise.
    path : Path
        PNG.
    """
    from matplotlib import colormaps
    from matplotlib.patches import Rectangle

    cameras = plan.plane.coordinates(centers)  # [V, 2]
    points = plan.plane.coordinates(means[:: -(-len(means) // N_POINTS_MAX)])  # [P, 2]
    margin = MARGIN * float(np.ptp(cameras, axis=0).max())
    low, high = cameras.min(axis=0) - margin, cameras.max(axis=0) + margin  # [2] each
    step = 0.012 * math.dist(low, high)
    with plot("ground plan, units of the scene", "along the first axis", SIZE) as (figure, axes):

        def outline(box: Box, **style: Any) -> tuple[float, float]:
            (x, y), (right, top) = (np.clip(corner, low, high).tolist() for corner in box)
            axes.add_patch(Rectangle((x, y), right - x, top - y, fill=False, **style))
            return x + step, y + step

        axes.set_aspect("equal")
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.grid(visible=False)
        axes.scatter(points[:, 0], points[:, 1], s=0.4, color="0.75", linewidths=0)
        for number, planned in enumerate(plan.blocks):
            color = colormaps[COLOR_MAP](number % 20)
            inside = cameras[planned.block.core.contains(cameras)]
            axes.scatter(inside[:, 0], inside[:, 1], s=14, color=color)
            outline(planned.block.region, edgecolor=color, linestyle=":", linewidth=1.5)
            corner = outline(planned.block.core, edgecolor=TITLE_COLOR)
            label = f"{planned.block.name}: {planned.n_photographs} photographs, {planned.iterations} iterations"
            axes.annotate(label, corner, fontsize=8)
        save_png(figure, path)
