"""Commands that pages, notebooks, docstrings and messages quote can be typed: the program's own parsers read them.

What is required of a quote depends on where it stands:

- A line that is a command, in a code block, an example or a docstring, is there to be copied. It must parse.
- Inline code, which may leave out ``minisplat-ref`` (and ``python -m data_tools.`` before ``claims``), and a command in
  a sentence must parse, too, if they hold a value or a positional argument. A command without any argument is a name,
  which must exist; one with nothing but options (``train --view``) names these.
- A quote with ``...`` is a fragment: its commands and options must exist.

In all of them a word in capitals (``SCENE``, ``N``, ``AxB``, ``tcp://HOST:PORT``) stands for any value, what is in
brackets may be left out, and of ``a|b`` each is tried.
"""

import argparse
import ast
import importlib.util
import io
import itertools
import re
import runpy
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import cache, partial, wraps
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest

from data_tools.claims import all_claims, find_claim
from data_tools.claims.__main__ import parser_of
from minisplat_ref.app import cli
from minisplat_ref.errors import InputError
from minisplat_ref.extensions import folders
from minisplat_ref.extensions.extension import load_extension

ROOT = Path(__file__).parents[2]
RETIRED = {"mini_splatting.md": "study split room", "adaptive.md": "--candidates"}  # and the commit that still has them
UNREADABLE = ("data_tools.commit_subject", "data_tools.mutation")  # without argparse; needs what tests do not install
CLAIMS = ("data_tools.claims", "claims")  # inline code may leave out `python -m data_tools.`, too
VALUE = "{}"  # what a part in braces of an f-string becomes


class Quote(NamedTuple):
    """A command somewhere in the repository."""

    place: str
    text: str
    is_line: bool
    """Whether it is a line, which a reader copies, and not a part of a sentence."""


# Parsers


class Reader(NamedTuple):
    """What reads the words of a command after its first ones."""

    parser: argparse.ArgumentParser
    before: Sequence[str] = ()
    """Words that precede the others, as ``sfm`` does for ``python -m data_tools.sfm``."""
    n_names: int = 0
    """How many words of the command it does not read."""


class _Found(Exception):
    """A parser, and the words that it is to parse."""


def _reader_in(function: Callable, *args, n_names: int) -> Reader:
    """Return the parser that a function builds, by ending the function where it begins to parse."""

    def stop(parser, words=None, *_):
        raise _Found(parser, words or ())

    with mock.patch.object(argparse.ArgumentParser, "parse_args", stop), warnings.catch_warnings(action="ignore"):
        try:
            function(*args)
        except _Found as found:
            return Reader(*found.args, n_names)
    raise InputError("nothing parses this command")


_ANY_WORDS = Reader(argparse.ArgumentParser(prefix_chars="\0", add_help=False), n_names=1)
_ANY_WORDS.parser.add_argument("words", nargs=argparse.REMAINDER)


@cache
def reader_of(first: str, second: str) -> Reader:
    """Return what reads a command by its first two words; a script is run until it parses, so that is its first act."""
    if first in CLAIMS and second[:1].islower():
        reader = Reader(parser_of(second, find_claim(second)), n_names=2)
    elif first in CLAIMS:
        reader = _ANY_WORDS
    elif first.startswith("data_tools."):
        if importlib.util.find_spec(first) is None:
            raise InputError(f"there is no {first}")
        with mock.patch.object(sys, "argv", [first]):
            run = partial(runpy.run_module, first, run_name="__main__")
            reader = _ANY_WORDS if first in UNREADABLE else _reader_in(run, n_names=1)
    else:
        reader = Reader(cli._find_parser([first]))
    _accept_placeholders(reader.parser)
    return reader


class _Placeholder(str):
    """A word that stands for a value."""


class _Choices(tuple):
    """Choices, of which any may be meant by a placeholder."""

    def __contains__(self, value):
        return isinstance(value, _Placeholder) or super().__contains__(value)


def is_placeholder(word: str) -> bool:
    """Return whether a word is in braces, or in capitals but for the x of ``AxB``."""
    return re.fullmatch(r"\{.*\}|(?=.*[A-Z])[^a-wyz-][^a-wyz]*", word) is not None


