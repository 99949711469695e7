"""Any function with the signature of gsplat's ``rasterization`` as a renderer to compare.

It is called three times for each scene: for colours of spherical harmonics, for given features and depth, and for
colours and expected depth. So an error of the harmonics is distinguished from one of the blending, and of the entries
of the function's meta (gsplat's keys: ``means2d, depths, conics, opacities, radii, flatten_ids, isect_offsets,
tile_size``) each stage is compared by itself. One scene has one camera.

A function without ``render_mode``, or which raises ``NotImplementedError`` for one, is compared without depth.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden.format import Arrays, Golden
from minisplat_ref.oracle.golden.running import VIEW_GRADIENT
from minisplat_ref.oracle.peers.array_kinds import ARRAY_KINDS, Call, Result, kind_of, run
from minisplat_ref.oracle.peers.cuda import rules_of
from minisplat_ref.oracle.renderer import ComparedRenderer
from minisplat_ref.types import Floats

PRIMITIVES = ("means", "quats", "scales", "opacities")
REQUIRED = (*PRIMITIVES, "colors", "viewmats", "Ks", "width", "height", "sh_degree", "backgrounds")
META = {"means2d": "means2d", "depths": "depths", "conics": "conics", "opacities": "opacities2d", "radii": "radii"}
"""Arrays of the golden format by gsplat's names of them, with one more axis in front: of the cameras."""
LIKE_GSPLAT = "give a function with the parameters of gsplat's rasterization"


class Rasterizer(NamedTuple):
    """A function that is compared."""

    name: str
    function: Callable[..., Any]
    vjp: Callable[..., Any] | None
    kind: str
    """The kind of its arguments: ``numpy``, ``torch`` or ``jax``."""
    accepts: Callable[[str], bool]
    """Whether it has a parameter of this name."""
    has_gradients: bool
    """Whether its gradients are compared."""


def from_function(
    function: Callable[..., Any],
    vjp: Callable[..., Any] | None = None,
    *,
    name: str | None = None,
    arrays: str | None = None,
    dtype: str = "float32",
    profile: Conventions = GSPLAT_MAIN,
    has_gradients: bool = True,
) -> ComparedRenderer:
    """Compare a function.

    Parameters
    ----------
    function : callable
        Takes gsplat's parameters by name, returns ``render_colors`` [1, H, W, D], ``render_alphas`` [1, H, W, 1] and,
        if it likes, a meta.
    vjp : callable, optional
        Takes the same and ``v_render_colors``, ``v_render_alphas``; returns a dict of ``v_means`` and so on. Without it
        torch and JAX differentiate the function.
    name : str, optional
        For reports.
    arrays : {"numpy", "torch", "jax"}, optional
        The kind of its arguments; by default the one that its module has imported.
    dtype : {"float32", "float64"}
        The dtype of its computation.
    profile : Conventions
        Its rules, where the scenes leave a choice: how alpha is clamped, for example.
    has_gradients : bool
        Whether its gradients are compared; otherwise images and meta alone.

    Raises
    ------
    InputError
        If the function has another signature.
    """
    called = name or str(getattr(function, "__qualname__", type(function).__name__))
    if arrays is not None and arrays not in ARRAY_KINDS:
        raise InputError(f"arrays {arrays!r} are unknown; choose one of {', '.join(ARRAY_KINDS)}")
    kind = arrays or kind_of(function)
    rasterizer = Rasterizer(called, function, vjp, kind, _parameters(function, called), has_gradients)
    rules = rules_of(profile)

    def drawn(asked: Conventions) -> Conventions | None:
        ours = rules(asked)
        return ours if ours is not None and not _missing_options(rasterizer, ours) else None

    def give(truth: Golden) -> Arrays:
        return _colors(rasterizer, truth, dtype) | _features(rasterizer, truth, dtype) | _view(rasterizer, truth, dtype)

    return ComparedRenderer(f"{called} {dtype}", dtype, False, give, drawn, ignores=("v_depths",))


