"""What every extension of the package promises, found by its folder: no list names them."""

import argparse
import inspect
from importlib import import_module

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.extensions import folders, module_of, summaries
from minisplat_ref.extensions.extension import Extension, load_extension
from minisplat_ref.training.schedule import describe

COLUMNS_MAX = 80
NAMES = list(folders())


def test_there_are_some():
    assert {"geometry", "velocity"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_an_extension_of_its_folders_name(name):
    extension = load_extension(name)
    assert isinstance(extension, Extension) and extension.name == name
    assert any((extension.recipes, extension.losses, extension.commands, extension.formats))


@pytest.mark.parametrize("name", NAMES)
def test_its_docstring_says_what_it_is(name):
    """A line that ``minisplat-ref extensions`` shows in a terminal of 100 columns, and more below."""
    first, _, rest = inspect.getdoc(import_module(module_of(name))).partition("\n")
    assert summaries()[name] == first and first.endswith(".") and len(name) + 2 + len(first) <= 100
    assert len(rest) > 100


@pytest.mark.parametrize("name", NAMES)
def test_its_population_begins_with_means_and_its_recipes_can_be_described(name):
    extension = load_extension(name)
    assert extension.representation.population._fields[0] == "means"
    for recipe in extension.recipes:
        assert describe(recipe)["name"] == recipe.name


@pytest.mark.parametrize("name", NAMES)
def test_help_has_an_example_and_fits_a_terminal(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    extension = load_extension(name)
    lines = [[name]] if extension.commands else []
    lines += [[name, command] for command in command_names(extension)]
    for line in lines:
        with pytest.raises(SystemExit) as end:
            main([*line, "--help"])
        text = capsys.readouterr().out
        assert end.value.code == 0 and "example" in text, line
        assert max(map(len, text.splitlines())) <= COLUMNS_MAX, line


def command_names(extension):
    """Return the names under which the commands of an extension are called."""
    commands = argparse.ArgumentParser().add_subparsers()
    for command in extension.commands:
        command.add_parser(commands)
    return list(commands.choices)
