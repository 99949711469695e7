"""Save a training, and load it: each part of a checkpoint is checked before the training continues from it.

A checkpoint that was truncated, mixed with another or edited by hand would otherwise fail in the middle of an
iteration, or continue with numbers that make no sense.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from minisplat_ref.constants import SH_DEGREE_MAX
from minisplat_ref.errors import InputError
from minisplat_ref.io.checkpoint import DamagedCheckpoint, load_checkpoint, save_checkpoint
from minisplat_ref.io.frames import frame_from_json, frame_to_json
from minisplat_ref.training.adam import AdamState, named_fields
from minisplat_ref.training.calibration import CALIBRATIONS
from minisplat_ref.training.pace import Pace, pace_from_json, pace_to_json
from minisplat_ref.training.rates import n_coefficients
from minisplat_ref.training.recipe_settings import apply_decisions
from minisplat_ref.training.schedule import Recipe, describe
from minisplat_ref.training.state import DEGREES, TrainState
from minisplat_ref.types import FILE_FRAME, Floats, Frame, Gaussians

WAY_OUT = "give another checkpoint or train again"
N_STATE_BITS = 128  # of the generator PCG64
MOMENTS = {"first": "gaussians", "second": "gaussians", "shared_first": "shared", "shared_second": "shared"}
GAUSSIAN_SHAPES: Mapping[str, tuple[tuple[int, ...], ...]] = {
    **{"means": ((3,),), "quats": ((4,),), "log_scales": ((3,),), "opacity_logits": ((),), "sh_dc": ((3,),)},
    "sh_rest": tuple(((degree + 1) ** 2 - 1, 3) for degree in range(SH_DEGREE_MAX + 1)),
}
"""Shapes that the fields of :class:`Gaussians` may have after their first axis."""


class Counters(NamedTuple):
    """The progress of a training."""

    step: int
    adam_step: int
    shared_adam_step: int
    shared_adam_joined: dict[str, int]
    view_order: list[int]


class Bundles(NamedTuple):
    """The arrays of a training."""

    gaussians: Any
    first: Any
    second: Any
    shared: dict[str, Floats]
    shared_first: dict[str, Floats]
    shared_second: dict[str, Floats]
    stats: dict[str, NDArray[Any]]


def save_state(path: str | Path, state: TrainState, recipe: Recipe, *, previous: str | Path | None = None) -> None:
    """Write a checkpoint from which :func:`load_state` continues bit by bit.

    Parameters
    ----------
    path : str or Path
    state : TrainState
        Whole.
    recipe : Recipe
        By which it is trained.
    previous : str or Path, optional
        The checkpoint that was at ``path`` moves here.
    """
    assert state.is_whole, "half an iteration must not be saved"
    groups = {
        **{"gaussians": state.gaussians, "first": state.adam.first, "second": state.adam.second},
        **{"shared": state.shared, "shared_first": state.shared_adam.first, "shared_second": state.shared_adam.second},
    }
    arrays = {
        f"{group}.{name}": array for group, bundle in groups.items() for name, array in named_fields(bundle).items()
    }
    arrays |= {f"stats.{name}": field for name, field in state.stats.items()}
    metadata = {
        "step": state.step,
        "adam_step": state.adam.step,
        "shared_adam_step": state.shared_adam.step,
        "view_order": state.view_order,
        "rng": state.rng.bit_generator.state,
        "recipe": describe(recipe),
    }
    if recipe.cooling is not None or state.pace != Pace():
        metadata["pace"] = pace_to_json(state.pace)
    if state.shared_adam.joined:
        metadata["shared_adam_joined"] = dict(state.shared_adam.joined)
    if state.frame != FILE_FRAME:
        metadata["frame"] = frame_to_json(state.frame)
    save_checkpoint(path, arrays, metadata, previous=previous)


def load_state(path: str | Path, recipe: Recipe) -> TrainState:
    """Read what :func:`save_state` wrote.

    Raises
    ------
    InputError
        The file is missing or damaged, or was written under another recipe.
    """
    arrays, metadata = load_checkpoint(path)
    counters = read_counters(path, metadata)
    if metadata.get("recipe") != json.loads(json.dumps(describe(recipe))):
        name, length = recorded_recipe(metadata)
        raise InputError(
            f"{path} was written by recipe {name} of {length} iterations with other settings than"
            f" {recipe.name} of {recipe.iterations} iterations: continue with the recipe of the run"
        )
    is_decided = recipe.cooling is not None or "pace" in metadata
    pace = read_pace(path, metadata.get("pace")) if is_decided else Pace()
    bundles = read_bundles(path, arrays, recipe.representation.population)
    without_rate = [name for name in bundles.shared if name not in apply_decisions(recipe, pace).rates.of]
    if without_rate:
        raise InputError(f"{path}: holds {', '.join(without_rate)}, which recipe {recipe.name} does not train")
    return TrainState(
        bundles.gaussians,
        AdamState(bundles.first, bundles.second, counters.adam_step),
        counters.step,
        counters.view_order,
        read_generator(path, metadata.get("rng")),
        bundles.stats,
        bundles.shared,
        AdamState(bundles.shared_first, bundles.shared_second, counters.shared_adam_step, counters.shared_adam_joined),
        pace=pace,
        frame=read_frame(path, metadata),
    )


def recorded_recipe(metadata: Mapping[str, Any]) -> tuple[str, str]:
    """Return the name and length, in iterations, of the recipe that a checkpoint records."""
    recipe = metadata.get("recipe")
    recipe = recipe if isinstance(recipe, dict) else {}
    n_iterations = recipe.get("iterations")
    return str(recipe.get("name", "without a name")), f"{n_iterations:,}" if type(n_iterations) is int else "unknown"


def read_frame(path: str | Path, metadata: Mapping[str, Any]) -> Frame:
    """Return the frame of a checkpoint's parameters.

    Raises
    ------
    DamagedCheckpoint
        It is malformed.
    """
    frame = frame_from_json(metadata.get("frame"))
    if frame is None:
        raise DamagedCheckpoint(f"{path}: frame is no origin and unit; {WAY_OUT}")
    return frame


def read_counters(path: str | Path, metadata: Mapping[str, Any]) -> Counters:
    """Return the counters of a checkpoint, which are whole numbers of at least 0.

    Raises
    ------
    DamagedCheckpoint
        One is missing or not such a number.
    """

    def check(name: str, value: Any) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**63:
            raise DamagedCheckpoint(f"{path}: {name} is no whole number of at least 0; {WAY_OUT}")
        return value

    step, adam_step, shared_step = (check(f, metadata.get(f)) for f in ("step", "adam_step", "shared_adam_step"))
    order = metadata.get("view_order")
    if not isinstance(order, list):
        raise DamagedCheckpoint(f"{path}: view_order is no list of views; {WAY_OUT}")
    joined = metadata.get("shared_adam_joined", {})
    if not isinstance(joined, dict) or any(check(name, steps) >= shared_step + 1 for name, steps in joined.items()):
        raise DamagedCheckpoint(f"{path}: shared_adam_joined is no record of the steps before fields came; {WAY_OUT}")
    views = [check("a number in view_order", view) for view in order]
    return Counters(step, adam_step, shared_step, joined, views)


def read_pace(path: str | Path, value: Any) -> Pace:
    """Return the measurements and decisions of a training that decides its own length.

    Raises
    ------
    DamagedCheckpoint
        It is missing or malformed.
    """
    try:
        pace = pace_from_json(value)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DamagedCheckpoint(f"{path}: pace is no record of measurements and decisions; {WAY_OUT}") from error
    if not {calibration.name for calibration in CALIBRATIONS} >= set(pace.switched_on):
        raise DamagedCheckpoint(f"{path}: pace names a calibration that does not exist; {WAY_OUT}")
    return pace


def read_generator(path: str | Path, state: Any) -> np.random.Generator:
    """Return the random generator of a checkpoint.

    Parameters
    ----------
    path : str or Path
    state : any
        The value of ``bit_generator.state`` of NumPy's PCG64.

    Raises
    ------
    DamagedCheckpoint
        It is no such state.
    """
    rng = np.random.default_rng()
    limits = {"state": 2**N_STATE_BITS, "inc": 2**N_STATE_BITS, "has_uint32": 2, "uinteger": 2**32}
    inner = state.get("state") if isinstance(state, dict) else None
    numbers = {**state, **inner} if isinstance(inner, dict) else {}
    is_valid = all(type(numbers.get(name)) is int and 0 <= numbers[name] < limit for name, limit in limits.items())
    if not is_valid or state.get("bit_generator") != "PCG64" or numbers["inc"] % 2 == 0:
        raise DamagedCheckpoint(f"{path}: rng is no state of the random generator PCG64; {WAY_OUT}")
    rng.bit_generator.state = state
    return rng


def read_bundles(path: str | Path, arrays: Mapping[str, NDArray[Any]], population: Any) -> Bundles:
    """Return the arrays of a checkpoint in their groups.

    Parameters
    ----------
    path : str or Path
    arrays : mapping of str to ndarray
        Named ``GROUP.FIELD``.
    population : type
        NamedTuple of the population's fields.

    Raises
    ------
    DamagedCheckpoint
        A field is missing or unknown, has another number of rows than ``means``, is no floating-point array, or holds
        NaN or infinity; or moments do not match their parameters.
    """
    groups: dict[str, dict[str, NDArray[Any]]] = {name: {} for name in Bundles._fields}
    for name, array in arrays.items():
        group, _, field = name.partition(".")
        if group not in groups or not field:
            raise DamagedCheckpoint(f"{path}: an array {name!r} belongs to no checkpoint of this version; {WAY_OUT}")
        groups[group][field] = np.ascontiguousarray(array).reshape(array.shape)  # Adam writes through views
    _check_population(path, groups["gaussians"], population)
    for name, of in MOMENTS.items():
        _check_moments(path, name, groups[name], groups[of])
    n = len(groups["gaussians"]["means"])
    for name, array in groups["stats"].items():
        if array.shape[:1] != (n,):
            raise DamagedCheckpoint(f"{path}: stats.{name} has shape {list(array.shape)} for {n} Gaussians; {WAY_OUT}")
    if DEGREES in groups["stats"]:
        _check_degrees(path, groups["stats"][DEGREES], groups["gaussians"])
    for name, array in groups["shared"].items():
        _check_numbers(path, f"shared.{name}", array)
    gaussians, first, second = (population(**groups[name]) for name in ("gaussians", "first", "second"))
    return Bundles(gaussians, first, second, *(groups[name] for name in Bundles._fields[3:]))


def check_fields(path: str | Path, fields: Mapping[str, NDArray[Any]]) -> None:
    """Refuse fields of any population that differ in their number of rows or are not finite numbers."""
    if "means" not in fields or fields["means"].ndim != 2:
        raise DamagedCheckpoint(f"{path}: gaussians.means is missing or has no rows of coordinates; {WAY_OUT}")
    n = len(fields["means"])
    for name, array in fields.items():
        if array.shape[:1] != (n,):
            raise _misfit(path, name, array)
        _check_numbers(path, f"gaussians.{name}", array)
        if not np.isfinite(array).all():
            raise DamagedCheckpoint(f"{path}: gaussians.{name} holds infinity; {WAY_OUT}")


def _check_population(path: str | Path, fields: Mapping[str, NDArray[Any]], population: Any) -> None:
    """Refuse a population that lacks a field, or whose fields do not belong together."""
    if set(fields) != set(population._fields):
        differing = ", ".join(sorted(set(fields) ^ set(population._fields)))
        raise DamagedCheckpoint(
            f"{path}: the fields of the Gaussians are not those of the recipe ({differing}); {WAY_OUT}"
        )
    check_fields(path, fields)
    for name, shapes in GAUSSIAN_SHAPES.items():
        if population is Gaussians and fields[name].shape[1:] not in shapes:  # only these shapes are known here
            raise _misfit(path, name, fields[name])


def _misfit(path: str | Path, name: str, array: NDArray[Any]) -> DamagedCheckpoint:
    return DamagedCheckpoint(f"{path}: gaussians.{name} has shape {list(array.shape)}, which does not fit; {WAY_OUT}")


def _check_moments(
    path: str | Path, group: str, moments: Mapping[str, NDArray[Any]], fields: Mapping[str, NDArray[Any]]
) -> None:
    """Refuse moments of Adam whose shapes or types differ from the parameters'."""
    for name in sorted(moments.keys() | fields.keys()):
        moment, field = moments.get(name), fields.get(name)
        if moment is None or field is None or moment.shape != field.shape or moment.dtype != field.dtype:
            raise DamagedCheckpoint(f"{path}: {group}.{name} does not fit the parameters that it belongs to; {WAY_OUT}")
        _check_numbers(path, f"{group}.{name}", moment)


def _check_degrees(path: str | Path, degrees: NDArray[Any], fields: Mapping[str, NDArray[Any]]) -> None:
    """Refuse degrees of the Gaussians' harmonics above the stored one: kernels would write beyond their rows."""
    n_stored = fields["sh_rest"].shape[1] if "sh_rest" in fields else 0
    is_possible = degrees.ndim == 1 and degrees.dtype == np.uint8
    if not is_possible or n_coefficients(degrees).max(initial=0) > n_stored:
        raise DamagedCheckpoint(f"{path}: stats.{DEGREES} holds no degrees of the stored harmonics; {WAY_OUT}")


def _check_numbers(path: str | Path, name: str, array: NDArray[Any]) -> None:
    """Refuse an array that is not float32 or float64 or not finite."""
    if array.dtype not in (np.float32, np.float64):
        raise DamagedCheckpoint(f"{path}: {name} has dtype {array.dtype}, not float32 or float64; {WAY_OUT}")
    if np.isnan(array).any():
        raise DamagedCheckpoint(f"{path}: {name} holds NaN; {WAY_OUT}")
