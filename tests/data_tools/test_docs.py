"""The README and the pages of docs/: what they name exists, and they show what the code says.

Commands that they quote are checked by ``test_quoted_commands.py``.
"""

import re
import tomllib
from pathlib import Path

from minisplat_ref.extensions import folders
from minisplat_ref.extensions.extension import load_extension

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]
EXAMPLES = {"images/", "mine/round/__init__.py", "my_renderer/__init__.py", "tests/test_oracle.py"}  # of a user


def inline_code_of(page):
    prose = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"`([^`\n]+)`", prose)


def test_paths_exist():
    """A path begins at the root, in the package, in its extensions or mechanisms, or beside the page."""
    places = (ROOT, ROOT / "docs", *(ROOT / "minisplat_ref" / name for name in ("", "extensions", "mechanisms")))
    named = {
        (page.relative_to(ROOT).as_posix(), code)
        for page in PAGES
        for code in inline_code_of(page)
        if re.fullmatch(r"[\w/]+\.(py|md)|[a-z_/]+/", code)
    }
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


def rows_of_the_family():
    table = (ROOT / "docs" / "FAMILY.md").read_text(encoding="utf-8")
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| [")]


def test_every_extension_has_a_row_and_a_page_of_the_family():
    rows = rows_of_the_family()
    assert sorted(row[2].strip("`") for row in rows) == sorted(folders())
    assert len(list((ROOT / "docs" / "family").iterdir())) == len(rows)
    for relative, idea, extension, recipes, _, notebook in rows:
        name = extension.strip("`")
        assert relative.endswith(f"](family/{name}.md)") and len(idea.split()) <= 12
        assert recipes == ", ".join(f"`{recipe.name}`" for recipe in load_extension(name).recipes)
        page = (ROOT / "docs" / "family" / f"{name}.md").read_text(encoding="utf-8")
        assert page.partition("\n")[0].endswith(f" ({extension})")
        assert f"[notebook {notebook}](" in page or not notebook
        assert all(f"- **{word}.**" in page for word in ("Measured", "Difference")) or "**Claim.**" not in page


def test_headline_figures_of_the_family_are_on_its_pages():
    for _, _, extension, _, headline, _ in rows_of_the_family():
        page = (ROOT / "docs" / "family" / f"{extension.strip('`')}.md").read_text(encoding="utf-8")
        named = re.sub("`[^`]*`", "", headline)  # but for those in names, such as `3dgs-accel`
        figures = set(re.findall(r"[\d.,]*\d(?:e-\d+)?", named))
        assert figures and figures <= set(re.findall(r"[\d.,]*\d(?:e-\d+)?", page))
