"""The README and the pages of docs/: what they name exists, and they show what the code says."""

import argparse
import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

from minisplat_ref.cli import _parser_of
from minisplat_ref.extensions import folders
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.studies import all_studies

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
RETIRED = re.compile(r"study split |.*--candidates")  # the pages name the commit that still has them
EXAMPLES = {"images/", "mine/faint/__init__.py", "my_renderer/__init__.py", "tests/test_oracle.py"}  # of a user


def code_of(text):
    """Code of a page: calls of the program in blocks, without comments, and inline code."""
    blocks = re.findall(r"^ *```(\w*)\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    calls = [line for _, block in blocks for line in block.splitlines() if "minisplat-ref " in line]
    prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return [line.partition(" #")[0].strip() for line in calls] + re.findall(r"`([^`\n]+)`", prose)


CODE = [
    (page.relative_to(ROOT).as_posix(), code) for page in PAGES for code in code_of(page.read_text(encoding="utf-8"))
]


def choices_of(parser):
    """Return the parsers of a parser's commands by name; {} where there are none."""
    return next((a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)), {})


COMMANDS = choices_of(_parser_of(()))


def named_commands():
    """Return each command as words, with its page; inline code may leave out ``minisplat-ref``."""
    for page, code in CODE:
        is_whole = re.search(r"(?:^|[ /])minisplat-ref +(?=[a-z])(?!.*&& +[^ ]*minisplat-ref)", code)
        words = (code[is_whole.end() :] if is_whole else code).partition("&&")[0].split()
        if is_whole or (len(words) > 1 and words[0] in {*COMMANDS, *folders()} and not RETIRED.match(code)):
            yield pytest.param(words, id=f"{page}: {' '.join(words)}")


@pytest.mark.parametrize("words", list(named_commands()))
def test_commands_and_their_options_exist(words):
    parser, rest = _parser_of(words), words
    while choices := choices_of(parser):
        if rest[0] not in choices:
            assert rest[0].isupper(), f"there is no {rest[0]} in {' '.join(words)}"
            return  # `oracle CHECK`
        parser, *rest = choices[rest[0]], *rest[1:]
        if not rest:
            return
    if words[0] == "study" and rest and rest[0].islower():
        parser = argparse.ArgumentParser()
        find_study(rest[0]).add_arguments(parser)
    for word in rest:
        if word.startswith("--") and parser._option_string_actions:
            assert word in parser._option_string_actions, f"{' '.join(words)}: there is no {word}"


def find_study(name):
    """Return a study by the name that a user types."""
    extension, _, own = name.rpartition("/")
    studies = {study.name: study for study in load_extension(extension).studies} if extension else all_studies()
    return studies[own]


def test_scripts_exist():
    named = {(page, name) for page, code in CODE for name in re.findall(r"python -m (data_tools\.\w+)", code)}
    assert len(named) >= 8
    assert {(page, name) for page, name in named if not importlib.util.find_spec(name)} == set()


def test_paths_exist():
    """A path begins at the root, in the package, in its extensions or mechanisms, or beside the page."""
    places = (ROOT, ROOT / "docs", *(ROOT / "minisplat_ref" / name for name in ("", "extensions", "mechanisms")))
    named = {(page, code) for page, code in CODE if re.fullmatch(r"[\w/]+\.(py|md)|[a-z_/]+/", code)}
    assert len(named) >= 100
    missing = {(page, path) for page, path in named if not any((place / path).exists() for place in places)}
    assert {(page, path) for page, path in missing if path not in EXAMPLES} == set()


def test_layers_are_those_of_the_import_check():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    page = (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")
    block = re.search(r"## Layers.*?```\n(.*?)```", page, re.DOTALL)[1]
    shown = [line.partition("   ")[0].split() for line in block.splitlines()]
    assert shown == [re.findall(r"\w+", row) for row in rows if row != "__main__"]


def test_every_extension_has_a_row_and_a_section_of_the_family():
    page = (ROOT / "docs" / "FAMILY.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## .*\(`([\w-]+)`\)$", page, re.MULTILINE)
    rows = [line.split("|")[1:-1] for line in page.splitlines() if line.startswith("| [")]
    assert sorted(sections) == sorted(folders())
    for name, (system, _, idea, _) in zip(sections, rows, strict=True):
        assert system.strip().endswith(f"-{name})") and len(idea.split()) <= 12
        text = page.partition(f"(`{name}`)\n")[2].partition("\n## ")[0]
        assert all(f"- **{word}.**" in text for word in ("Measured", "Difference")) or "**Claim.**" not in text
