"""Compare another renderer's version of a call of gsplat's with ours in float64: the first stage that differs is named.

A :class:`Call` defines what is called, which arrays are compared, and which errors can be planted. A renderer is
anything that returns, for a scene, arrays by name: the meta of the call, its images, and gradients. Stages that depend
on others come after them, so that the first that differs is where to look: a wrong conic makes a wrong alpha, and that
makes everything else wrong.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.npz import read_npz
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.peers.array_kinds import kind_of
from minisplat_ref.oracle.peers.named_function import load_function
from minisplat_ref.oracle.tangent import on_tangent
from minisplat_ref.oracle.tolerances import EXACT, StageTolerance
from minisplat_ref.types import Floats

Arrays = dict[str, np.ndarray]
POSE, V_POSE = "viewmats", "v_viewmats"


class CallScene(NamedTuple):
    """The arguments of one call, and the cotangents of its images."""

    name: str
    what: str
    """One line: its purpose."""
    arguments: dict[str, Any]
    """Of the call: arrays in float64, and settings."""
    cotangents: dict[str, Floats]
    """``v_render_colors`` and so on."""


class StageArray(NamedTuple):
    """An array that is compared."""

    stage: str
    tolerance: StageTolerance
    what: str
    """Shape and meaning, for the README of golden vectors."""
    part: Callable[[np.ndarray], np.ndarray] = np.asarray
    """Returns the part of it that is compared."""
    is_of_rows: bool = False
    """Whether rows of Gaussians are compared only where ours has a value; culled rows are never read."""


class PlantedInCall(NamedTuple):
    """An error that is planted in a call."""

    what: str
    stage: str
    """The name of the stage in which it has to be found."""
    plant: Callable[[Any], Any]
    """Turns the steps of the call into wrong ones."""


class Call(NamedTuple):
    """A call that is compared."""

    name: str
    """That ``--call`` takes."""
    subject: str
    """The primitive that it renders, for messages."""
    images: tuple[str, ...]
    """Names of its results before the meta."""
    stages: Mapping[str, StageArray]
    """The arrays in the order in which they are compared."""
    leaves: tuple[str, ...]
    """Arguments that torch differentiates with respect to."""
    scenes: Callable[[], tuple[CallScene, ...]]
    ours: Callable[[Mapping[str, Any], Mapping[str, Floats], Mapping[str, Any]], Arrays]
    """``ours(arguments, cotangents, options)`` are all arrays by name."""
    differentiate: Callable[[Any, Mapping[str, Any], Mapping[str, Floats]], Mapping[str, Floats]]
    """``differentiate(vjp, arguments, cotangents)`` calls another gradient as this call's is called."""
    planted: Mapping[str, PlantedInCall]
    steps: Any
    """The correct steps."""
    peer: Callable[[], Callable[..., Any]] | None = None
    """Returns the call by gsplat's own torch functions."""
    profiles: Mapping[str, Callable[[Any], Any]] = {}
    """Rules of other versions by name: each turns the steps into those of the version."""


class CallRenderer(NamedTuple):
    """A renderer that is compared."""

    name: str
    dtype: str
    arrays: Callable[[CallScene], Arrays]


def truth(call: Call, scene: CallScene, profile: str | None = None) -> Arrays:
    """Return all arrays of a scene, by the reference.

    Raises
    ------
    InputError
        The call has no rules of that name.
    """
    if profile is None:
        return _ours(call, scene, {"backend": "reference"})
    if profile not in call.profiles:
        known = f"give {' or '.join(call.profiles)}, or leave it out" if call.profiles else "leave it out"
        raise InputError(f"--profile {profile}: {call.name} has no such rules; {known}")
    return _ours(call, scene, {"backend": "reference", "steps": call.profiles[profile](call.steps)})


def planted_steps(call: Call, name: str) -> Any:
    """Return the steps of a call with one error.

    Raises
    ------
    InputError
        There is none of that name.
    """
    if name not in call.planted:
        raise InputError(f"error {name!r} is unknown; choose one of {', '.join(call.planted)}")
    return call.planted[name].plant(call.steps)


def _ours(call: Call, scene: CallScene, options: Mapping[str, Any], dtype: str = "float64") -> Arrays:
    return call.ours(_cast(scene.arguments, dtype), _cast(scene.cotangents, dtype), options)


