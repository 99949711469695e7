"""Errors of a contender against float64 on the same numbers, apart from flips at thresholds."""

import time
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.bench.contenders import Contender
from minisplat_ref.bench.workloads import Workload
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.oracle.thresholds import Thresholds, thresholds_of_view
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import CPU, Backend
from minisplat_ref.types import Floats, Gaussians


class Expected(NamedTuple):
    """The float64 answer to a workload."""

    image: Floats
    """[H, W, 3]."""
    gradient: Gaussians
    """For the workload's cotangent."""
    quiet_gradient: Gaussians
    """For the cotangent without the pixels at thresholds."""
    thresholds: Thresholds
    """Pixels at thresholds."""
    forward_seconds: float
    """Time of the image."""
    backward_seconds: float
    """Time of the gradient."""


class Verdict(NamedTuple):
    """Errors of a contender on a workload."""

    image_max: float
    """Largest error of any channel of any pixel."""
    image_rms: float
    """Root mean square over all of them."""
    quiet_image_max: float
    """Largest error of a pixel that is at no threshold."""
    n_flips: int
    """Pixels at thresholds with an error above the bound."""
    n_wrong: int
    """Pixels with an error above the bound and above the effect of their thresholds."""
    gradient: float
    """Largest relative L2 error of any parameter's gradient."""
    quiet_gradient: float
    """The same for the cotangent without the pixels at thresholds."""
    worst_parameter: str
    """The parameter with that largest error."""


def expect(workload: Workload, backend: Backend, conventions: Conventions = GSPLAT_MAIN) -> Expected:
    """Render and differentiate in float64."""
    start = time.perf_counter()
    output, tape = render(workload.gaussians, workload.camera, conventions=conventions, backend=backend)
    rendered = time.perf_counter()
    gradient = render_vjp(tape, workload.v_image).gaussians
    differentiated = time.perf_counter()
    at = thresholds_of_view(tape.splats)
    quiet = render_vjp(tape, quiet_cotangent(workload, at)).gaussians
    return Expected(output.image, gradient, quiet, at, rendered - start, differentiated - rendered)


def with_slack(expected: Expected, workload: Workload, conventions: Conventions, slack: float) -> Expected:
    """Return the same answer with wider margins at the thresholds."""
    _, tape = render(workload.gaussians, workload.camera, conventions=conventions, backend=CPU)
    at = thresholds_of_view(tape.splats, slack)
    quiet = render_vjp(tape, quiet_cotangent(workload, at)).gaussians
    return expected._replace(thresholds=at, quiet_gradient=quiet)


def judge(contender: Contender, workload: Workload, expected: Expected) -> Verdict:
    """Compare a contender with the expected answer.

    Parameters
    ----------
    contender : Contender
    workload : Workload
    expected : Expected
        For its own conventions, to judge it; for the default's, to report its error.
    """
    image, tape = forward(contender, workload)
    gradient = backward(contender, tape, workload.v_image)
    quiet = backward(contender, tape, quiet_cotangent(workload, expected.thresholds))
    difference = np.abs(image - expected.image)
    error = difference.max(axis=2)  # [H, W]
    error = np.where(np.isnan(error), np.inf, error)
    allowance = expected.thresholds.allowance
    quiet_errors = relative_errors(quiet, expected.quiet_gradient)
    worst = max(quiet_errors, key=quiet_errors.__getitem__)
    return Verdict(
        image_max=float(error.max()),
        image_rms=float(np.sqrt(np.mean(difference**2))),
        quiet_image_max=float(error[allowance == 0].max(initial=0)),
        n_flips=int(((error > contender.image_bound) & (allowance > 0)).sum()),
        n_wrong=int((error > contender.image_bound + allowance).sum()),
        gradient=max(relative_errors(gradient, expected.gradient).values()),
        quiet_gradient=quiet_errors[worst],
        worst_parameter=worst,
    )


def failure(contender: Contender, verdict: Verdict) -> str:
    """Return the error in one line, or an empty string if there is none."""
    if verdict.n_wrong:
        return f"{verdict.n_wrong} pixels are off by more than {contender.image_bound:.1e} and no threshold explains it"
    if not verdict.quiet_gradient <= contender.gradient_bound:
        return (
            f"gradient of {verdict.worst_parameter} is off by {verdict.quiet_gradient:.1e},"
            f" more than {contender.gradient_bound:.1e}"
        )
    return ""


def forward(contender: Contender, workload: Workload) -> tuple[Floats, Any]:
    """Render; return the image and a tape for :func:`backward`."""
    gaussians = Gaussians._make(field.astype(contender.dtype, copy=False) for field in workload.gaussians)
    return contender.passes.forward(gaussians, workload.camera, contender.conventions, contender.backend)


def backward(contender: Contender, tape: Any, v_image: Floats) -> Gaussians:
    """Differentiate the image of :func:`forward`."""
    return contender.passes.backward(tape, v_image.astype(contender.dtype, copy=False))


def quiet_cotangent(workload: Workload, at: Thresholds) -> Floats:
    """Return the workload's cotangent without the pixels at thresholds."""
    return np.where(at.is_near[:, :, None], 0, workload.v_image)


def relative_errors(gradient: Gaussians, expected: Gaussians) -> dict[str, float]:
    """Return the relative L2 error for every parameter; infinity where the gradient is not finite."""
    errors = {}
    for name, a, b in zip(Gaussians._fields, gradient, expected, strict=True):
        if b.size:
            error = float(np.linalg.norm(a - b) / np.linalg.norm(b))
            errors[name] = error if np.isfinite(error) else np.inf
    return errors
