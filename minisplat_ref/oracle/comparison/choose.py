"""From what a user types to a renderer, and to the scenes that it is compared on."""

from collections.abc import Callable, Mapping
from pathlib import Path

from minisplat_ref.backends import BACKENDS
from minisplat_ref.constants import GSPLAT_1_5, PROFILES, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.comparison.dumps import from_dumps
from minisplat_ref.oracle.comparison.own import by_profile, from_backend, with_planted_error
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.golden.arrays import SPECS, Arrays
from minisplat_ref.oracle.golden.files import load
from minisplat_ref.oracle.golden.scenes import RECIPES, Golden, inputs
from minisplat_ref.oracle.golden.stages import truth
from minisplat_ref.oracle.planted import PLANTED


def _gsplat_torch(dtype: str) -> Renderer:
    from minisplat_ref.oracle.comparison.gsplat_cuda import rules_of
    from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch

    renderer = from_backend(gsplat_torch(), dtype)

    def arrays(scene: Golden) -> Arrays:
        return {name: a for name, a in renderer.arrays(scene).items() if SPECS[name].stage != "loss"}  # not gsplat's

    return renderer._replace(arrays=arrays, rules=rules_of(GSPLAT_1_5))


def _gsplat() -> Renderer:
    from minisplat_ref.oracle.comparison.gsplat_cuda import gsplat_cuda

    return gsplat_cuda()


def _inria() -> Renderer:
    from minisplat_ref.oracle.comparison.inria_cuda import inria_cuda

    return inria_cuda()


OTHERS: dict[str, Callable[[], Renderer]] = {"gsplat": _gsplat, "inria": _inria}  # float32 only


def choose_renderer(name: str, dtype: str | None) -> Renderer:
    """Renderer of a name.

    Parameters
    ----------
    name : str
        ``cpu``, ``cpu-exact``, ``reference``, ``planted:ERROR``, ``profile:NAME``, ``gsplat-torch``, ``gsplat``,
        ``inria``, or a folder of dumps.
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
    errors = ", ".join(error.name for error in PLANTED)
    raise InputError(
        f"{name!r} is neither a folder of dumps nor a renderer: {', '.join(BACKENDS)}, gsplat-torch, gsplat, inria,"
        f" profile:NAME ({', '.join(PROFILES)}) or planted:ERROR ({errors})"
    )


def choose_scenes(
    renderer: Renderer, name: str, against: str, profile: str | None
) -> tuple[dict[str, Golden], tuple[str, ...]]:
    """Truths for a renderer.

    Parameters
    ----------
    renderer : Renderer
        Says which conventions it follows, and which scenes it has.
    name : str
        Of a scene, or ``"all"`` that the renderer has.
    against : str
        ``"reference"``, computed now, or a folder of golden vectors.
    profile : str, optional
        Key of ``PROFILES`` that takes the place of every scene's conventions and of the renderer's own.

    Returns
    -------
    scenes : dict of Golden
        With all arrays, by name.
    left_out : tuple of str
        Names of the scenes that the renderer cannot draw, by their conventions.

    Raises
    ------
    InputError
        If there is no such scene, or the renderer has not drawn it.
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
        if rules is None:
            left_out.append(scene)
        else:
            chosen[scene] = _with_truth(golden, rules, renderer.ignores)
    if not chosen:
        raise InputError(f"{renderer.name} can draw none of the scenes {', '.join(wanted)}: other conventions")
    return chosen, tuple(left_out)


def _with_truth(golden: Golden, rules: Conventions, ignores: tuple[str, ...]) -> Golden:
    """All arrays, by these rules and with zero for what is ignored; those of a folder where they are that already."""
    is_complete = "v_means" in golden.arrays and not any(golden.arrays[name].any() for name in ignores)
    if is_complete and rules == golden.conventions:
        return golden
    return truth(golden._replace(conventions=rules), zeros=ignores)