def _accept_placeholders(parser: argparse.ArgumentParser) -> None:
    """Let every argument of a parser and of its commands be a placeholder, whatever its type and choices."""

    def also_placeholders(parse):
        @wraps(parse)
        def parse_word(word):
            return _Placeholder(word) if is_placeholder(word) else parse(word)

        return parse_word

    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _accept_placeholders(command)
        else:
            action.type = also_placeholders(action.type or str)
            action.choices = action.choices and _Choices(action.choices)


def commands_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of a parser's commands by name; {} where there are none."""
    return next((a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})


COMMANDS = {*commands_of(cli.build_parser()), *folders(), "claims"}  # what can be the first word


# What is wrong with a quote


class Command(NamedTuple):
    """Words of a command beside the parsers of its names."""

    top: argparse.ArgumentParser
    """Parses ``words``."""
    words: list[str]
    parser: argparse.ArgumentParser
    """Of the last name, parses ``rest``."""
    rest: list[str]


def command_of(words: list[str]) -> Command:
    """Return a command by its words; raise InputError where its first names do not exist."""
    top, before, n_names = reader_of(words[0], (*words, "")[1])
    parser, rest = top, [*before, *words[n_names:]]
    words = rest
    while rest and rest[0] in (commands := commands_of(parser)):
        parser, rest = commands[rest[0]], rest[1:]
    return Command(top, words, parser, rest)


def compute_error(text: str, is_line: bool = False) -> str:
    """Return what is wrong with a command, mostly in argparse's words; empty where it can be typed."""
    text = re.sub(r"\[[^]]*\]", " ", text)  # what may be left out
    text = re.sub(r"(?<=[A-Z])\.\.\.", "", text)  # SCENE...: one scene or several
    try:
        variants = itertools.product(*(word.split("|") for word in shlex.split(text)))
        return next((error for words in variants if (error := _error_of(list(words), is_line))), "")
    except (ValueError, InputError) as error:
        return str(error)


def _error_of(words: list[str], is_line: bool) -> str:
    top, words, parser, rest = command_of(words)
    commands = commands_of(parser)
    if commands and rest and is_placeholder(rest[0]):  # any command: one of them must fit
        names = words[: len(words) - len(rest)]
        return min((_parse(top, [*names, command, *rest[1:]]) for command in commands), key=len)
    if "..." in rest or (not is_line and all(word.startswith("-") for word in rest)):
        if commands and rest and rest[0] != "..." and not rest[0].startswith("-"):
            return f"there is no command {rest[0]}"
        if any(action.nargs == argparse.REMAINDER for action in parser._actions):
            return ""  # `claims NAME --seeds N`: of any claim
        options = [word.partition("=")[0] for word in rest if word.startswith("--")]
        return ", ".join(f"there is no {option}" for option in options if option not in parser._option_string_actions)
    error = _parse(top, words)
    if words[-1:] == [VALUE] and error:  # an f-string's part, which may be further options
        return _parse(top, words[:-1])
    return error


def _parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> str:
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
        try:
            parser.parse_args(words)
        except SystemExit as end:
            return said.getvalue().splitlines()[-1] if end.code else ""
    return ""


# Where quotes are

CALL = re.compile(r"(?<![\w-])(?:minisplat-ref +|python3? -m (?:minisplat_ref +|(?=data_tools\.)))([a-z].*)")
BEFORE_LINE = re.compile(r"([\w ]+:|[$!]|\S+/)?")  # the command is the whole line: after `example:`, a prompt, a folder
BLOCK = re.compile(r"^ *```\w*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<!`)(`{1,2})(?!`)((?:[^`\n]|\n(?! *\n))+)\1(?!`)")


def quotes_of(text: str) -> Iterator[tuple[str, bool]]:
    """Return the commands in a text, and of each whether it is a line."""
    text = re.sub(r" *\\\n\s*", " ", text)  # lines that are continued
    for block in BLOCK.findall(text):
        for line in re.split(r"\n|&&", block):
            if call := CALL.search(line):
                yield _without_comment(call[1]), True
    text = BLOCK.sub("", text)
    for _, code in INLINE.findall(text):
        for part in " ".join(code.split()).split("&&"):
            if call := CALL.search(part):
                yield call[1].strip(), False
            elif re.match(r"[\w-]+ +[\w.[-]", part) and part.split()[0] in COMMANDS:
                yield part.strip(), False
    for line in INLINE.sub("", text).splitlines():
        if call := CALL.search(line):
            before = line[: call.start()].strip()
            is_line = BEFORE_LINE.fullmatch(before) is not None and bool(before or "\n" in text.strip())
            yield (_without_comment if is_line else _without_sentence)(call[1]), is_line


