"""Kernels of a training whose parameters stay on the device, besides the stages: a thread for each Gaussian.

Activations and the chain rule through them, which rows a view sees, and whether a number is not finite.
"""

from typing import Any

import numpy as np

from minisplat_ref.cuda import target
from minisplat_ref.cuda.adam import list_on_device
from minisplat_ref.cuda.arrays import empty, to_device, to_host, zeros
from minisplat_ref.cuda.target import cuda, gpu_kernel, launch_rows
from minisplat_ref.jit.literals import ZERO
from minisplat_ref.scalar.activation import activate_opacity, activate_opacity_vjp, activate_scale, activate_scale_vjp
from minisplat_ref.types import Bools, Gaussians, Ints, PrimitiveGradient, Primitives, SHGradient

__all__ = [
    "ALL",
    "activate",
    "chain",
    "describe_device",
    "free_bytes",
    "has_wrong",
    "is_simulated",
    "synchronize",
    "to_device",
    "to_host",
    "visible_widths",
    "zeros",
]

ALL = 1 << 20  # numbers of a row to update: more than any row has
is_simulated = target.is_simulated
free_bytes, describe_device = target.free_bytes, target.describe_device


def synchronize() -> None:
    """Wait until all kernels have run."""
    cuda.synchronize()


@gpu_kernel
def activate_rows(
    log_scales,  # [N, 3]
    opacity_logits,  # [N]
    is_visible,  # [N], or [0] for all
    largest,  # finite scale
    scales,  # [N, 3]
    opacities,  # [N]
):
    """Write scales and opacity of one Gaussian."""
    n = cuda.grid(1)
    if n >= opacities.shape[0]:
        return
    for k in range(3):
        scales[n, k] = activate_scale(log_scales[n, k], largest)
    is_drawn = is_visible.shape[0] == 0 or is_visible[n] != 0
    opacities[n] = activate_opacity(opacity_logits[n]) if is_drawn else ZERO


def activate(gaussians: Gaussians, is_visible: Bools | None) -> Primitives:
    """Return Gaussians of the device after their activations; see :func:`minisplat_ref.rendering.activate`."""
    n, dtype = len(gaussians.means), gaussians.means.dtype
    scales, opacities = empty((n, 3), dtype), empty(n, dtype)
    visibility = to_device(np.empty(0, np.uint8) if is_visible is None else is_visible.astype(np.uint8))
    largest = dtype.type(np.finfo(np.float32).max)
    launch_rows(
        activate_rows, n, gaussians.log_scales, gaussians.opacity_logits, visibility, largest, *(scales, opacities)
    )
    return Primitives(gaussians.means, gaussians.quats, scales, opacities)


@gpu_kernel
def chain_rows(
    primitives,  # Primitives
    opacity_logits,  # [N]
    v,  # Primitives of the gradient, changed in place
    v_means,  # [N, 3] from the viewing direction
):
    """Chain the gradient of one Gaussian to its parameters."""
    n = cuda.grid(1)
    if n >= opacity_logits.shape[0]:
        return
    for k in range(3):
        v.means[n, k] += v_means[n, k]
        v.scales[n, k] = activate_scale_vjp(primitives.scales[n, k], v.scales[n, k])
    v.opacities[n] = activate_opacity_vjp(primitives.opacities[n], opacity_logits[n], v.opacities[n])


def chain(gaussians: Gaussians, primitives: Primitives, v: PrimitiveGradient, v_sh: SHGradient) -> Gaussians:
    """Return the gradient with respect to the parameters; the arrays of ``v`` are changed in place.

    See :func:`minisplat_ref.rendering.render_vjp`.
    """
    v_primitives = Primitives(v.means, v.quats, v.scales, v.opacities)
    launch_rows(chain_rows, len(v.means), primitives, gaussians.opacity_logits, v_primitives, v_sh.means)
    return Gaussians(v.means, v.quats, v.scales, v.opacities, v_sh.sh_dc, v_sh.sh_rest)


@gpu_kernel
def write_widths(radii, limits, everything, widths):
    """Write how many numbers of one row are updated: none if the view does not see it."""
    n = cuda.grid(1)
    if n >= radii.shape[0]:
        return
    if radii[n, 0] == 0:
        widths[n] = 0
    elif limits.shape[0] > 0:
        widths[n] = limits[n]
    else:
        widths[n] = everything


def visible_widths(radii: Ints, limits: Ints | None) -> Any:
    """Return how many numbers of each row a visible-only Adam updates.

    Parameters
    ----------
    radii : device array of shape (N, 2)
        0 where culled.
    limits : ndarray of shape (N,), optional
        Of the rows that are seen; all numbers by default.
    """
    widths = empty(len(radii), np.int32)
    launch_rows(write_widths, len(radii), radii, list_on_device(limits), np.int32(ALL), widths)
    return widths


@gpu_kernel
def find_wrong(table, found):
    """Set ``found[0]`` to 1 if a number of one row is not finite: whichever thread writes, it writes the same."""
    n = cuda.grid(1)
    if n < table.shape[0]:
        for k in range(table.shape[1]):
            if not table[n, k] - table[n, k] == ZERO:
                found[0, 0] = 1


def has_wrong(*bundles: Any) -> bool:
    """Return whether a number of the bundles of arrays [N, ...] is not finite."""
    found = zeros((1, 1), np.int32)
    for table in (table for bundle in bundles for table in bundle):
        n = len(table)
        launch_rows(find_wrong, n, table.reshape(n, table.size // n if n else 0), found)
    return bool(to_host(found)[0, 0])
