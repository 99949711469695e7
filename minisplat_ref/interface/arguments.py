"""Types of the commands' arguments, and the format of help and errors."""

import argparse
import difflib
import math
import shutil
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from minisplat_ref.constants import GSPLAT_MAIN, PROFILES

Commands = argparse._SubParsersAction

BACKENDS = ("cpu", "cpu-exact", "reference")  # keys of backends.BACKENDS, which would load Numba
CUDA = ("cuda", "cuda-atomic")  # need a GPU
PROFILE_HELP = f"rasteriser conventions: {', '.join(PROFILES)} (default {{default}})"
BACKEND_HELP = "cpu[-exact], reference, cuda[-atomic] (default {default})"
VIEWER_PORT = 8080
SYNTHETIC_SCENES = (  # datasets.synthetic.SCENE_NAMES, which would load NumPy
    *("room", "plain-wall", "glossy", "outdoor"),
    *("staircase", "noisy-sphere", "facing-spheres", "box-city"),
    *("park-1", "park-4", "park-16"),
)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, like those of bad input, and suggest what was probably meant.

    Options are not abbreviated: a script with ``--iter`` would break when another option begins with that.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False, **kwargs})

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Parse, and refuse unknown arguments here, where the command's own options are known."""
        parsed, surplus = super().parse_known_args(args, namespace)
        if surplus:
            options = [option for action in self._actions for option in action.option_strings]
            unknown = next((word for word in surplus if word.startswith("-")), "")
            self.error(f"unrecognized arguments: {' '.join(surplus)}{did_you_mean(unknown.partition('=')[0], options)}")
        return parsed, surplus

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            error.message += did_you_mean(str(value), [str(choice) for choice in action.choices or ()])
            raise

    def error(self, message: str) -> NoReturn:
        """Print one line to stderr and exit with code 2."""
        self.exit(2, f"minisplat-ref: error: {message} (see: {self.prog} --help)\n")


def did_you_mean(word: str, choices: Iterable[str]) -> str:
    """Return a question that names the choice that a word was probably meant to be; empty where none is near."""
    bare = {choice.strip("-"): choice for choice in sorted(choices)}
    word = word.strip("-")
    beginning = [name for name in bare if word and name.startswith(word)]
    near = beginning or difflib.get_close_matches(word, bare, n=1, cutoff=0.7)
    return f"; did you mean {bare[near[0]]}?" if near else ""


def suggest(word: str, choices: Iterable[str]) -> str:
    """Return the choice that a word was probably meant to be, as the end of a sentence; where none is near, all."""
    names = list(choices)
    return did_you_mean(word, names) or f": choose from {', '.join(names) or 'none'}"


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Keeps the line breaks of descriptions, which are 80 columns wide at most, and uses up to 100 for options."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26, width=min(100, shutil.get_terminal_size().columns))


def integer(minimum: int) -> Callable[[str], int]:
    """Return the type of a whole number that is at least ``minimum``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = minimum - 1
        if value < minimum:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {minimum}")
        return value

    return parse


def add_number(
    parser: argparse._ActionsContainer, option: str, default: int, meaning: str, minimum: int = 1, metavar: str = "N"
) -> None:
    """Add an option that is a whole number of at least ``minimum``."""
    parser.add_argument(
        option, type=integer(minimum), default=default, metavar=metavar, help=f"{meaning} (default {default})"
    )


def name(text: str) -> str:
    """Type of a name, which must be there."""
    if not text:
        raise argparse.ArgumentTypeError("a name is missing")
    return text


def list_of(parse: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Return the type of values between commas."""
    return lambda text: tuple(parse(part.strip()) for part in text.split(","))


def fraction(text: str) -> float:
    """Parse a number above 0 and at most 1."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and at most 1")
    return value


def positive(text: str) -> float:
    """Parse a number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def assignment(text: str) -> tuple[str, str]:
    """Type of NAME=VALUE."""
    name, separator, value = text.partition("=")
    if not (name and separator and value):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, like exposure=learned")
    return name.strip(), value.strip()


def color(text: str) -> list[float]:
    """Parse R,G,B from 0 to 255 to three numbers from 0 to 1."""
    values = tuple(int(word) if word.isdecimal() else -1 for word in text.split(","))
    if len(values) != 3 or not all(0 <= value <= 255 for value in values):
        raise argparse.ArgumentTypeError(f"{text!r} is not a colour such as 255,255,255")
    return [value / 255.0 for value in values]


def add_background(parser: argparse._ActionsContainer) -> None:
    """Add ``--background``, None where it is not given: that of the run."""
    text = "0 to 255 each (default: the run's, or 0,0,0)"
    parser.add_argument("--background", type=color, metavar="R,G,B", help=text)


def option_name(name: str) -> str:
    """Return the name of a setting on the command line."""
    return name.upper() if name == "scene" else f"--{name.replace('_', '-')}"


def add_renderer_arguments(parser: argparse._ActionsContainer) -> None:
    """Add ``--profile``, a key of ``PROFILES``, and ``--backend``, None where they are not given: those of the run."""
    for option, text, parse, choices, default in (
        ("--profile", PROFILE_HELP, str.upper, tuple(PROFILES), GSPLAT_MAIN.name),
        ("--backend", BACKEND_HELP, str, (*BACKENDS, *CUDA), "cpu"),
    ):
        text = text.format(default=f"the run's, or {default}")
        parser.add_argument(option, type=parse, choices=choices, metavar="NAME", help=text)


def add_up_argument(parser: argparse._ActionsContainer) -> None:
    """Add ``--up``, None where it is not given: a text for :func:`minisplat_ref.io.upright.given_up`."""
    text = "what is up: X,Y,Z or NAME of a photograph (default: found)"
    parser.add_argument("--up", type=name, metavar="U", help=text)


def add_worker_arguments(
    parser: argparse.ArgumentParser,
    here: str = "train in N processes at once (default 0: in turn)",
    elsewhere: str = "train by the workers of a Dask scheduler, tcp://HOST:PORT",
) -> None:
    """Add ``--workers`` and ``--cluster``, of which at most one may be given, with these help texts."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--workers", type=integer(0), default=0, metavar="N", help=here)
    group.add_argument("--cluster", type=name, default=None, metavar="ADDRESS", help=elsewhere)


def drop_workers(words: Sequence[str]) -> list[str]:
    """Return the words of a command without ``--workers N`` and ``--cluster ADDRESS``."""
    options = ("--workers", "--cluster")
    pairs = zip(("", *words), words, strict=False)
    return [word for before, word in pairs if word.partition("=")[0] not in options and before not in options]


def decibels(text: str) -> float:
    """Read a number of dB of at least 0, as an option of the command line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of dB of at least 0")
    return value
