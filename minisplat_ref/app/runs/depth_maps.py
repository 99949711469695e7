"""Maps of a trained run's surface from a camera: a depth of one of three kinds, and the colours."""

from enum import Enum

import numpy as np

from minisplat_ref.app.runs.scoring import Trained
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.fusion.volume import DepthMap
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.types import Floats, RenderOutput, View

ALPHA_MIN = 0.5  # of a pixel that shows a surface: more of its light comes from the scene than from behind it


class DepthKind(Enum):
    """The kind of a pixel's depth that is taken for that of the surface."""

    MEDIAN = "median"
    """Of the hit at which the transmittance falls to a half."""
    EXPECTED = "expected"
    """The mean of all hits."""
    MIDPOINT = "midpoint"
    """The point of the ray that is nearest to the middle of the dominant Gaussian (Mini-Splatting)."""


WANTS = {DepthKind.MEDIAN: "median_depth", DepthKind.EXPECTED: "depth", DepthKind.MIDPOINT: "surface"}


def depth_map(trained: Trained, view: View, kind: DepthKind) -> DepthMap:
    """Render a view's depth and colours; the depth is 0 where less than half of the light comes from the scene.

    Raises
    ------
    InputError
        The run's renderer has no such depth.
    """
    wants = frozenset({WANTS[kind]})
    try:
        output = trained.render(view, wants)
        depth = _select_depth(trained, output, kind)
    except InputError as error:
        raise InputError(f"renderer {trained.renderer.name} gives no {kind.value} depth: {error}") from None
    shown = np.where((output.alpha >= ALPHA_MIN) & np.isfinite(depth), depth, 0.0)
    return DepthMap(shown.astype(np.float64), np.clip(output.image[..., :3], 0, 1).astype(np.float64))


def _select_depth(trained: Trained, output: RenderOutput, kind: DepthKind) -> Floats:
    depth: Floats | None = None
    if kind is DepthKind.MEDIAN:
        depth = output.median_depth
    elif kind is DepthKind.EXPECTED:
        channels = trained.renderer.channels(frozenset({"depth"}))
        depth = (
            expected_depth(output.image[..., channels["depth"]][..., 0], output.alpha) if "depth" in channels else None
        )
    elif "surface" in output.extras:
        depth = output.extras["surface"].depths
    if depth is None:
        others = ", ".join(other.value for other in DepthKind if other is not kind)
        raise InputError(f"try --depth {others}, or a run of another recipe")
    return depth
