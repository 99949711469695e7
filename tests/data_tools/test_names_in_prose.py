"""Names that prose puts in backticks exist: in docstrings, comments, the text of notebooks and the pages of docs/.

A name is an identifier with an underscore, or one that is called. Symbols of formulas, such as ``w_i`` and ``x_file``,
are not names. A role such as ``:func:`.hits.is_accepted``` must lead to a module or into one, from where it stands. All
is read from the sources and nothing is imported, so that modules count whose packages are not installed.
"""

import ast
import builtins
import re
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.util import resolve_name
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SOURCES = [path for top in ("minisplat_ref", "data_tools") for path in sorted((ROOT / top).rglob("*.py"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
OF_FORMULAS = {"Im", "MAR", "Re", "adj", "arsinh", "ln", "softmax", "sum_cuv"}  # and no names of code
OF_OTHERS = {
    "SPZ_ADOBE_coordinate_system",  # a record of an SPZ
    "_torch_impl_2dgs",  # gsplat's module
    "aabb_scale",  # a key of instant-ngp
    "applied_transform",  # a key of Nerfstudio
    "banana_blender",  # a scene of the measurements
    "dataset_readers",  # a module of 3DGS's release
    "declare_intrinsic",  # llvmlite's function
    "function_vjp",  # of the user: the gradient of any function
    "setDrawRange",  # a function of three.js
    "transforms_distorted",  # a file of the scene fox
    "vec2",  # a type of GLSL
}

ROLE = re.compile(r":(?:func|class|mod|data|attr|meth):`~?([^`]+)`")
COMMENT = re.compile(r"(?:^ *|  )# ?(.*)$")
CODE = re.compile(r"(?<![`\w])(``|`)(?!`)((?:(?!\n *\n).)+?)(?<!`)\1(?!`)", re.DOTALL)
WORD = re.compile(r"(?<![\w\\-])([A-Za-z_]\w*)(?![\w-])(\()?")
INDEX = re.compile(r"(?!at|by|in|of|on|to)[A-Za-z0-9]{1,2}|\d+|[A-Z]+")


class Text(NamedTuple):
    """Prose, and where it stands."""

    place: str
    text: str
    module: str | None = None
    """Path of the module whose docstring or comment it is."""
    owner: ast.ClassDef | None = None
    """The class around it."""


# Prose


def texts_of_source(path: Path) -> Iterator[Text]:
    """Yield the docstrings and the comments of a source file."""
    place, module, tree = path.relative_to(ROOT).as_posix(), module_of(path), tree_of(path)

    def docstrings(node: ast.AST, owner: ast.ClassDef | None) -> Iterator[Text]:
        for child in getattr(node, "body", ()):
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant):
                yield Text(f"{place}:{child.lineno}", str(child.value.value), module, owner)
            yield from docstrings(child, child if isinstance(child, ast.ClassDef) else owner)

    yield from docstrings(tree, None)
    for line, text in comments(path.read_text(encoding="utf-8"), tree):
        yield Text(f"{place}:{line}", text, module)


def comments(source: str, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the comments of a source with their first lines; lines of comments that follow one another are one."""
    strings = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    quoted = {line for node in strings for line in range(node.lineno, node.end_lineno or 0)}
    first, lines = 0, []
    for number, line in enumerate([*source.splitlines(), ""], 1):
        match = None if number in quoted else COMMENT.search(line)
        is_continued = match is not None and line.lstrip().startswith("#")
        if lines and not is_continued:
            yield first, "\n".join(lines)
            lines = []
        if match is not None:
            first = first if lines else number
            lines.append(match[1])


def texts_of_notebook(path: Path) -> Iterator[Text]:
    """Yield the cells of text of a notebook."""
    for cell in re.split(r"^# %%", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        if cell.startswith(" [markdown]"):
            text = "\n".join(line.removeprefix("#").removeprefix(" ") for line in cell.splitlines()[1:])
            yield Text(path.name, without_blocks(text))


def texts_of_page(path: Path) -> Iterator[Text]:
    """Yield the prose of a page."""
    yield Text(path.name, without_blocks(path.read_text(encoding="utf-8")))


def without_blocks(text: str) -> str:
    """Return Markdown without its blocks of code and its formulas."""
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"\$\$.*?\$\$|\$[^$`]+\$", "", text, flags=re.DOTALL)


# Names


def unknown_names(text: str) -> set[str]:
    """Return the names in backticks that exist nowhere."""
    words = (word for match in CODE.finditer(ROLE.sub("", text)) for word in WORD.finditer(match[2]))
    names = ((word[1].removeprefix("v_"), bool(word[2])) for word in words)  # v_x is the gradient with respect to x
    return {name for name, is_called in names if is_name(name, is_called=is_called)} - known_names()


def is_name(word: str, *, is_called: bool) -> bool:
    """Return whether a word is a name: no symbol of a formula, and no pattern for names, such as ``min_NAME_gain``."""
    first, *parts = word.strip("_").split("_")
    if not parts:
        return is_called and len(word) > 1
    if "NAME" in (first, *parts):
        return False
    return any(not INDEX.fullmatch(part) for part in parts) and (len(first) > 1 or first == "n")


@cache
def known_names() -> frozenset[str]:
    """Return the identifiers of the repository, the keys and the names of its files, and NumPy's and Python's."""
    names = {*dir(builtins), *dir(np), *OF_FORMULAS, *OF_OTHERS}
    for path in (*SOURCES, *NOTEBOOKS, *(ROOT / "docs").rglob("*.py")):
        names |= identifiers_of(tree_of(path))
    for path in (ROOT / "tests").rglob("*.py"):
        names |= {*re.findall(r"^ *(?:def|class) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)}
    for top in ("minisplat_ref", "data_tools", "tests", "notebooks", "docs"):
        for path in (ROOT / top).rglob("*"):
            names |= {*words(path.relative_to(ROOT).as_posix())}
    for path in (ROOT / "pyproject.toml", *(ROOT / "minisplat_ref").rglob("*.json")):
        names |= {*words(path.read_text(encoding="utf-8"))}
    return frozenset(names)


def words(text: str) -> list[str]:
    return re.findall(r"[A-Za-z_]\w*", text)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


FIELDS = {
    ast.Name: "id",
    ast.Attribute: "attr",
    ast.arg: "arg",
    ast.keyword: "arg",
    ast.alias: "name",
    ast.FunctionDef: "name",
    ast.ClassDef: "name",
    ast.ImportFrom: "module",
}


def identifiers_of(tree: ast.AST) -> set[str]:
    """Return the identifiers of code, and those in its strings without blanks: columns, keys, options and files."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if type(node) in FIELDS:
            names.update((getattr(node, FIELDS[type(node)]) or "").split("."))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " not in node.value:
            names.update(words(node.value.replace("-", "_")))
    return names


# Roles


def leads_nowhere(path: str, module: str | None = None, owner: ast.ClassDef | None = None) -> bool:
    """Return whether a role names no object.

    A path that begins with a dot begins in the package of the module. One of another kind is looked for in the class
    and in the module around it; one without a dot may be that of any definition or argument.
    """
    if path.startswith(".") and module:
        is_package = file_of(module.split(".")).name == "__init__.py"
        path = resolve_name(path, module if is_package else module.rpartition(".")[0])
    parts = path.split(".")
    if parts[0] in ("minisplat_ref", "data_tools"):
        return not is_in_module([], parts)
    if owner and is_in_class(owner, parts, module):
        return False
    return not (module and is_in_module(module.split("."), parts)) and (len(parts) > 1 or path not in known_names())


def is_in_module(module: Sequence[str], parts: Sequence[str]) -> bool:
    """Return whether a path leads from a module, or from the root of all, to a module, a definition or a field."""
    if not parts:
        return True
    file = file_of(module)
    node = definitions(file).get(parts[0]) if file.is_file() else None
    if isinstance(node, ast.ClassDef):
        return is_in_class(node, parts[1:], ".".join(module))
    if isinstance(node, ast.ImportFrom):
        name = next(alias.name for alias in node.names if parts[0] == (alias.asname or alias.name))
        package = module if file.name == "__init__.py" else module[:-1]
        source = resolve_name("." * node.level + (node.module or ""), ".".join(package)).split(".")
        if source[0] not in ("minisplat_ref", "data_tools"):
            return len(parts) == 1
        if source != list(module):
            return is_in_module(source, [name, *parts[1:]])
    elif node is not None:
        return True
    is_found = file_of([*module, parts[0]]).exists()
    return is_found and is_in_module([*module, parts[0]], parts[1:])


def is_in_class(node: ast.ClassDef, parts: Sequence[str], module: str | None) -> bool:
    """Return whether a class, one of its bases, or one of its methods on ``self`` has a name."""
    if not parts:
        return True
    own = {name for child in ast.walk(node) for name in names_bound_by(child)}
    own |= {child.attr for child in ast.walk(node) if isinstance(child, ast.Attribute)}
    bases = [base.id for base in node.bases if isinstance(base, ast.Name)]
    return parts[0] in own or any(module and is_in_module(module.split("."), [base, *parts]) for base in bases)


def file_of(parts: Sequence[str]) -> Path:
    """Return the file of a module, or the folder that it would be in."""
    path = ROOT.joinpath(*parts)
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), path)


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def definitions(path: Path) -> dict[str, ast.AST]:
    """Return what the statements of a module define, those in conditions included, by name."""
    found: dict[str, ast.AST] = {}

    def visit(nodes: Sequence[ast.AST]) -> None:
        for node in nodes:
            found.update(dict.fromkeys(names_bound_by(node), node))
            if isinstance(node, ast.If | ast.Try | ast.With):
                visit([child for child in ast.iter_child_nodes(node) if isinstance(child, ast.stmt)])

    visit(tree_of(path).body)
    return found


def names_bound_by(node: ast.AST) -> list[str]:
    """Return the names that one statement binds."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return [node.name]
    if isinstance(node, ast.Import | ast.ImportFrom):
        return [alias.asname or alias.name.split(".")[0] for alias in node.names]
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    return []


# Tests


@pytest.fixture(scope="module")
def texts() -> list[Text]:
    readers = ((SOURCES, texts_of_source), (NOTEBOOKS, texts_of_notebook), (PAGES, texts_of_page))
    return [text for paths, read in readers for path in paths for text in read(path)]


def test_names_exist(texts):
    missing = {(text.place, name) for text in texts for name in unknown_names(text.text)}
    assert not missing, "\n".join(f"{place}: {name} exists nowhere" for place, name in sorted(missing))


def test_roles_lead_somewhere(texts):
    roles = [(text, path) for text in texts for path in ROLE.findall(text.text)]
    assert len(roles) > 1000
    missing = {(text.place, path) for text, path in roles if leads_nowhere(path, text.module, text.owner)}
    assert not missing, "\n".join(f"{place}: {path} leads nowhere" for place, path in sorted(missing))


def test_every_exception_is_needed(texts):
    named = {word for text in texts for match in CODE.finditer(text.text) for word in words(match[2])}
    assert named >= OF_OTHERS | OF_FORMULAS


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("`sorted_no_more` is gone", {"sorted_no_more"}),
        ("of two words, ``arranged_by``; ``w arranged_by(x)``", {"arranged_by"}),
        ("called: `foobarize(x)`, ``tile.foobarize()``", {"foobarize"}),
        ("a gradient ``v_sorted_no_more``", {"sorted_no_more"}),
        ("across\nlines: ``a = [sorted_no_more,\n  b]``", {"sorted_no_more"}),
        ("``_sorted_no_more``, ``module.sorted_no_more.b``", {"_sorted_no_more", "sorted_no_more"}),
        ("not in backticks: sorted_no_more", set()),
        (
            "formulas: ``w_i = alpha_qi T_i``, ``x_file``, ``Y_lm(d)``, ``v_p_k``, ``f(x)``, ``ln(x)``; ``NAME_on``",
            set(),
        ),
        ("names: ``alpha_min``, `render()`, ``v_means``, ``np.linalg.norm(x)``", set()),
        ("a role has its own check, :func:`.sorted_no_more`; ``n_gaussians``, `test_names_in_prose.py`", set()),
        ("two: ``a`` sorted_no_more ``b``; an end`sorted_no_more`", set()),
    ],
)
def test_unknown_names(text, missing):
    assert unknown_names(text) == missing


@pytest.mark.parametrize(
    ("path", "module"),
    [
        ("minisplat_ref.reference.hits.no_such", None),
        ("minisplat_ref.no_such.hits", None),
        ("minisplat_ref.types.Camera.no_such", None),
        (".no_such", "minisplat_ref.reference"),
        (".hits", "minisplat_ref.strategy"),
        (".reference.hits", "minisplat_ref.reference.loss"),  # its package is `reference`
        ("..hits", "minisplat_ref.reference.loss"),  # two dots are the package of the package
        ("Camera.no_such", "minisplat_ref.reference.projection"),  # imported there
        ("Camera.width", "minisplat_ref.errors"),  # not imported there
        ("no_such", "minisplat_ref.reference.hits"),
    ],
)
def test_roles_that_lead_nowhere(path, module):
    assert leads_nowhere(path, module)


@pytest.mark.parametrize(
    ("path", "module"),
    [
        ("minisplat_ref.reference.hits.conic_hit", None),
        ("minisplat_ref.rendering", None),
        ("minisplat_ref.rendering.render", None),  # the package imports it
        ("minisplat_ref.types.Camera.width", None),
        (".hits", "minisplat_ref.reference"),
        (".hits.conic_hit", "minisplat_ref.reference.loss"),
        ("..strategy", "minisplat_ref.reference.loss"),
        ("Camera.width", "minisplat_ref.reference.projection"),
        ("hits", "minisplat_ref.reference.compositing"),
        ("camera", "minisplat_ref.reference.projection"),  # an argument
    ],
)
def test_roles_that_lead_somewhere(path, module):
    assert not leads_nowhere(path, module)


def test_a_field_of_the_class_around_a_docstring():
    tree = ast.parse("class A:\n  x: int\n  def f(self):\n    self.y = 1")
    assert not leads_nowhere("x", None, tree.body[0]) and not leads_nowhere("y", None, tree.body[0])
    assert leads_nowhere("no_such", None, tree.body[0])


def test_prose_of_a_source():
    source = "# one\n# two\nx = 1  # three\ny = 2  # four\nz = '''\n# none\n'''\n# five\n"
    assert list(comments(source, ast.parse(source))) == [(1, "one\ntwo"), (3, "three"), (4, "four"), (8, "five")]


def test_code_and_formulas_of_a_page_are_no_prose():
    text = "a\n```\ncode\n```\nb $x_y$ c\n$$\nz\n$$\nd"
    assert without_blocks(text).split() == ["a", "b", "c", "d"]
