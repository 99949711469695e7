"""The page of the notebooks, ``notebooks/README.md``: their titles, and links that open them in Colab and Binder.

The links are made from the address of the repository, ``Repository`` in ``[project.urls]`` of ``pyproject.toml``. Colab
and Binder take notebooks from public repositories on GitHub: as long as no such address is there, the page has none.

    python -m data_tools.notebook_page            # write the page
    python -m data_tools.notebook_page --check    # exit with 1 where it differs
"""

import argparse
import re
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import quote

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "notebooks" / "README.md"
BRANCH = "main"
GITHUB = re.compile(r"https://github\.com/([\w.-]+/[\w.-]+?)(?:\.git)?/?")

INTRODUCTION = """\
# Notebooks

Made by `python -m data_tools.notebook_page`. The notebooks are stored with their outputs and can be read without being
run. To run them, `pip install -e '.[notebooks]'` and then `jupyter lab notebooks`. Notebook 05 then has sliders.
"""
ELSEWHERE = """\
Binder installs the program by itself. In Colab, run this before the first cell:

```
!git clone --quiet https://github.com/{repository} && pip install --quiet './{name}[notebooks]'
%cd {name}/notebooks
```
"""


def page(texts: Mapping[str, str], urls: Mapping[str, str]) -> str:
    """Return the page.

    Parameters
    ----------
    texts : mapping
        Text of each notebook by its name.
    urls : mapping
        ``[project.urls]``.
    """
    repository = repository_of(urls)
    heading = ["notebook", *(("open in",) if repository else ())]
    lines = [f"| {' | '.join(heading)} |", "|" + " --- |" * len(heading)]
    for name, text in sorted(texts.items()):
        cells = [f"[{title_of(name, text)}]({name}.ipynb)"]
        if repository:
            cells.append(f"[Colab]({colab(repository, name)}), [Binder]({binder(repository, name)})")
        lines.append(f"| {' | '.join(cells)} |")
    parts = [INTRODUCTION, "\n".join(lines) + "\n"]
    if repository:
        parts.append(ELSEWHERE.format(repository=repository, name=repository.partition("/")[2]))
    return "\n".join(parts)


def repository_of(urls: Mapping[str, str]) -> str | None:
    """Return ``owner/name`` of a repository on GitHub; None where no address is given, or one elsewhere."""
    found = GITHUB.fullmatch(urls.get("Repository", ""))
    return found[1] if found else None


def colab(repository: str, name: str) -> str:
    """Return the address at which Colab opens a notebook."""
    return f"https://colab.research.google.com/github/{repository}/blob/{BRANCH}/notebooks/{name}.ipynb"


def binder(repository: str, name: str) -> str:
    """Return the address at which Binder opens a notebook."""
    return f"https://mybinder.org/v2/gh/{repository}/{BRANCH}?labpath={quote(f'notebooks/{name}.ipynb', safe='')}"


def title_of(name: str, text: str) -> str:
    """Return the first headline of a notebook."""
    found = re.search(r"^# # (.+)$", text, re.MULTILINE)
    if found is None:
        raise ValueError(f"{name}.py has no headline")
    return found[1]


def main(argv: list[str] | None = None) -> int:
    """Write the page, or check that nothing would change."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.notebook_page", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 where the page differs")
    args = parser.parse_args(argv)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = {path.stem: path.read_text(encoding="utf-8") for path in PAGE.parent.glob("[0-9]*.py")}
    new = page(texts, project["urls"])
    if PAGE.exists() and PAGE.read_text(encoding="utf-8") == new:
        return 0
    if not args.check:
        PAGE.write_text(new, encoding="utf-8")
    print(f"{PAGE.relative_to(ROOT)}: {'differs: python -m data_tools.notebook_page' if args.check else 'written'}")
    return int(args.check)


if __name__ == "__main__":
    sys.exit(main())