def _parameters(function: Callable[..., Any], name: str) -> Callable[[str], bool]:
    """Return the parameters of a function; refuse one that cannot be called like gsplat's."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # compiled code may have no signature
        return lambda _: True
    named = {
        p.name: p for p in parameters.values() if p.kind in (inspect.Parameter.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    }
    takes_any = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    missing = [required for required in REQUIRED if required not in named and not takes_any]
    if missing:
        raise InputError(
            f"{name} has no parameter {', '.join(missing)}: {LIKE_GSPLAT}, which are {', '.join(REQUIRED)}"
        )
    known = (*REQUIRED, *_options(GSPLAT_MAIN), "render_mode", "packed")
    strange = [p.name for p in named.values() if p.default is inspect.Parameter.empty and p.name not in known]
    if strange:
        raise InputError(f"{name} needs {', '.join(strange)}, which gsplat's rasterization has not: give a default")
    return lambda option: option in named or (takes_any and option != "packed")  # which only gsplat itself needs


def _options(conventions: Conventions) -> dict[str, Any]:
    """Return gsplat's options for conventions."""
    return {
        "near_plane": conventions.near_plane,
        "far_plane": conventions.far_plane,
        "eps2d": conventions.eps2d,
        "rasterize_mode": "antialiased" if conventions.is_antialiased else "classic",
    }


def _missing_options(rasterizer: Rasterizer, conventions: Conventions) -> list[str]:
    """Return the options that a scene needs at another value than gsplat's default, and the function has not."""
    usual = _options(GSPLAT_MAIN)
    asked = _options(conventions)
    return [name for name, value in asked.items() if value != usual[name] and not rasterizer.accepts(name)]


def _colors(rasterizer: Rasterizer, truth: Golden, dtype: str) -> Arrays:
    """Colours from spherical harmonics: the image, and everything that the function returns with it."""
    a = truth.arrays
    result = _call(rasterizer, truth, dtype, "RGB", _coefficients(truth), a["background"], a["v_image"], a["v_alpha"])
    assert result is not None  # every function has colours
    v = result.gradients
    gradients = {f"v_{name}": v[name] for name in PRIMITIVES if name in v}
    gradients |= {f"v_{META[name]}": value[0] for name, value in result.of_meta.items() if name != "depths"}
    if "colors" in v:
        gradients |= {"v_sh_dc": v["colors"][:, 0], "v_sh_rest": v["colors"][:, 1:]}
    if "backgrounds" in v:
        gradients["v_background"] = v["backgrounds"][0]
    return {"image": result.colors[0], "alpha": result.alphas[0, ..., 0], **_read_meta(rasterizer, result), **gradients}


def _features(rasterizer: Rasterizer, truth: Golden, dtype: str) -> Arrays:
    """Given colours of any number of channels and, if there is a mode for it, the accumulated depth."""
    a = truth.arrays
    n_channels = a["features"].shape[1]
    v_image, v_alpha = a["v_feature_image"], np.zeros_like(a["v_alpha"])
    given = (a["features"], a["feature_background"])
    v_both = np.concatenate([v_image, a["v_accumulated_depth"][..., None]], axis=2)
    result = _call(rasterizer, truth, dtype, "RGB+D", *given, v_both, v_alpha)
    if result is None:
        result = _call(rasterizer, truth, dtype, "RGB", *given, v_image, v_alpha)
        assert result is not None
    out = {"feature_image": result.colors[0, ..., :n_channels]}
    if result.colors.shape[3] == n_channels:  # without depth the gradients of the footprints are others
        return out | ({"v_features": result.gradients["colors"]} if "colors" in result.gradients else {})
    out["accumulated_depth"] = result.colors[0, ..., -1]
    out |= {f"v_{META[name]}_features": value[0] for name, value in result.of_meta.items()}
    if "colors" in result.gradients:
        out["v_features"] = result.gradients["colors"]
    if "backgrounds" in result.gradients:
        out["v_feature_background"] = result.gradients["backgrounds"][0]
    return out


