"""Compare a ``rasterization_2dgs`` with ours in float64, stage by stage: the first that differs is named.

A renderer is anything that returns, for a scene, arrays by name: the meta of the call, its six images, and gradients.
Stages that depend on others come after them, so that the first that differs is where to look: a wrong conic makes a
wrong alpha, and that makes everything else wrong.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.npz import read_npz
from minisplat_ref.mechanisms.surfels.gsplat_call import GRADIENTS, NAMES, rasterization_2dgs, rasterization_2dgs_vjp
from minisplat_ref.mechanisms.surfels.oracle.planted import PLANTED, planted_steps
from minisplat_ref.mechanisms.surfels.oracle.scenes import LEAVES, SurfelScene
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.peers.array_kinds import kind_of
from minisplat_ref.oracle.peers.named_function import load_function
from minisplat_ref.oracle.tolerances import (
    EXACT,
    GRADIENT,
    IMAGE,
    POSITION,
    SURFEL_DEPTH,
    SURFEL_DISTORTION,
    SURFEL_NORMAL,
    StageTolerance,
)
from minisplat_ref.types import Floats

Arrays = dict[str, np.ndarray]


class StageArray(NamedTuple):
    """An array that is compared."""

    stage: str
    tolerance: StageTolerance
    what: str
    """Shape and meaning, for the README of golden vectors."""


STAGES: Mapping[str, StageArray] = {
    "radii": StageArray("projection", EXACT, "[1, N, 2] ceil of 3.33 half-extents of the unit disc, px; 0: culled"),
    "means2d": StageArray("projection", POSITION, "[1, N, 2] middle of that box, px"),
    "depths": StageArray("projection", POSITION, "[1, N] camera z of the centre"),
    "ray_transforms": StageArray("projection", POSITION, "[1, N, 3, 3] K [s_0 R r_0, s_1 R r_1, R mu + t]"),
    "normals": StageArray("projection", POSITION, "[1, N, 3] camera frame, towards the camera"),
    "render_alphas": StageArray("alpha", IMAGE, "[1, H, W, 1]"),
    "render_colors": StageArray("colours and expected depth", SURFEL_DEPTH, "[1, H, W, 4]"),
    "render_normals": StageArray("normals", IMAGE, "[1, H, W, 3] sum w n, world frame"),
    "render_median": StageArray("median depth", POSITION, "[1, H, W, 1] of the last hit with T > 1/2"),
    "render_distort": StageArray("distortion", SURFEL_DISTORTION, "[1, H, W, 1] sum_ij w_i w_j |z_i - z_j|"),
    "surf_normals": StageArray("surface normals", SURFEL_NORMAL, "[1, H, W, 3] central differences, world frame"),
    **{name: StageArray("gradients", GRADIENT, "in the shape of the argument") for name in GRADIENTS},
}
"""The arrays in the order in which they are compared. Third scales have no gradient; the last row of a view matrix, and
what a function does with it, is not compared."""
_COMPARED = {"v_scales": np.s_[:, :2], "v_viewmats": np.s_[:, :3]}


class SurfelRenderer(NamedTuple):
    """A renderer that is compared."""

    name: str
    dtype: str
    arrays: Callable[[SurfelScene], Arrays]


def truth(scene: SurfelScene) -> Arrays:
    """Return all arrays of a scene, by the reference."""
    return _ours(scene, {"backend": "reference"})


def _ours(scene: SurfelScene, options: dict[str, Any], dtype: str = "float64") -> Arrays:
    arguments, cotangents = _cast(scene.arguments, dtype), _cast(scene.cotangents, dtype)
    images = rasterization_2dgs(**arguments, **options)
    named = dict(zip(NAMES, images[:6], strict=True))
    gradients = rasterization_2dgs_vjp(**arguments, cotangents=cotangents, **options)
    meta = {name: images[6][name] for name in STAGES if name in images[6]}
    return {**meta, **named, **gradients}


def _cast(values: Mapping[str, Any], dtype: str) -> dict[str, Any]:
    return {name: value.astype(dtype) if isinstance(value, np.ndarray) else value for name, value in values.items()}


def choose_renderer(name: str, dtype: str | None = None, arrays: str | None = None) -> SurfelRenderer:
    """Return the renderer of a name.

    Parameters
    ----------
    name : str
        ``cpu``, ``cpu-exact``, ``reference``, ``planted:ERROR``, ``gsplat-torch``, ``package.module:function``, or a
        folder of arrays.
    dtype : str, optional
        ``"float32"`` or ``"float64"``: what is computed in. By default float64 for ours and gsplat's torch functions,
        float32 for the others.
    arrays : str, optional
        ``"numpy"`` or ``"torch"``: what a function is called with; by default what its module imports.

    Raises
    ------
    InputError
        There is none of that name, or it cannot run here.
    """
    kind, _, rest = name.partition(":")
    if name in ("cpu", "cpu-exact", "reference"):
        own = dtype or "float64"
        return SurfelRenderer(f"{name} {own}", own, lambda scene: _ours(scene, {"backend": name}, own))
    if kind == "planted":
        steps = planted_steps(rest)
        return SurfelRenderer(name, dtype or "float64", lambda scene: _with_error(scene, steps, dtype or "float64"))
    if name == "gsplat-torch":
        from minisplat_ref.mechanisms.surfels.oracle import gsplat_torch

        gsplat_torch.load_2dgs()
        own = dtype or "float64"
        return SurfelRenderer(f"gsplat-torch {own}", own, lambda s: _by_torch(gsplat_torch.rasterization_2dgs, s, own))
    if Path(name).is_dir():
        return SurfelRenderer(name, dtype or "float32", lambda scene: _read(Path(name), scene))
    if ":" in name:
        return _function(name, dtype or "float32", arrays)
    raise InputError(
        f"{name!r} is neither a folder of arrays nor a renderer of surfels: package.module:function, cpu, cpu-exact,"
        f" reference, gsplat-torch or planted:ERROR ({', '.join(PLANTED)})"
    )


def compare(renderer: SurfelRenderer, scenes: Mapping[str, tuple[SurfelScene, Arrays]]) -> Report:
    """Compare a renderer on scenes with known arrays.

    Returns
    -------
    Report
        A case for each stage, in the scene where it is furthest off; ``settings`` name the first stage that differs, if
        there is one, and what was not given.

    Raises
    ------
    InputError
        The renderer returned an array of another shape, or none at all.
    """
    worst: dict[str, Case] = {}
    given: set[str] = set()
    for scene, known in scenes.values():
        arrays = renderer.arrays(scene)
        for name, about in STAGES.items():
            if name not in arrays or name not in known:
                continue
            given.add(name)
            got = arrays[name]
            if about.stage == "projection" and np.shape(got) == np.shape(known[name]):
                is_seen = (known["radii"][..., 0] > 0).reshape(known["radii"].shape[:2] + (1,) * (np.ndim(got) - 2))
                got = got if name == "radii" else np.where(is_seen, got, 0)  # of culled rows nobody reads more
            case = _case(name, about, scene.name, got, known[name], renderer.dtype)
            if name not in worst or _ratio(case) > _ratio(worst[name]):
                worst[name] = case
    if not given:
        raise InputError(f"{renderer.name} gave no array that is known: {', '.join(STAGES)}")
    cases = tuple(worst[name] for name in STAGES if name in worst)
    first = next((case.name for case in cases if not case.passed), None)
    settings = {"first_difference": first, "not_given": [name for name in STAGES if name not in given]}
    return Report(f"{renderer.name} against rasterization_2dgs of the reference, float64", cases, settings)


def _ratio(case: Case) -> float:
    return float(case.figures["error / limit"] or 0)


def _case(name: str, about: StageArray, scene: str, got: np.ndarray, known: np.ndarray, dtype: str) -> Case:
    if np.shape(got) != np.shape(known):
        raise InputError(f"{name} has shape {list(np.shape(got))} in scene {scene}; it must be {list(np.shape(known))}")
    if name in _COMPARED:
        got, known = got[_COMPARED[name]], known[_COMPARED[name]]
    limit = about.tolerance.of(dtype)
    scale = max(float(np.abs(known).max(initial=0)), np.finfo(float).tiny)
    error = float(np.abs(np.asarray(got, np.float64) - known).max(initial=0))
    if about.tolerance is EXACT:
        n_off = int((np.asarray(got) != known).any(axis=-1).sum())
        counted: dict[str, Figure] = {"scene": scene, "largest error": error, "relative": n_off, "limit": 0.0}
        return Case(f"{about.stage}: {name}", n_off == 0, {**counted, "error / limit": n_off})
    is_finite = bool(np.isfinite(got).all())
    ratio = error / scale / limit if is_finite else np.inf
    figures: dict[str, Figure] = {"scene": scene, "largest error": error, "relative": error / scale, "limit": limit}
    note = "" if is_finite else "not finite"
    return Case(f"{about.stage}: {name}", ratio <= 1, {**figures, "error / limit": ratio}, note)


def _with_error(scene: SurfelScene, steps: Any, dtype: str) -> Arrays:
    with np.errstate(all="ignore"):
        return _ours(scene, {"backend": "reference", "steps": steps}, dtype)


def _read(folder: Path, scene: SurfelScene) -> Arrays:
    """Return the arrays that a folder has of a scene.

    Raises
    ------
    InputError
        A file cannot be read.
    """
    arrays: Arrays = {}
    for file in sorted((folder / scene.name).glob("*.npz")):
        arrays |= {name: array for name, array in read_npz(file, "write it again").items() if name in STAGES}
    return arrays


def _function(name: str, dtype: str, arrays: str | None) -> SurfelRenderer:
    function, vjp = load_function(name)
    kind = arrays or kind_of(function)
    if kind == "torch":
        return SurfelRenderer(f"{name} {dtype}", dtype, lambda scene: _by_torch(function, scene, dtype))
    if kind != "numpy":
        raise InputError(f"{name} computes with {kind}; surfels are compared with numpy and torch: give --arrays")

    def run(scene: SurfelScene) -> Arrays:
        arguments = _cast(scene.arguments, dtype)
        arrays = _named(function(**arguments))
        if vjp is not None:
            found = vjp(**arguments, cotangents=_cast(scene.cotangents, dtype))
            arrays |= {key: np.asarray(value) for key, value in found.items() if key in STAGES}
        return arrays

    return SurfelRenderer(f"{name} {dtype}", dtype, run)


def _named(results: Any) -> Arrays:
    """Return the arrays of a call by name.

    Raises
    ------
    InputError
        It returned something else than seven results.
    """
    if not isinstance(results, tuple | list) or len(results) not in (6, 7):
        raise InputError(f"the function must return {', '.join(NAMES)} and meta, as gsplat's rasterization_2dgs does")
    named = {name: _numpy(array) for name, array in zip(NAMES, results, strict=False) if array is not None}
    meta = results[6] if len(results) == 7 else {}
    return {**{name: _numpy(meta[name]) for name in STAGES if name in meta}, **named}


def _numpy(value: Any) -> Floats:
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def _by_torch(function: Callable[..., Any], scene: SurfelScene, dtype: str) -> Arrays:
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    arguments = {
        name: torch.tensor(value, device=device) if isinstance(value, np.ndarray) else value
        for name, value in _cast(scene.arguments, dtype).items()
    }
    leaves = [name for name in (*LEAVES, "viewmats", "backgrounds")]
    for name in leaves:
        arguments[name].requires_grad_()
    results = function(**arguments)
    arrays = _named(results)
    terms = [
        (torch.tensor(scene.cotangents[f"v_{name}"]).to(image) * image).sum()
        for name, image in zip(NAMES, results, strict=False)
        if image is not None and image.requires_grad
    ]
    found = torch.autograd.grad(sum(terms), [arguments[name] for name in leaves], allow_unused=True)
    return arrays | {f"v_{name}": _numpy(v) for name, v in zip(leaves, found, strict=True) if v is not None}
