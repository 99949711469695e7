"""The settings of a run, each declared once: its type, its default, its option of ``train`` and its key in a file.

The parser of ``train``, its defaults, what ``config.json`` holds and the check of what is read from there are all made
from the fields of :class:`Settings`. Nothing here imports NumPy, so that ``--help`` does not wait for it.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, get_args, get_origin

from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.interface.arguments import (
    BACKEND_HELP,
    BACKENDS,
    CUDA,
    PROFILE_HELP,
    assignment,
    color,
    decibels,
    integer,
    option_name,
    positive,
)

N_ITERATIONS = 3000  # of recipes with a schedule
NO_OPTION = None  # of a setting that follows from others, or from SCENE
HIDDEN = argparse.SUPPRESS  # the help of an option that --help does not list


@dataclass(frozen=True)
class Option:
    """The option of ``train`` that gives a setting."""

    help: str
    """Its line of ``--help``, in which ``{default}`` stands for the default; or HIDDEN."""
    metavar: str | None = None
    """Name of its value in the line; None for one that takes none."""
    parse: Callable[[str], Any] = str
    """Parses the word into the value in ``config.json``; for an option that is repeated, a key and its value."""
    choices: tuple[str, ...] | None = None
    """All values that there are; None where there are too many."""
    is_valid: Callable[[Any], bool] = lambda value: True
    """Whether a value of the right type can be of a run."""
    on_resume: bool = False
    """Whether a run that is continued can be given another value."""


def _absolute(text: str) -> str:
    """Return a path as a run keeps it: its settings are read from other folders, too."""
    return str(Path(text).resolve())


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Everything besides the scene's files that decides the result; the keys of ``config.json`` in their order."""

    scene: Annotated[str, NO_OPTION]
    """Absolute path of the scene's folder."""
    downscale: Annotated[int, Option("make them D times smaller (default {default})", "D", integer(1))] = 1
    """Factor by which the photographs are made smaller."""
    test_every: Annotated[
        int, Option("hold out every K-th for testing, 0: none (default {default})", "K", integer(0))
    ] = 8
    """One view of this many is held out for testing; 0: none."""
    undistort: Annotated[bool, Option("remove lens distortion instead of refusing it")] = False
    """Whether lens distortion is removed while loading."""
    recipe: Annotated[str, Option("{default} (default), 3dgs[-accel], mini-splatting[2][-d]", "R")] = "adaptive"
    """Name of the recipe."""
    schedule_iterations: Annotated[int, NO_OPTION]
    """Number of iterations that the recipe's milestones are scaled to; stays when a run is made longer."""
    iterations: Annotated[
        int,
        Option(f"one view each (default {N_ITERATIONS}; adaptive decides itself)", "N", integer(1), on_resume=True),
    ]
    """Iteration at which to stop."""
    seed: Annotated[int, Option("seed of all random draws (default {default})", "S", integer(0))] = 0
    """Seed of all random draws."""
    profile: Annotated[str, Option(PROFILE_HELP, "NAME", str.upper, tuple(PROFILES))] = GSPLAT_MAIN.name
    """Name of the rasteriser's conventions."""
    backend: Annotated[str, Option(BACKEND_HELP, "NAME", choices=(*BACKENDS, *CUDA))] = "cpu"
    """Name of the backend."""
    budget: Annotated[
        int | None, Option("the most Gaussians, for recipes that choose their number", "N", integer(1))
    ] = None
    """Gaussians that a simplification keeps at most; None for the recipe's own part of the candidates."""
    simplify: Annotated[
        str | None,
        Option("simplify by sampling (default), rank or merging", "S", choices=("sampling", "rank", "merging")),
    ] = None
    """How simplification chooses; None for the recipe's own way."""
    scene_type: Annotated[
        str | None,
        Option("indoor (default) or outdoor: what counts as important", "T", choices=("indoor", "outdoor")),
    ] = None
    """``indoor`` or ``outdoor``, which decides what importance means; None for the recipe's own choice."""
    extension: Annotated[str | None, Option("extension to train with; its own recipes go to --recipe", "E")] = None
    """Name of an extension that a recipe of the core is trained with; a recipe of an extension brings its own."""
    set: Annotated[
        dict[str, str],
        Option(
            "a setting of the recipe, such as exposure=learned",
            "NAME=VALUE",
            assignment,
            is_valid=lambda texts: all(isinstance(text, str) for text in texts.values()),
        ),
    ] = field(default_factory=dict)
    """Settings of the recipe's events, losses and calibrations, as text: ``--set NAME=VALUE``."""
    eval_every: Annotated[int, Option("measure every K iterations, into curve.jsonl", "K", integer(0))] = 0
    """Iterations after which the test views are measured again; 0: only in the end. Does not change the result."""
    drop_bad_steps: Annotated[bool, Option(HIDDEN, on_resume=True)] = False
    """Whether a step whose gradient is not finite is left out; otherwise it ends the training."""
    lpips_weights: Annotated[
        str | None, Option("measure LPIPS at the end; eval --help says how", "NPZ", _absolute, on_resume=True)
    ] = None
    """Absolute path of the weights of LPIPS; None: it is not measured. Does not change the result."""
    minutes: Annotated[float | None, Option("with adaptive: the most minutes to take", "T", positive)] = None
    """Time that the training may take, for a recipe that decides its own length; the result depends on the machine."""
    max_drop: Annotated[
        float | None, Option("simplify at the end, into DIR/simplified: PSNR to lose", "dB", decibels)
    ] = None
    """PSNR, dB, that a simplification after the training may lose; None: there is none."""
    max_bytes: Annotated[int | None, Option("likewise: size that its PLY may have", "B", integer(1))] = None
    """Size that the PLY of a simplification after the training may have; None: there is none."""
    init: Annotated[str | None, Option("points (PLY) or run to start from", "START", _absolute)] = None
    """Absolute path of the PLY or run that the training starts from, not read again; None for the scene's points."""
    model: Annotated[str | None, Option("folder of the COLMAP model in SCENE (default sparse/0)", "M")] = None
    """Folder of the COLMAP model, relative to the scene; None for the first that is there."""
    background: Annotated[
        list[float] | None,
        Option(
            "behind the scene (default 0,0,0; white 255,255,255)",
            "R,G,B",
            color,
            is_valid=lambda rgb: len(rgb) == 3 and all(isinstance(value, int | float) for value in rgb),
        ),
    ] = None
    """[3] RGB in [0, 1] behind the scene, and behind transparent pixels of a transforms.json; None for black."""
    block: Annotated[str | None, Option(HIDDEN, "PART", _absolute)] = None
    """Absolute path of a part of the scene, a :class:`~minisplat_ref.app.runs.scene_part.Part`; None for the whole."""
    whole_iterations: Annotated[int | None, Option(HIDDEN, "N", integer(1))] = None
    """Iterations of a training whose schedule this one has: as its beginning, or with ``block`` as a part that
    continues the beginning ``init``; None for a training with a schedule of its own."""
    fold: Annotated[int, Option(HIDDEN, "N", integer(0))] = 0
    """Offset of the first held-out photograph, below ``test_every``: one fold of a cross-validation."""


