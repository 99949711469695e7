"""Run the stages of the backend cuda on tiny scenes and write what they return; in a process with Numba's simulator.

``NUMBA_ENABLE_CUDASIM=1 python cuda_stages.py FILE`` writes a pickle: for each case, the results by stage. The cases
and their inputs are functions of this file, so that the tests can give the same inputs to the reference.
"""

import pickle
import sys
from dataclasses import fields
from inspect import signature
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, INRIA, MINI_SPLATTING2, Conventions
from minisplat_ref.rendering.backends import REFERENCE, Backend, get_backend
from minisplat_ref.types import AdamStep, Primitives, ProjectionGradient, TileGrid
from scenes import activated, as_dtype, make_camera, make_gaussians

TILE = 16


class Case(NamedTuple):
    """A scene, the rules and the dtype."""

    dtype: type
    conventions: Conventions
    size: tuple[int, int]
    n_gaussians: int
    n_channels: int
    sh_degree: int = 3
    opacity_logit: float = 0.5
    gaussian_size: float = 0.15


# The kinds of photograph of each case: the simulator takes seconds for a tile of a loss.
LOSSES = {"four tiles": ("masked",), "opaque": ("bytes",), "nothing": ("uncounted",)}
CASES = {
    "four tiles": Case(np.float32, GSPLAT_MAIN, (20, 18), 14, 3),
    "compensated": Case(np.float32, GSPLAT_MAIN._replace(is_antialiased=True), (12, 9), 8, 1, sh_degree=2),
    "two batches": Case(np.float64, INRIA, (16, 10), 45, 2, opacity_logit=-2.0, gaussian_size=0.3),
    "opaque": Case(np.float64, MINI_SPLATTING2, (9, 7), 60, 3, sh_degree=0, opacity_logit=8.0, gaussian_size=1.5),
    "nothing": Case(np.float32, GSPLAT_MAIN, (9, 7), 0, 3, sh_degree=1),
}


def name_of(case: Case) -> str:
    """The name of a case."""
    return next(name for name in CASES if CASES[name] == case)


def run_stages(
    case: Case, backend: Backend, dtype: type, given: dict | None = None, atomic: Backend | None = None
) -> dict:
    """Run every stage of a backend once, on results of another backend if they are ``given``, else on its own."""
    rng = np.random.default_rng(list(CASES).index(name_of(case)))
    width, height = case.size
    camera = make_camera(width, height, fx=1.2 * width, fy=1.3 * width, cx=0.45 * width, rng=rng)
    g = make_gaussians(
        rng, case.n_gaussians, sh_degree=case.sh_degree, opacity_logit=case.opacity_logit, size=case.gaussian_size
    )
    g.means[2:4, 2] = -1  # behind the camera
    g.sh_dc[:] *= 3  # some colours are negative in one channel
    g, conventions = as_dtype(as_dtype(g, case.dtype), dtype), case.conventions
    colors = rng.uniform(size=(case.n_gaussians, case.n_channels)).astype(case.dtype).astype(dtype)
    background = rng.uniform(size=case.n_channels).astype(case.dtype).astype(dtype)
    primitives = as_dtype(Primitives(*activated(as_dtype(g, case.dtype))), dtype)

    found: dict = {}
    source = given or found

    def normal(*shape):
        return rng.normal(size=shape).astype(case.dtype).astype(dtype)

    n = case.n_gaussians
    found["projection"] = backend.project(*primitives, camera, conventions)
    p = source["projection"]
    p = type(p)(*(x.astype(dtype) if x.dtype == case.dtype else x for x in p))
    v = ProjectionGradient(normal(n, 2), normal(n), normal(n, 3).astype(p.conics.dtype), normal(n))
    found["projection_vjp"] = backend.project_vjp(*primitives, camera, conventions, p, v)
    harmonics = g.means, g.sh_dc, g.sh_rest, camera, case.sh_degree, p.radii
    found["colors"] = backend.sh_colors(*harmonics)
    found["colors_vjp"] = backend.sh_colors_vjp(*harmonics, normal(n, 3))
    found["bins"] = backend.bin_gaussians(p, TileGrid(width, height, TILE, TILE), conventions)
    arguments = p, colors, background, source["bins"], conventions
    found["output"] = backend.composite(*arguments, with_stats=True, with_median_depth=True)
    found["plain_output"] = backend.composite(*arguments)
    v_output = normal(height, width, case.n_channels), normal(height, width)
    output = source["plain_output"]
    output = output._replace(image=output.image.astype(dtype), alpha=output.alpha.astype(dtype))
    found["output_vjp"] = backend.composite_vjp(*arguments, output, *v_output)
    if name_of(case) == "compensated":
        found["atomic_vjp"] = (atomic or backend).composite_vjp(*arguments, output, *v_output)
    found |= run_further_stages(case, backend, dtype, rng, primitives, camera, (arguments, source))
    # Mappings that cannot be changed cannot be pickled.
    return {name: x._replace(extras={}) if hasattr(x, "extras") else x for name, x in found.items()}


