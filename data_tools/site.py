"""Hooks of MkDocs: pages that are made while the site is built, and links that lead out of ``docs/``.

The README, CONTRIBUTING, the changelog and the notebooks are pages of the site, too. On a code host, a link to a file
that is no page leads to that file; on the site it becomes the path of the file, or leads to the API page of its module.
"""

import os
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_tools.site_notebooks import FOLDER, convert_notebook, formulas_in_mathml

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
FROM_ROOT = {
    "index.md": "README.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
    f"{FOLDER}/index.md": f"{FOLDER}/README.md",
}
NOTEBOOKS = {f"{FOLDER}/{path.stem}.md": path for path in sorted((ROOT / FOLDER).glob("[0-9]*.ipynb"))}
API = {
    "types": ("Types and constants", ("minisplat_ref.types", "minisplat_ref.constants", "minisplat_ref.errors")),
    "rendering": (
        "Rendering",
        (
            "minisplat_ref.rendering",
            "minisplat_ref.rendering.splatting",
            "minisplat_ref.rendering.backends",
            "minisplat_ref.rendering.stages",
        ),
    ),
    "gsplat_compat": ("gsplat's call", ("minisplat_ref.gsplat.call", "minisplat_ref.gsplat.arguments")),
    "reference": ("The reference", ("minisplat_ref.reference",)),
    "strategy": ("Density control", ("minisplat_ref.strategy",)),
    "training": ("Training", ("minisplat_ref.training",)),
    "methods": ("Recipes", ("minisplat_ref.methods",)),
    "metrics": ("Metrics", ("minisplat_ref.metrics", "minisplat_ref.metrics.lpips")),
    "io": ("Files", ("minisplat_ref.io",)),
    "extensions": ("Extensions", ("minisplat_ref.extensions.extension",)),
}
"""Pages of the API reference: title, and the packages whose docstrings stand there."""

FENCES = ("```", "~~~")
ITEM = re.compile(r"(?:[-*+]|\d+[.)]) +(?=\S)")
CELL = re.compile(r"<td\b.*?</td>", re.DOTALL)
LONG_NAME = re.compile(r"(?<=<code>)[^<\s]{16,}(?=</code>)")
COMMIT = re.compile(r"/([\w.-]+)@(?=[0-9a-f]{7}\b)(?![^<>]*>)")  # and not in a link's address
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def on_config(config: "MkDocsConfig") -> "MkDocsConfig":
    """List the pages that ``nav`` names by a pattern: those of the family in the order of its table, all notebooks."""
    family = re.findall(r"\]\((family/[\w-]+\.md)\)", (ROOT / "docs" / "FAMILY.md").read_text(encoding="utf-8"))
    config.nav = _expand(config.nav or [], {"family/*.md": family, f"{FOLDER}/*.md": list(NOTEBOOKS)})
    return config


def _expand(entries: list[Any], pages: dict[str, list[str]]) -> list[Any]:
    expanded: list[Any] = []
    for entry in entries:
        if isinstance(entry, str):
            expanded += pages.get(entry, [entry])
        else:
            expanded.append({k: _expand(v, pages) if isinstance(v, list) else v for k, v in entry.items()})
    return expanded


def on_files(files: "Files", config: "MkDocsConfig") -> "Files":
    """Add the pages that have no file in ``docs/``."""
    from mkdocs.structure.files import File

    for page, source in FROM_ROOT.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    files.append(File.generated(config, "api/index.md", content=_public_names()))
    for name, (title, modules) in API.items():
        text = "\n\n".join([f"# {title}", *(f"::: {module}" for module in modules)])
        files.append(File.generated(config, f"api/{name}.md", content=text))
    for page, path in NOTEBOOKS.items():
        text, images = convert_notebook(path)
        files.append(File.generated(config, page, content=text))
        for name, data in images.items():
            files.append(File.generated(config, f"{FOLDER}/{name}", content=data))
    return files