def _cast(values: Mapping[str, Any], dtype: str) -> dict[str, Any]:
    return {name: value.astype(dtype) if isinstance(value, np.ndarray) else value for name, value in values.items()}


def choose_renderer(call: Call, name: str, dtype: str | None = None, arrays: str | None = None) -> CallRenderer:
    """Return the renderer of a name.

    Parameters
    ----------
    call : Call
    name : str
        ``cpu``, ``cpu-exact``, ``reference``, ``planted:ERROR``, ``gsplat-torch``, ``package.module:function``, or a
        folder of arrays.
    dtype : str, optional
        ``"float32"`` or ``"float64"``, the dtype of the computation. By default float64 for ours and gsplat's torch
        functions, float32 for the others.
    arrays : str, optional
        ``"numpy"`` or ``"torch"``, the kind of a function's arguments; by default the one that its module imports.

    Raises
    ------
    InputError
        There is none of that name, or it cannot run here.
    """
    kind, _, rest = name.partition(":")
    if name in ("cpu", "cpu-exact", "reference"):
        own = dtype or "float64"
        return CallRenderer(f"{name} {own}", own, lambda scene: _ours(call, scene, {"backend": name}, own))
    if kind == "planted":
        steps = planted_steps(call, rest)
        return CallRenderer(name, dtype or "float64", lambda scene: _run_wrong(call, scene, steps, dtype or "float64"))
    if name == "gsplat-torch" and call.peer is not None:
        function, own = call.peer(), dtype or "float64"
        return CallRenderer(f"{name} {own}", own, lambda scene: _run_torch(call, function, scene, own))
    if Path(name).is_dir():
        return CallRenderer(name, dtype or "float32", lambda scene: _read(call, Path(name), scene))
    if ":" in name:
        return _function(call, name, dtype or "float32", arrays)
    peer = "" if call.peer is None else "gsplat-torch, "
    raise InputError(
        f"{name!r} is neither a folder of arrays nor a renderer of {call.subject}: package.module:function, cpu,"
        f" cpu-exact, reference, {peer}or planted:ERROR ({', '.join(call.planted)})"
    )


def compare(call: Call, renderer: CallRenderer, scenes: Mapping[str, tuple[CallScene, Arrays]]) -> Report:
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
        for name, about in call.stages.items():
            if name not in arrays or name not in known:
                continue
            given.add(name)
            got, ours = arrays[name], known[name]
            if about.is_of_rows and np.shape(got) == np.shape(ours):
                is_given = _is_given(ours, known["radii"], arrays.get("radii"))
                got, ours = np.where(is_given, got, 0), np.where(is_given, ours, 0)
            if name == V_POSE and np.shape(got) == np.shape(ours):
                views = scene.arguments[POSE]
                got, ours = on_tangent(got, views), on_tangent(ours, views)
            case = _case(name, about, scene.name, got, ours, renderer.dtype)
            if name not in worst or _ratio(case) > _ratio(worst[name]):
                worst[name] = case
    if not given:
        raise InputError(f"{renderer.name} gave no array that is known: {', '.join(call.stages)}")
    cases = tuple(worst[name] for name in call.stages if name in worst)
    first = next((case.name for case in cases if not case.passed), None)
    settings = {"first_difference": first, "not_given": [name for name in call.stages if name not in given]}
    return Report(f"{renderer.name} against {call.name} of the reference, float64", cases, settings)


def _is_given(ours: np.ndarray, radii: np.ndarray, other_radii: Any) -> np.ndarray:
    """Return the rows to compare: culled rows are excluded, and culling is compared separately."""
    axes = tuple(range(2, ours.ndim))
    is_given = (radii[..., 0] > 0) & np.any(ours != 0, axis=axes)
    if np.shape(other_radii) == radii.shape:
        is_given &= np.asarray(other_radii)[..., 0] > 0
    rows: np.ndarray = is_given.reshape(is_given.shape + (1,) * len(axes))
    return rows


def _ratio(case: Case) -> float:
    return float(case.figures["error / limit"] or 0)


