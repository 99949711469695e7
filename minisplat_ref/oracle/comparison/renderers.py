"""The renderers that can be compared: anything that returns arrays of the golden format for a scene; and their names.

First ours (the backends, a backend with a planted error, the reference under other conventions); then a folder of
arrays written by some other renderer; last, how names that users type select a renderer and the scenes to compare.
Other people's renderers are in :mod:`minisplat_ref.oracle.peers`; :mod:`minisplat_ref.oracle.renderer` has their type.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, PROFILES, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import did_you_mean
from minisplat_ref.oracle.golden.files import load, read_manifest, read_npz
from minisplat_ref.oracle.golden.format import SPECS, Arrays, Golden
from minisplat_ref.oracle.golden.running import run_stages
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.planted import PLANTED, plant
from minisplat_ref.oracle.renderer import ComparedRenderer
from minisplat_ref.rendering.backends import BACKENDS, CPU, CUDA, CUDA_ATOMIC, REFERENCE, Backend, get_backend


def from_backend(backend: Backend, dtype: str, conventions: Conventions | None = None) -> ComparedRenderer:
    """Compare a backend, every stage by itself.

    Parameters
    ----------
    backend : Backend
        Its stages.
    dtype : str
        ``"float32"`` or ``"float64"``.
    conventions : Conventions, optional
        Those that it follows, regardless of the scene's; by default those of the scene.
    """

    def arrays(truth: Golden) -> Arrays:
        scene = truth if conventions is None else truth._replace(conventions=conventions)
        return run_stages(backend, scene, dtype, fed=truth.arrays)

    name = f"{backend.name} {dtype}" if conventions is None else f"{backend.name} {dtype} by {conventions.name}"
    return ComparedRenderer(name, dtype, True, arrays)


def with_planted_error(name: str, dtype: str) -> ComparedRenderer:
    """Compare the cpu backend with one error in it."""
    renderer = from_backend(plant(name, CPU), dtype)

    def arrays(truth: Golden) -> Arrays:
        with np.errstate(all="ignore"):  # an error may divide by zero, and is then found
            return renderer.arrays(truth)

    return renderer._replace(arrays=arrays)


def by_profile(conventions: Conventions, dtype: str) -> ComparedRenderer:
    """Compare the reference under other conventions than the scene's: the effect of a choice of conventions."""
    return from_backend(REFERENCE, dtype, conventions)


def from_dumps(path: str | Path, dtype: str | None = None) -> ComparedRenderer:
    """Compare the arrays in ``path/SCENE/*.npz``.

    Parameters
    ----------
    path : str or Path
        Folder with a folder for each scene. A manifest is not needed; where there is one, its hashes are checked.
    dtype : str, optional
        In which the renderer computed, if it differs from the dtype that it wrote.

    Raises
    ------
    InputError
        If there is no scene, or a manifest that does not fit.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give a renderer's name, or the folder of its arrays")
    read_manifest(folder)
    scenes = tuple(sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and any(entry.glob("*.npz"))))
    if not scenes:
        raise InputError(f"{folder} holds no SCENE/*.npz; minisplat-ref oracle export DIR shows the format")
    return ComparedRenderer(str(folder), dtype, False, lambda truth: _read(folder / truth.name, truth), scenes=scenes)


def _read(folder: Path, truth: Golden) -> Arrays:
    """Return the arrays of a scene that the truth has too; inputs among them must equal the truth's."""
    arrays: Arrays = {}
    for file in sorted(folder.glob("*.npz")):
        for name, array in read_npz(file).items():
            if name not in SPECS:
                raise InputError(f"{file}: {name!r} is no array of the golden format; its README.md lists the names")
            if name in arrays:
                raise InputError(f"{file}: {name} was already in another file of {folder}; write it once")
            _check_kind(file, name, array)
            arrays[name] = array
    for name, array in arrays.items():
        if SPECS[name].role in ("input", "cotangent") and name != "tile_size":
            expected = truth.arrays[name].astype(np.float32)  # rounded
            if not np.array_equal(array.astype(np.float32), expected):
                raise InputError(
                    f"{folder}: its {name} is not that of the golden scene {truth.name!r}; render the scene that"
                    " minisplat-ref oracle export writes, or give that folder with --against"
                )
    return arrays


