"""What every extension of the package promises, found by its folder: no list names them."""

import argparse
import ast
import inspect
from importlib import import_module

import pytest

from minisplat_ref.cli import main
from minisplat_ref.extensions import folders, module_of, summaries
from minisplat_ref.extensions.extension import Extension, load_extension
from minisplat_ref.training.schedule import describe

POSITIONAL_MAX = 8
COLUMNS_MAX = 80
NAMES = list(folders())
FILES = [(name, path) for name, folder in folders().items() for path in sorted(folder.rglob("*.py"))]


def label(value):
    return value if isinstance(value, str) else value.name


def test_there_are_some():
    assert {"geometry", "velocity"} <= set(NAMES) and len(FILES) > len(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_an_extension_of_its_folders_name(name):
    extension = load_extension(name)
    assert isinstance(extension, Extension) and extension.name == name
    assert any((extension.recipes, extension.losses, extension.commands, extension.studies, extension.formats))


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
    """This holds for the extension's commands and for its studies."""
    monkeypatch.setenv("COLUMNS", "80")
    extension = load_extension(name)
    lines = [[name]] if extension.commands else []
    lines += [[name, command] for command in command_names(extension)]
    lines += [["study", f"{name}/{study.name}"] for study in extension.studies]
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


@pytest.mark.parametrize(("name", "path"), FILES, ids=label)
def test_it_imports_no_other_extension(name, path):
    ours = "minisplat_ref.extensions"
    allowed = (f"{ours}.{name.replace('-', '_')}", f"{ours}.extension", f"{ours}.shared_")
    for module in imported_modules(path):
        if module == ours or module.startswith(f"{ours}."):
            assert module.startswith(allowed), f"{path} imports {module}"


@pytest.mark.parametrize(("name", "path"), FILES, ids=label)
def test_every_file_is_documented_and_its_functions_take_few_arguments(name, path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            n_positional = len(node.args.posonlyargs) + len(node.args.args)
            assert n_positional <= POSITIONAL_MAX, f"{path}: {node.name} takes {n_positional} positional arguments"


def imported_modules(path):
    """Whole names of what a file imports; of ``from a import b`` it is ``a.b``, be b a module or a function."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively: write the whole name"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_check_of_imports_sees_imports(tmp_path):
    path = tmp_path / "file.py"
    path.write_text("import a.b\nfrom minisplat_ref.extensions import velocity as v\n\ndef f():\n    from c import d\n")
    assert list(imported_modules(path)) == ["a.b", "minisplat_ref.extensions.velocity", "c.d"]