def list_options(declaration: type) -> dict[str, Option]:
    """Return the options of a declaration such as :class:`Settings`, by the names of its fields.

    Raises
    ------
    TypeError
        A field has neither an option nor NO_OPTION, or its option has no help.
    """
    options = {}
    for setting in fields(declaration):
        option = get_args(setting.type)[-1] if get_origin(setting.type) is Annotated else "missing"
        if option is NO_OPTION:
            continue
        if not (isinstance(option, Option) and option.help):
            raise TypeError(f"setting {setting.name} of {declaration.__name__} needs an Option with help, or NO_OPTION")
        options[setting.name] = option
    return options


OPTIONS = list_options(Settings)
"""The options of ``train`` that become settings."""
_FIELDS = {setting.name: setting for setting in fields(Settings)}
NAMES = tuple(_FIELDS)
FIRST_NAMES = NAMES[: NAMES.index("backend") + 1]  # which runs of every version have
NEW_ON_RESUME = tuple(name for name, option in OPTIONS.items() if option.on_resume)


def _list_types(name: str) -> tuple[type, ...]:
    """Return the types that a setting can have."""
    kind = get_args(_FIELDS[name].type)[0]
    return tuple(get_origin(part) or part for part in (get_args(kind) if isinstance(kind, UnionType) else (kind,)))


def add_settings(parser: argparse._ActionsContainer, *names: str, **helps: str) -> None:
    """Add the options of these settings, or with another help, to a parser that leaves out what is not given."""
    for name, text in ({name: OPTIONS[name].help for name in names} | helps).items():
        option, types = OPTIONS[name], _list_types(name)
        words: dict[str, Any] = {"type": option.parse, "choices": option.choices, "metavar": option.metavar}
        if bool in types:
            words = {"action": "store_true"}
        elif dict in types:
            words["action"] = "append"
        parser.add_argument(option_name(name), help=text.replace("{default}", str(_FIELDS[name].default)), **words)


def first_wrong(settings: Settings) -> str | None:
    """Return the name of the first setting whose value no training can have; None where all are right."""
    for name in NAMES:
        value, option = getattr(settings, name), OPTIONS.get(name)
        if not isinstance(value, _list_types(name)):
            return name
        if option and value is not None and not (option.is_valid(value) and value in (option.choices or (value,))):
            return name
    return None