def _check_kind(file: Path, name: str, array: NDArray[Any]) -> None:
    is_integer, is_float = array.dtype.kind in "iu", array.dtype in (np.float32, np.float64)
    if not (is_float if SPECS[name].kind == "float64" else is_integer):
        allowed = "float32 or float64" if SPECS[name].kind == "float64" else "integers"
        raise InputError(f"{file}: {name} has dtype {array.dtype}; write {allowed}")


NOT_OF_GSPLAT = ("loss", "statistics", "surface", "adam")  # stages that gsplat's functions in torch do not have


def _choose_gpu(name: str, dtype: str) -> ComparedRenderer:
    """Return one of our backends for a GPU; where the simulator replaces the GPU, the name mentions it."""
    backend = get_backend(name)
    where = " in the simulator" if backend.residence.is_simulated else ""
    return from_backend(replace(backend, name=f"{name}{where}"), dtype)


def _gsplat_torch(dtype: str) -> ComparedRenderer:
    from minisplat_ref.oracle.peers.cuda import rules_of
    from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch

    backend = gsplat_torch()

    def arrays(scene: Golden) -> Arrays:
        return run_stages(backend, scene, dtype, fed=scene.arrays, without=NOT_OF_GSPLAT)

    return from_backend(backend, dtype)._replace(arrays=arrays, rules=rules_of(GSPLAT_1_5))


def _gsplat() -> ComparedRenderer:
    from minisplat_ref.oracle.peers.cuda import gsplat_cuda

    return gsplat_cuda()


def _inria() -> ComparedRenderer:
    from minisplat_ref.oracle.peers.cuda import inria_cuda

    return inria_cuda()


OTHERS: dict[str, Callable[[], ComparedRenderer]] = {"gsplat": _gsplat, "inria": _inria}  # float32 only


def choose_renderer(name: str, dtype: str | None) -> ComparedRenderer:
    """Return the renderer of a name.

    Parameters
    ----------
    name : str
        ``cpu``, ``cpu-exact``, ``reference``, ``cuda``, ``cuda-atomic``, ``planted:ERROR``, ``profile:NAME``,
        ``gsplat-torch``, ``gsplat``, ``inria``, or a folder of dumps.
    dtype : str, optional
        ``"float32"`` or ``"float64"``; by default float64 for ours, float32 on a GPU, and that of each dumped array.

    Raises
    ------
    InputError
        If there is none, or it cannot run here.
    """
    kind, _, rest = name.partition(":")
    own_dtype = dtype or "float64"
    if name in BACKENDS:
        return from_backend(BACKENDS[name], own_dtype)
    if name in (CUDA, CUDA_ATOMIC):
        return _choose_gpu(name, dtype or "float32")
    if kind == "planted" and not Path(name).is_dir():
        return with_planted_error(rest, own_dtype)
    if kind == "profile" and not Path(name).is_dir():
        if rest.upper() not in PROFILES:
            raise InputError(f"profile {rest!r} is unknown; choose one of {', '.join(PROFILES)}")
        return by_profile(PROFILES[rest.upper()], own_dtype)
    if name == "gsplat-torch":
        return _gsplat_torch(own_dtype)
    if name in OTHERS:
        if dtype == "float64":
            raise InputError(f"{name} computes in float32; leave --dtype out")
        return OTHERS[name]()
    if Path(name).is_dir():
        return from_dumps(name, dtype)
    from minisplat_ref.oracle.peers.named_function import functions_of_module

    if functions := functions_of_module(name):
        chosen = "rasterization" if "rasterization" in functions else functions[0]
        others = f", or another of its functions: {', '.join(functions)}" if len(functions) > 1 else ""
        raise InputError(f"{name} is a module, of which one function is compared: give {name}:{chosen}{others}")
    named = (*BACKENDS, CUDA, CUDA_ATOMIC, "gsplat-torch", *OTHERS, *(f"planted:{error.name}" for error in PLANTED))
    if meant := did_you_mean(name, named):
        raise InputError(f"{name!r} is neither a folder of dumps nor a renderer{meant}")
    errors = ", ".join(error.name for error in PLANTED)
    raise InputError(
        f"{name!r} is neither a folder of dumps nor a renderer: package.module:function, {', '.join(BACKENDS)},"
        " cuda, cuda-atomic, gsplat-torch, gsplat, inria,"
        f" profile:NAME ({', '.join(PROFILES)}) or planted:ERROR ({errors})"
    )