def _without_comment(text: str) -> str:
    return text.partition(" #")[0].strip()


def _without_sentence(text: str) -> str:
    """Return the command with which a part of a sentence begins; it ends before a word that it has no place for."""
    words = re.split(r"[;)]|[.,:](?= |$)", text)[0].split()
    try:
        command = command_of(words)
    except InputError:
        return " ".join(words)
    begin = len(words) - len(command.rest) + bool(commands_of(command.parser))
    for i in range(begin, len(words)):
        if re.fullmatch("[a-z]+", words[i]) and not words[i - 1].startswith("--"):
            return " ".join(words[:i])
    return " ".join(words)


def in_pages() -> Iterator[Quote]:
    """Return the quotes of the documentation."""
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))):
        for text, is_line in quotes_of(page.read_text(encoding="utf-8")):
            if RETIRED.get(page.name, "\n") not in text:
                yield Quote(page.relative_to(ROOT).as_posix(), text, is_line)


def in_changes() -> Iterator[Quote]:
    """Return the quotes of what is not released yet, as fragments: it names what is new and leaves out the rest."""
    _, found, after = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").partition("\n## [Unreleased]\n")
    assert found, "CHANGELOG.md has no section Unreleased"
    for text, _ in quotes_of(after.partition("\n## ")[0]):
        yield Quote("CHANGELOG.md", f"{text} ...", False)