def run_further_stages(case, backend, dtype, rng, primitives, camera, blended) -> dict:
    """Removal, surface points, losses and Adam."""
    (p, colors, _, bins, conventions), source = blended
    found, (width, height), n = {}, case.size, case.n_gaussians

    def normal(*shape):
        return rng.normal(size=shape).astype(case.dtype).astype(dtype)

    output = source["plain_output"]
    output = output._replace(image=output.image.astype(dtype), alpha=output.alpha.astype(dtype))
    if name_of(case) == "four tiles":
        found["removal"] = backend.removal_changes(p, colors, bins, conventions, output)
    ids, ellipsoids = source["output"].stats.dominant_ids, primitives[:3]
    found["points"] = backend.surface_points(*ellipsoids, camera, ids)
    found["points_vjp"] = backend.surface_points_vjp(
        *ellipsoids, camera, ids, normal(height, width, 3), normal(height, width)
    )
    image = rng.uniform(size=(height, width, 3)).astype(case.dtype).astype(dtype)
    photograph = rng.integers(256, size=(height, width, 3)).astype(np.uint8)
    mask = rng.uniform(size=(height, width)) < 0.7
    photographs = {"bytes": (photograph, None), "masked": (image[::-1], mask), "uncounted": (photograph, mask & ~mask)}
    for kind in LOSSES.get(name_of(case), ()):
        value, tape = backend.photometric_loss(image, photographs[kind][0], 0.2, photographs[kind][1])
        v_loss = 1.0 if kind == "bytes" else 0.5
        found[f"loss {kind}"], found[f"loss_vjp {kind}"] = value, np.array(backend.photometric_loss_vjp(tape, v_loss))
    values, gradient, first, second = normal(n, 4), normal(n, 4), normal(n, 4), normal(n, 4) ** 2
    for rows, widths in ((None, None), (np.arange(1, n, 2), None), (np.arange(n), rng.integers(5, size=n))):
        backend.adam_update(values, gradient, first, second, rows, AdamStep(0.01, 0.9, 0.999, 1e-15), widths)
    found["adam"] = np.stack([values, first, second])
    return found


if __name__ == "__main__":
    cuda = get_backend("cuda")
    assert (cuda.tile_width, cuda.tile_height) == (TILE, TILE)
    for field in fields(cuda)[4:-2]:
        stage, twin = getattr(cuda, field.name), getattr(REFERENCE, field.name)
        assert list(signature(stage).parameters) == list(signature(twin).parameters), field.name
    results = {
        name: run_stages(case, cuda, case.dtype, atomic=get_backend("cuda-atomic")) for name, case in CASES.items()
    }
    again = run_stages(CASES["four tiles"], cuda, np.float32)["output_vjp"]
    Path(sys.argv[1]).write_bytes(pickle.dumps((results, again)))
