"""One call of a rasterizer with NumPy arrays, torch tensors or JAX arrays, and its gradients: NumPy in, NumPy out.

The gradients are those of the function's own ``vjp`` where there is one. Otherwise torch and JAX differentiate; plain
NumPy has none. Torch also differentiates with respect to entries of the function's meta, so that a wrong gradient can
be located between the image and the projection.
"""

import inspect
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.types import Floats

ARRAY_KINDS = ("numpy", "torch", "jax")
QUICK = {"xla_backend_optimization_level": 0}  # a scene is rendered once: XLA takes longer to optimise than to run
INTERMEDIATE = ("means2d", "depths", "conics", "opacities")  # of the meta, that torch may differentiate by


class Call(NamedTuple):
    """The arguments of a rasterizer."""

    leaves: dict[str, Floats]
    """Arguments that it is differentiated with respect to."""
    others: dict[str, Any]
    """Further arguments: arrays and settings."""
    v_colors: Floats
    """[1, H, W, D] derivative of the loss with respect to the image."""
    v_alphas: Floats
    """[1, H, W, 1] derivative of the loss with respect to alpha."""


class Result(NamedTuple):
    """Its results."""

    colors: np.ndarray
    alphas: np.ndarray
    meta: dict[str, np.ndarray]
    """Its meta; empty where it returns none."""
    gradients: dict[str, np.ndarray]
    """With respect to leaves, by their names; an argument that nothing depends on is absent."""
    of_meta: dict[str, np.ndarray]
    """The same with respect to intermediate arrays of the meta."""


def kind_of(function: Callable[..., Any]) -> str:
    """Return the kind of arrays that a function uses, by what its module has imported: torch, then jax, else numpy."""
    inner = inspect.unwrap(getattr(function, "func", function))  # of a functools.partial
    name = getattr(inner, "__module__", None) or type(inner).__module__
    values = vars(sys.modules[name]).values() if name in sys.modules else ()
    origins = [v.__name__ if isinstance(v, ModuleType) else getattr(v, "__module__", None) for v in values]
    roots = {origin.partition(".")[0] for origin in origins if isinstance(origin, str)}
    return next((kind for kind in ("torch", "jax") if kind in roots), "numpy")


def run(
    kind: str,
    function: Callable[..., Any],
    vjp: Callable[..., Any] | None,
    call: Call,
    *,
    has_gradients: bool = True,
) -> Result:
    """Call a rasterizer forward and, if it can be differentiated, backward.

    Parameters
    ----------
    kind : {"numpy", "torch", "jax"}
    function : callable
        As gsplat's ``rasterization``: returns image, alpha and perhaps a meta.
    vjp : callable or None
        Takes the same arguments, ``v_render_colors`` and ``v_render_alphas``; returns a mapping with ``v_means`` and so
        on.
    call : Call
        All of it in one dtype.
    has_gradients : bool
        Whether to compute gradients at all.

    Raises
    ------
    InputError
        If the result is not a tuple of image, alpha and perhaps a meta.
    """
    dtype = next(iter(call.leaves.values())).dtype
    with _jax_precision(dtype) if kind == "jax" else nullcontext():
        run_kind = {"numpy": _run_numpy, "torch": _run_torch, "jax": _run_jax}[kind]
        result = run_kind(function, call, has_gradients and vjp is None)
        if vjp is None or not has_gradients:
            return result
        return result._replace(gradients=_own_gradients(kind, vjp, call))


def _own_gradients(kind: str, vjp: Callable[..., Any], call: Call) -> dict[str, np.ndarray]:
    """Return the gradients that a rasterizer's own vjp computes."""
    to = _to_torch if kind == "torch" else _to_jax if kind == "jax" else np.array
    arguments = {name: to(value) if isinstance(value, np.ndarray) else value for name, value in call.others.items()}
    arguments |= {name: to(value) for name, value in call.leaves.items()}
    given = vjp(**arguments, v_render_colors=to(call.v_colors), v_render_alphas=to(call.v_alphas))
    if not isinstance(given, Mapping):
        raise InputError(f"the vjp returned {type(given).__name__}: return a dict with v_means, v_quats and so on")
    return {name: _numpy(given[f"v_{name}"]) for name in call.leaves if given.get(f"v_{name}") is not None}


def _run_numpy(function: Callable[..., Any], call: Call, _: bool) -> Result:
    copies = {name: value.copy() for name, value in call.leaves.items()}
    colors, alphas, meta = _parts(function(**copies, **call.others))
    return Result(_numpy(colors), _numpy(alphas), _list_arrays(meta), {}, {})


