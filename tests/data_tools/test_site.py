"""The documentation: links that lead out of docs/, and docstrings in Markdown."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from data_tools import readme_figure, site
from minisplat_ref.errors import InputError

ROOT = Path(__file__).parents[2]
needs_notebooks = pytest.mark.skipif(
    (ROOT / "PKG-INFO").exists(), reason="a source distribution has no stored notebooks"
)
PAGES = {"index.md", "CONTRIBUTING.md", "GUIDE.md", "EXTENDING.md", "measured/speed.md", "measured/training.md"} | {
    f"api/{name}.md" for name in site.API
}


def on_site(markdown, page):
    """What becomes of the text of a page."""
    files = SimpleNamespace(get_file_from_path=lambda uri: uri if uri in PAGES else None)
    return site.on_page_markdown(markdown, page=SimpleNamespace(file=SimpleNamespace(src_uri=page)), files=files)


@pytest.mark.parametrize(
    ("page", "link", "expected"),
    [
        ("index.md", "[guide](docs/GUIDE.md#training)", "[guide](GUIDE.md#training)"),
        ("index.md", "[all](docs/measured/)", "[all](measured/training.md)"),
        ("index.md", "[LICENSE](LICENSE)", "`LICENSE`"),
        pytest.param(
            "index.md",
            "[Notebook 00](notebooks/00_reading_guide.ipynb)",
            "Notebook 00 (`notebooks/00_reading_guide.ipynb`)",
            marks=needs_notebooks,
        ),
        ("EXTENDING.md", "[`hits.py`](../minisplat_ref/reference/hits.py)", "[`hits.py`](api/reference.md)"),
        ("EXTENDING.md", "[`jit/compile.py`](../minisplat_ref/jit/compile.py)", "`minisplat_ref/jit/compile.py`"),
        ("measured/speed.md", "[guide](../GUIDE.md)", "[guide](../GUIDE.md)"),
        ("GUIDE.md", "[missing](NO.md)", "[missing](NO.md)"),  # for MkDocs to complain of
        ("GUIDE.md", "[elsewhere](https://example.org/a.md)", "[elsewhere](https://example.org/a.md)"),
    ],
)
def test_links_stay_on_the_site_or_become_paths(page, link, expected):
    assert on_site(f"see {link}, or not", page) == f"see {expected}, or not"


@needs_notebooks
def test_links_of_all_pages_lead_somewhere():
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")):
        for match in site.LINK.finditer(page.read_text(encoding="utf-8")):
            if ":" not in match[3]:
                assert (page.parent / match[3]).exists(), f"{page.name}: {match[3]}"


def test_docstrings_in_markdown():
    to_markdown = pytest.importorskip(
        "data_tools.site_docstrings", reason="needs griffe, of the extra [docs]"
    ).to_markdown
    assert to_markdown("See :func:`~minisplat_ref.io.load_scene`::\n\n    x = 1") == (
        "See `minisplat_ref.io.load_scene`:\n\n    x = 1"
    )
    table = "==  ==\na   b\n==  ==\n1   2\n==  =="
    assert to_markdown(f"A\n\n{table}\n") == f"A\n\n\n```text\n{table}\n```\n\n"


def test_the_figure_of_the_readme_has_its_numbers_from_the_table():
    text = (ROOT / "docs" / "measured" / "speed.md").read_text(encoding="utf-8")
    found = readme_figure.times_and_errors(text)
    assert found["reference float64"][1] == 0 and found["textbook float32"][0] > found["cpu float32"][0]
    with pytest.raises(InputError, match="no row of 'cpu float64'"):
        readme_figure.times_and_errors(text.replace("cpu float64", "other"))
    assert (ROOT / "docs" / "figures" / "readme.png").stat().st_size < 150_000