def in_notebooks() -> Iterator[Quote]:
    """Return the quotes of notebooks' texts and of lines for the shell."""
    for file in sorted(ROOT.glob("notebooks/*.py")):
        text = re.sub(r"^# ?", "", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
        for quote in quotes_of(text):
            yield Quote(file.name, *quote)


def in_strings() -> Iterator[Quote]:
    """Return the quotes of docstrings, messages and other strings of the program and of scripts."""
    for file in sorted([*ROOT.glob("minisplat_ref/**/*.py"), *ROOT.glob("data_tools/**/*.py")]):
        for line, text in strings_of(ast.parse(file.read_text(encoding="utf-8"))):
            for quote in quotes_of(text):
                yield Quote(f"{file.relative_to(ROOT).as_posix()}:{line}", *quote)


def strings_of(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Return the strings of a module with the lines on which they begin."""
    parts = set()
    for node in ast.walk(tree):  # a formatted string precedes its parts
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            yield node.lineno, "".join(part.value if isinstance(part, ast.Constant) else VALUE for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            yield node.lineno, node.value


def in_help() -> Iterator[Quote]:
    """Return the quotes of what ``--help`` of all commands, of all extensions' commands and claims prints."""
    extensions = [load_extension(name) for name in folders()]
    firsts = ["", *(each.name for each in extensions if each.commands)]
    parsers = [reader_of(first, "").parser for first in firsts] + [
        reader_of("claims", name).parser for name in all_claims()
    ]
    for parser in parsers:  # also those that are added on the way
        parsers += commands_of(parser).values()
        for text in (parser.usage, parser.description, parser.epilog, *(action.help for action in parser._actions)):
            for quote in quotes_of(text or ""):
                yield Quote(f"{parser.prog} --help", *quote)


SOURCES = {in_pages: 250, in_changes: 0, in_notebooks: 15, in_strings: 350, in_help: 150}
"""How many commands are found in each, at least; a release leaves no changes."""


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.__name__)
def test_quoted_commands_can_be_typed(source):
    quotes = list(source())
    assert len(quotes) >= SOURCES[source]
    wrong = [f"{place}: {text}: {error}" for place, text, is_line in quotes if (error := compute_error(text, is_line))]
    assert not wrong, "\n" + "\n".join(wrong)


def test_scripts_are_quoted():
    assert len({text.split()[0] for _, text, _ in in_pages() if text.startswith("data_tools.")}) >= 8


@pytest.mark.parametrize("name", folders())
def test_extensions_prints_commands_that_exist(name, capsys):
    assert cli.main(["extensions", name]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("commands ")]
    quoted = [each for row in rows for each in re.findall(r"minisplat-ref ([^,]+)", row)]
    assert len(quoted) >= len(load_extension(name).commands)
    assert [(each, error) for each in quoted if (error := compute_error(each))] == []


@pytest.mark.parametrize(
    ("text", "is_line"),
    [
        ("train", False),
        ("train --view", False),
        ("train SCENE --recipe NAME [--no-such-option]", True),
        ("train --resume ... --iterations N", False),
        ("claims folds", False),
        ("claims folds fox banana --out DIR", True),
        ("data_tools.claims velocity/motion --seed S", True),
        ("claims NAME --workers N", False),
        ("oracle CHECK --report FILE.html", False),
        ("render RUN --map albedo|normal --workers N", True),
        ("compare SCENE --recipes A,B --out DIR --cluster tcp://HOST:PORT", True),
        ("simplify {} --out NEW {}", True),
        ("data_tools.sfm PHOTOS --out SCENE", True),
        ("data_tools.machine large|memory", True),
        ("data_tools.commit_subject FILE", True),
    ],
)
def test_right_quotes(text, is_line):
    assert compute_error(text, is_line) == ""


@pytest.mark.parametrize(
    ("text", "is_line", "error"),
    [
        ("trian SCENE", False, "invalid choice: 'trian'"),
        ("train SCENE --recipe NAME --no-such-option", False, "unrecognized arguments: --no-such-option"),
        ("train --veiw", False, "there is no --veiw"),
        ("train ... --veiw", False, "there is no --veiw"),
        ("train SCENE --blocks 2by2", False, "--blocks"),
        ("train SCENE --profile inrai", False, "invalid choice: 'INRAI'"),
        ("claims fodls", False, "there is no claim 'fodls'"),
        ("claims folds", True, "required: SCENE, --out"),
        ("data_tools.claims folds fox", False, "required: --out"),
        ("claims folds --seeds 0", False, "required: SCENE, --out"),
        ("claims velocity/motoin", False, "there is no claim 'velocity/motoin'"),
        ("oracle gradient", False, "invalid choice: 'gradient'"),
        ("oracle gradient ...", False, "there is no command gradient"),
        ("oracle CHECK --raport FILE.html", False, "--raport"),
        ("render RUN --map albedo --workers three", False, "three"),
        ("textured fine_tune", False, "invalid choice: 'fine_tune'"),
        ("textured fine-tune SCENE", False, "required: PLY, --out"),
        ("analytic fuse", False, "has no commands"),
        ("data_tools.no_such_script", False, "there is no data_tools.no_such_script"),
        ("data_tools.sources", False, "nothing parses"),
        ("data_tools.machine largest", False, "invalid choice: 'largest'"),
        ("data_tools.sfm PHOTOS", True, "required: --out"),
        ("data_tools.survey --worker 2", True, "unrecognized arguments: --worker 2"),
    ],
)
def test_wrong_quotes(text, is_line, error):
    assert error in compute_error(text, is_line)


def test_where_a_text_has_quotes():
    text = """\
Run `train SCENE\n--view`, ``minisplat-ref data`` or `python -m data_tools.sfm`, not `train`, `view = 1` or `a train`.

A sentence has minisplat-ref train --resume RUN as a part; minisplat-ref data NAME fetches one.
Write it with: minisplat-ref oracle export DIR

    minisplat-ref info RUN    # a comment
    minisplat-ref train SCENE \\
        --view

```
new/bin/minisplat-ref bench && new/bin/minisplat-ref oracle truth
```
"""
    lines = ["bench", "oracle truth", "oracle export DIR", "info RUN", "train SCENE --view"]
    assert [quote for quote, is_line in quotes_of(text) if is_line] == lines
    others = ["train SCENE --view", "data", "data_tools.sfm", "train --resume RUN"]
    assert [quote for quote, is_line in quotes_of(text) if not is_line] == others