def _run_torch(function: Callable[..., Any], call: Call, is_differentiated: bool) -> Result:
    import torch

    leaves = {name: _to_torch(value).requires_grad_(is_differentiated) for name, value in call.leaves.items()}
    others = {name: _to_torch(v) if isinstance(v, np.ndarray) else v for name, v in call.others.items()}
    colors, alphas, meta = _parts(function(**leaves, **others))
    gradients, of_meta = {}, {}
    pairs = [(x, _to_torch(v)) for x, v in ((colors, call.v_colors), (alphas, call.v_alphas)) if _requires_grad(x)]
    if pairs and is_differentiated and all(x.shape == v.shape for x, v in pairs):
        between = {name: meta[name] for name in INTERMEDIATE if _requires_grad(meta.get(name))}
        outputs, weights = zip(*((x, v.to(x)) for x, v in pairs), strict=True)
        found = torch.autograd.grad(outputs, [*leaves.values(), *between.values()], weights, allow_unused=True)
        named = [(name, None if v is None else _numpy(v)) for name, v in zip([*leaves, *between], found, strict=True)]
        gradients = {name: v for name, v in named[: len(leaves)] if v is not None}
        of_meta = {name: v for name, v in named[len(leaves) :] if v is not None}
    return Result(_numpy(colors), _numpy(alphas), _list_arrays(meta), gradients, of_meta)


def _run_jax(function: Callable[..., Any], call: Call, is_differentiated: bool) -> Result:
    """Compile the function with its gradient; one that cannot be traced is called as it is."""
    import jax

    leaves = {name: _to_jax(value) for name, value in call.leaves.items()}
    others = {name: _to_jax(v) if isinstance(v, np.ndarray) else v for name, v in call.others.items()}

    def forward(given: Mapping[str, Any]) -> tuple[tuple[Any, Any], dict[str, Any]]:
        colors, alphas, meta = _parts(function(**given, **others))
        return (colors, alphas), {name: _to_jax(meta[name]) for name in _TOLD if meta.get(name) is not None}

    def both(given: Mapping[str, Any], v_colors: Any, v_alphas: Any) -> tuple[Any, Any, dict[str, Any], dict[str, Any]]:
        if not is_differentiated:
            (colors, alphas), told = forward(given)
            return colors, alphas, told, {}
        (colors, alphas), pull, told = jax.vjp(forward, given, has_aux=True)
        if colors.shape != v_colors.shape or alphas.shape != v_alphas.shape:
            return colors, alphas, told, {}
        # A cotangent has to have the dtype of its output, which may differ from that of the arguments.
        (gradients,) = pull((v_colors.astype(colors.dtype), v_alphas.astype(alphas.dtype)))
        return colors, alphas, told, gradients

    arguments = leaves, _to_jax(call.v_colors), _to_jax(call.v_alphas)
    try:
        compiled = jax.jit(both, compiler_options=QUICK)
        colors, alphas, told, gradients = compiled(*arguments)
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError):  # it looks at values while it is traced
        colors, alphas, told, gradients = both(*arguments)
    named = {name: _numpy(value) for name, value in gradients.items()}
    return Result(_numpy(colors), _numpy(alphas), _list_arrays(told), named, {})


def _jax_precision(dtype: np.dtype) -> AbstractContextManager[Any]:
    """Return a context in which JAX computes in float64 if ``dtype`` is that; otherwise its setting stays."""
    import jax

    if dtype != np.float64:
        return nullcontext()
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    from jax.experimental import enable_x64  # before JAX 0.8

    return enable_x64()


def _parts(returned: Any) -> tuple[Any, Any, Mapping[str, Any]]:
    """Return image, alpha and meta."""
    if not isinstance(returned, tuple | list) or len(returned) not in (2, 3):
        what = f"{len(returned)} values" if isinstance(returned, tuple | list) else type(returned).__name__
        raise InputError(f"it returned {what}: return (render_colors, render_alphas, meta), or the first two")
    meta = returned[2] if len(returned) == 3 else {}
    return returned[0], returned[1], meta if isinstance(meta, Mapping) else {}


def _list_arrays(meta: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {name: _numpy(meta[name]) for name in _TOLD if meta.get(name) is not None}


_TOLD = (*INTERMEDIATE, "radii", "flatten_ids", "isect_offsets", "tile_size")


def _requires_grad(value: Any) -> bool:
    return bool(getattr(value, "requires_grad", False))


def _to_torch(array: Floats) -> Any:
    import torch

    return torch.tensor(array, device="cuda" if torch.cuda.is_available() else "cpu")


def _to_jax(array: Floats) -> Any:
    import jax.numpy as jnp

    return jnp.asarray(array)


def _numpy(value: Any) -> np.ndarray:
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
