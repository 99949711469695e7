"""The stage of the gradient check of Micro-splatting: the trace penalty."""

import numpy as np

from minisplat_ref.extensions.micro.reference import trace_penalty, trace_penalty_vjp, traces
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the penalty with a limit that half of the Gaussians exceed; all backends share it."""
    log_scales = setting.gaussians.log_scales
    ordered, middle = np.sort(traces(log_scales)), len(log_scales) // 2
    limit = float(ordered[middle - 1 : middle + 1].mean())  # between traces: no kink there

    def function(log_scales: Floats) -> Point:
        return Point((np.asarray(trace_penalty(log_scales, limit)),), (traces(log_scales) > limit,))

    def vjp(v_penalty: Floats) -> tuple[Floats, ...]:
        return (trace_penalty_vjp(log_scales, limit, float(v_penalty)),)

    return (Stage("trace_penalty", {"log_scales": log_scales}, ("penalty",), function, vjp),)