def _case(name: str, about: StageArray, scene: str, got: np.ndarray, known: np.ndarray, dtype: str) -> Case:
    if (1, *np.shape(got)) == np.shape(known):  # gsplat 1.5.3 squeezes surf_normals where there is one camera
        got = np.asarray(got)[None]
    if np.shape(got) != np.shape(known):
        raise InputError(f"{name} has shape {list(np.shape(got))} in scene {scene}; it must be {list(np.shape(known))}")
    got, known = about.part(np.asarray(got)), about.part(known)
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


def _run_wrong(call: Call, scene: CallScene, steps: Any, dtype: str) -> Arrays:
    with np.errstate(all="ignore"):
        return _ours(call, scene, {"backend": "reference", "steps": steps}, dtype)


def _read(call: Call, folder: Path, scene: CallScene) -> Arrays:
    """Return the arrays that a folder has of a scene.

    Raises
    ------
    InputError
        A file cannot be read.
    """
    arrays: Arrays = {}
    for file in sorted((folder / scene.name).glob("*.npz")):
        arrays |= {name: array for name, array in read_npz(file, "write it again").items() if name in call.stages}
    return arrays


def _function(call: Call, name: str, dtype: str, arrays: str | None) -> CallRenderer:
    function, vjp = load_function(name)
    kind, function = arrays or kind_of(function), _unpacked(function)
    if kind == "torch":
        return CallRenderer(f"{name} {dtype}", dtype, lambda scene: _run_torch(call, function, scene, dtype))
    if kind != "numpy":
        raise InputError(
            f"{name} computes with {kind}; {call.subject} are compared with numpy and torch: give --arrays"
        )

    def run(scene: CallScene) -> Arrays:
        arguments = _cast(scene.arguments, dtype)
        arrays = _named(call, function(**arguments))
        if vjp is not None:
            found = call.differentiate(vjp, arguments, _cast(scene.cotangents, dtype))
            arrays |= {key: np.asarray(value) for key, value in found.items() if key in call.stages}
        return arrays

    return CallRenderer(f"{name} {dtype}", dtype, run)


def _unpacked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Switch off gsplat's packed projection, in which the meta has other rows and no camera is distorted."""
    try:
        has_it = "packed" in inspect.signature(function).parameters
    except (TypeError, ValueError):  # compiled code may have no signature
        has_it = False
    return functools.partial(function, packed=False) if has_it else function


def _named(call: Call, results: Any) -> Arrays:
    """Return the arrays of a call by name.

    Raises
    ------
    InputError
        It returned another number of results.
    """
    n = len(call.images)
    if not isinstance(results, tuple | list) or len(results) not in (n, n + 1):
        raise InputError(f"the function must return {', '.join(call.images)} and meta, as gsplat's does")
    named = {name: _numpy(array) for name, array in zip(call.images, results, strict=False) if array is not None}
    meta = results[n] if len(results) > n else {}
    return {**{name: _numpy(meta[name]) for name in call.stages if name in meta}, **named}


def _numpy(value: Any) -> Floats:
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def _run_torch(call: Call, function: Callable[..., Any], scene: CallScene, dtype: str) -> Arrays:
    try:
        return _differentiated(call, function, scene, dtype, call.leaves)
    except NotImplementedError:  # by gsplat 1.5.3 with_eval3d where the pose is differentiated
        return _differentiated(call, function, scene, dtype, tuple(name for name in call.leaves if name != POSE))


def _differentiated(
    call: Call, function: Callable[..., Any], scene: CallScene, dtype: str, leaves: tuple[str, ...]
) -> Arrays:
    import torch

    device = "cuda" if torch.cuda.is_available() else "cpu"
    arguments = {
        name: torch.tensor(value, device=device) if isinstance(value, np.ndarray) else value
        for name, value in _cast(scene.arguments, dtype).items()
    }
    for name in leaves:
        arguments[name].requires_grad_()
    results = function(**arguments)
    arrays = _named(call, results)
    terms = [
        (torch.tensor(scene.cotangents[f"v_{name}"]).to(image) * image).sum()
        for name, image in zip(call.images, results, strict=False)
        if image is not None and image.requires_grad
    ]
    found = torch.autograd.grad(sum(terms), [arguments[name] for name in leaves], allow_unused=True)
    return arrays | {f"v_{name}": _numpy(v) for name, v in zip(leaves, found, strict=True) if v is not None}