def _view(rasterizer: Rasterizer, truth: Golden, dtype: str) -> Arrays:
    """Colours and expected depth, with the gradient of the view matrix."""
    a = truth.arrays
    v_image = np.concatenate([a["v_image"], a["v_expected_depth"][..., None]], axis=2)
    result = _call(rasterizer, truth, dtype, "RGB+ED", _coefficients(truth), a["background"], v_image, a["v_alpha"])
    if result is None:
        return {}
    v = result.gradients
    out = {"view": result.colors[0], "view_alpha": result.alphas[0, ..., 0]}
    out |= {name: v[key.removeprefix("v_")] for name, key in VIEW_GRADIENT.items() if key.removeprefix("v_") in v}
    if "colors" in v:
        out |= {"v_sh_dc_view": v["colors"][:, 0], "v_sh_rest_view": v["colors"][:, 1:]}
    if "viewmats" in v:
        out["v_viewmat"] = v["viewmats"][0, :3]
    if "backgrounds" in v:
        out["v_background_view"] = v["backgrounds"][0]
    return out


def _coefficients(truth: Golden) -> Floats:
    """Return [N, K, 3]."""
    return np.concatenate([truth.arrays["sh_dc"][:, None], truth.arrays["sh_rest"]], axis=1)


def _call(
    rasterizer: Rasterizer,
    truth: Golden,
    dtype: str,
    mode: str,
    colors: Floats,
    background: Floats,
    v_image: Floats,
    v_alpha: Floats,
) -> Result | None:
    """Call the function; None where it does not have the mode."""
    if mode != "RGB" and not rasterizer.accepts("render_mode"):
        return None
    a, camera = truth.arrays, truth.camera
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    leaves = {name: a[name] for name in PRIMITIVES}
    leaves |= {"colors": colors, "viewmats": viewmat[None], "backgrounds": background[None]}
    options = {**_options(truth.conventions), "render_mode": mode, "packed": False}
    others = {
        "Ks": K[None].astype(dtype),
        "width": camera.width,
        "height": camera.height,
        "sh_degree": truth.sh_degree if colors.ndim == 3 else None,
        **{name: value for name, value in options.items() if rasterizer.accepts(name)},
    }
    cotangents = v_image[None].astype(dtype), v_alpha[None, ..., None].astype(dtype)
    call = Call({name: np.ascontiguousarray(x, dtype) for name, x in leaves.items()}, others, *cotangents)
    where = f"{rasterizer.name}, scene {truth.name}, render_mode {mode}"
    try:
        result = run(rasterizer.kind, rasterizer.function, rasterizer.vjp, call, has_gradients=rasterizer.has_gradients)
    except NotImplementedError as error:
        if mode != "RGB":
            return None
        raise InputError(f"{where}: {error}: it has to have colours at least") from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except Exception as error:  # in the user's code, whatever it is
        kinds = f"it was called with {rasterizer.kind} arrays, --arrays takes others"
        raise InputError(f"{where} raised {type(error).__name__}: {error}; {kinds}") from error
    _check_shapes(where, result, call)
    return result


def _check_shapes(where: str, result: Result, call: Call) -> None:
    expected = {"render_colors": (result.colors, call.v_colors), "render_alphas": (result.alphas, call.v_alphas)}
    expected |= {f"gradient of {name}": (v, call.leaves[name]) for name, v in result.gradients.items()}
    for name, (given, like) in expected.items():
        if given.shape != like.shape:
            raise InputError(f"{where}: {name} has shape {list(given.shape)}, expected {list(like.shape)}")
        if given.dtype.kind != "f":
            raise InputError(f"{where}: {name} has dtype {given.dtype}, expected floating-point numbers")


def _read_meta(rasterizer: Rasterizer, result: Result) -> Arrays:
    """Return the meta of the one camera, in the golden format."""
    meta, n = result.meta, len(result.colors)
    for name in (*META, "isect_offsets"):
        if name in meta and (meta[name].ndim == 0 or len(meta[name]) != n):
            shape = list(meta[name].shape)
            raise InputError(
                f"{rasterizer.name}: meta[{name!r}] has shape {shape}, expected one row for each camera (packed=False)"
            )
    told = {array: meta[name][0] for name, array in META.items() if name in meta}
    if all(name in meta for name in ("flatten_ids", "isect_offsets", "tile_size")):
        ids = meta["flatten_ids"]
        told["gaussian_ids"] = ids.astype(np.int32)
        told["tile_offsets"] = np.append(meta["isect_offsets"].ravel(), len(ids)).astype(np.int64)
        told["tile_size"] = np.broadcast_to(meta["tile_size"], 2).astype(np.int32)
    return told
