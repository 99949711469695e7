"""The activations of one Gaussian's parameters (3DGS section 5.1), and the chain rule through them."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import libm_exp, minimum
from minisplat_ref.jit.literals import ONE


@scalar
def activate_scale(log_scale, largest):
    """Return s = exp(log_s), at most ``largest``, which replaces infinity."""
    return minimum(libm_exp(log_scale), largest)


@scalar
def activate_scale_vjp(scale, v_scale):
    """Return v_log_s = s v_s."""
    return scale * v_scale


@scalar
def activate_opacity(logit):
    """Return o = 1 / (1 + exp(-logit))."""
    return ONE / (ONE + libm_exp(-logit))


@scalar
def activate_opacity_vjp(opacity, logit, v_opacity):
    """Return v_logit = o (1 - o) v_o; 1 - o is computed without the cancellation of 1 - 0.9999."""
    return opacity * (ONE / (ONE + libm_exp(logit))) * v_opacity