def is_function(name: str) -> bool:
    """Return whether a name is of the form ``package.module:function``."""
    return ":" in name and name.partition(":")[0] not in ("planted", "profile") and not Path(name).is_dir()


def choose_function(name: str, dtype: str | None, profile: str | None, arrays: str | None) -> ComparedRenderer:
    """Return the renderer of ``package.module:function``.

    Parameters
    ----------
    name : str
    dtype : str, optional
        ``"float32"``, the default, or ``"float64"``.
    profile : str, optional
        Key of ``PROFILES``: its rules; by default those of gsplat's main branch.
    arrays : str, optional
        ``"numpy"``, ``"torch"`` or ``"jax"``; by default the kind that its module has imported.

    Raises
    ------
    InputError
        If there is no such function, or it cannot be called like gsplat's.
    """
    from minisplat_ref.oracle.peers.function import from_function
    from minisplat_ref.oracle.peers.named_function import load_function

    function, vjp = load_function(name)
    rules = GSPLAT_MAIN if profile is None else PROFILES[profile]
    return from_function(function, vjp, name=name, arrays=arrays, dtype=dtype or "float32", profile=rules)


def choose_scenes(
    renderer: ComparedRenderer, name: str, against: str, profile: str | None
) -> tuple[dict[str, Golden], tuple[str, ...]]:
    """Return the truths for a renderer.

    Parameters
    ----------
    renderer : ComparedRenderer
        Determines the conventions and the scenes.
    name : str
        Of a scene, or ``"all"`` that the renderer has.
    against : str
        ``"reference"``, computed now, or a folder of golden vectors.
    profile : str, optional
        Key of ``PROFILES`` that replaces every scene's conventions and the renderer's own.

    Returns
    -------
    scenes : dict of Golden
        With all arrays, by name.
    left_out : tuple of str
        Names of the scenes whose conventions the renderer does not support; and of exact scenes, where ours would round
        in float32, or other thresholds than the scene's own are requested.

    Raises
    ------
    InputError
        If there is no such scene, or the renderer has no results for it.
    """
    known: Mapping[str, Golden | None]
    known = dict.fromkeys(recipe.name for recipe in RECIPES) if against == "reference" else load(against)
    wanted = tuple(known) if name == "all" else (name,)
    if name not in ("all", *known):
        raise InputError(f"scene {name!r} is unknown; choose all or one of {', '.join(known)}")
    if renderer.scenes is not None:
        strange = [scene for scene in renderer.scenes if scene not in known]
        if strange:
            raise InputError(f"{renderer.name}: {strange[0]!r} is no golden scene; there are {', '.join(known)}")
        if name != "all" and name not in renderer.scenes:
            raise InputError(f"{renderer.name} has no scene {name!r}; it has {', '.join(renderer.scenes)}")
        wanted = tuple(scene for scene in wanted if scene in renderer.scenes)
    chosen, left_out = {}, []
    for scene in wanted:
        golden = known[scene] or inputs(next(recipe for recipe in RECIPES if recipe.name == scene))
        rules = renderer.rules(golden.conventions) if profile is None else PROFILES[profile]
        rounds = golden.is_exact and renderer.is_staged and renderer.dtype == "float32"
        if rules is None or rounds or (golden.is_exact and profile is not None):
            left_out.append(scene)
        else:
            chosen[scene] = _complete(golden, rules, renderer.ignores)
    if not chosen:
        raise InputError(f"{renderer.name} can render none of the scenes {', '.join(wanted)}: other conventions")
    return chosen, tuple(left_out)


def _complete(golden: Golden, rules: Conventions, ignores: tuple[str, ...]) -> Golden:
    """Return all arrays under these conventions, or a folder's own if it follows them; ignored ones are zero."""
    is_complete = "v_means" in golden.arrays and not any(golden.arrays[name].any() for name in ignores)
    if is_complete and rules == golden.conventions:
        return golden
    return truth(golden._replace(conventions=rules), zeros=ignores)