def _public_names() -> str:
    """Return the page of what ``import minisplat_ref as ms`` gives, each name with a link to where it is explained."""
    import minisplat_ref

    names = [
        f"| [`ms.{name}`][{module}.{name}] | `{module}` |"
        for module, names in minisplat_ref._MODULES.items()
        for name in names
    ]
    introduction = (
        "What `import minisplat_ref as ms` gives, and the module of each name. All else is reached by modules."
    )
    return "\n".join(["# The package", "", introduction, "", "| name | module |", "|---|---|", *names])


def on_page_markdown(markdown: str, *, page: "Page", files: "Files", **_: Any) -> str:
    """Let every link lead to a page of the site, or name the file of the repository that it leads to."""
    uri = page.file.src_uri
    in_repository = f"{FOLDER}/" if uri in NOTEBOOKS else FROM_ROOT.get(uri, f"docs/{uri}")

    def change(match: re.Match[str]) -> str:
        is_image, text, target, anchor = match[1], match[2], match[3], match[4] or ""
        if ":" in target:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(in_repository), target))
        if not (ROOT / path).exists():
            return match[0]  # MkDocs says that it is broken
        for destination in _pages_of(path):
            if files.get_file_from_path(destination) is not None:
                relative = posixpath.relpath(destination, posixpath.dirname(uri) or ".")
                return f"{is_image}[{text}]({relative}{anchor})"
        name = text.strip("`").rstrip("/")
        return f"`{path}`" if path.endswith(name) else f"{text} (`{path}`)"

    return indent_lists(LINK.sub(change, markdown))


def indent_lists(markdown: str) -> str:
    """Return Markdown in which what belongs to an item of a list is indented by four columns, for Python-Markdown.

    On a code host it is indented as far as the text of the item, which is two columns after a bullet.
    """
    lines: list[str] = []
    columns: list[int] = []  # of the texts of the items that a line is in
    fence = ""
    for line in markdown.split("\n"):
        text = line.lstrip(" ")
        indent = len(line) - len(text)
        if fence:
            fence = "" if text.startswith(fence) else fence
        else:
            while text and columns and indent < columns[-1]:
                columns.pop()
            fence = text[:3] if text[:3] in FENCES else ""
        lines.append(" " * (4 * len(columns) + max(indent - (columns or [0])[-1], 0)) + text if text else "")
        if not fence and (marker := ITEM.match(text)):
            columns.append(indent + len(marker[0]))
    return "\n".join(lines)


def on_page_content(html: str, **_: Any) -> str:
    """Make formulas MathML, and say where lines of a table's cell may end."""
    return CELL.sub(lambda cell: wrap_cell(cell[0]), formulas_in_mathml(html))


def wrap_cell(html: str) -> str:
    """Return a cell in which a line may end within a long name, and not before a deviation.

    It may end at a point, a slash or an underscore, and in the name of a commit, ``owner/repository@0123abc``.
    """
    html = html.replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    html = COMMIT.sub(r"/<wbr>\1<wbr>@", html)
    return LONG_NAME.sub(lambda name: re.sub(r"(?<=[\w\])])[./,=_](?=\w)", r"\g<0><wbr>", name[0]), html)


def _pages_of(path: str) -> list[str]:
    """Return where a file of the repository may stand on the site, the best place first."""
    pages = [page for page, source in FROM_ROOT.items() if source == path]
    if path.startswith("docs/"):
        pages.append(path.removeprefix("docs/"))
    if path.startswith(f"{FOLDER}/"):
        pages.append(path.replace(".ipynb", ".md"))
    if path == "docs/measured":
        pages.append("measured/training.md")
    module = os.path.splitext(path)[0].replace("/", ".")
    pages += [f"api/{name}.md" for name, (_, modules) in API.items() if _is_below(module, modules)]
    return pages


def _is_below(module: str, packages: tuple[str, ...]) -> bool:
    return any(module == package or module.startswith(f"{package}.") for package in packages)
