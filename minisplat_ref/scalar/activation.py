"""The activations of one Gaussian's parameters (3DGS section 5.1), and the chain rule through them."""

from minisplat_ref.jit.compile import scalar
from minisplat_ref.jit.lanes import exp_of, minimum
from minisplat_ref.jit.literals import ONE


@scalar
def scale_of(log_scale, largest):
    """Return s = exp(log_s), at most ``largest``, which replaces infinity."""
    return minimum(exp_of(log_scale), largest)


@scalar
def scale_of_vjp(scale, v_scale):
    """Return v_log_s = s v_s."""
    return scale * v_scale


@scalar
def opacity_of(logit):
    """Return o = 1 / (1 + exp(-logit))."""
    return ONE / (ONE + exp_of(-logit))


@scalar
def opacity_of_vjp(opacity, logit, v_opacity):
    """Return v_logit = o (1 - o) v_o; 1 - o is computed without the cancellation of 1 - 0.9999."""
    return opacity * (ONE / (ONE + exp_of(logit))) * v_opacity
