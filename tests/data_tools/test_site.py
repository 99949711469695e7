"""The documentation: links that lead out of docs/, and docstrings in Markdown."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from data_tools import readme_figure, site, site_notebooks
from minisplat_ref.errors import InputError

ROOT = Path(__file__).parents[2]
needs_notebooks = pytest.mark.skipif(
    (ROOT / "PKG-INFO").exists(), reason="a source distribution has no stored notebooks"
)
PAGES = {
    *("index.md", "CONTRIBUTING.md", "GUIDE.md", "EXTENDING.md", "measured/speed.md", "measured/training.md"),
    *(f"api/{name}.md" for name in site.API),
    *("notebooks/00_reading_guide.md", "notebooks/01_covariance_and_projection.md"),
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
            "[Notebook 00](notebooks/00_reading_guide.md)",
            marks=needs_notebooks,
        ),
        pytest.param(
            "notebooks/00_reading_guide.md",
            "[next](01_covariance_and_projection.ipynb), [guide](../docs/GUIDE.md)",
            "[next](01_covariance_and_projection.md), [guide](../GUIDE.md)",
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


def test_what_belongs_to_an_item_is_indented_for_python_markdown():
    text = "- a\n  b\n\n  | t |\n\n  ```\n  x\n    - y\n  ```\n  - c\n    d\n"
    expected = "- a\n    b\n\n    | t |\n\n    ```\n    x\n      - y\n    ```\n    - c\n        d\n"
    assert site.indent_lists(text) == expected
    assert site.indent_lists("1. a\n   b\n2. c\n\nend\n\n    code") == "1. a\n    b\n2. c\n\nend\n\n    code"


def test_lines_of_a_cell_end_where_they_may():
    assert site.wrap_cell("<td>1.0 ± 0.2 dB</td>") == "<td>1.0\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}0.2 dB</td>"
    assert site.wrap_cell('<td><a href="b/c@0123abc">b/c@0123abc f.py</a></td>') == (
        '<td><a href="b/c@0123abc">b/<wbr>c<wbr>@0123abc f.py</a></td>'
    )
    assert site.wrap_cell("<td><code>a_long.dotted/name=value</code></td>") == (
        "<td><code>a_<wbr>long.<wbr>dotted/<wbr>name=<wbr>value</code></td>"
    )
    for kept in ('<td><a href="a.b/c.d/e.f/g.h">x</a></td>', "<td><code>a.b</code></td>"):
        assert site.wrap_cell(kept) == kept


def test_the_family_and_the_notebooks_are_listed():
    config = SimpleNamespace(
        nav=[{"Start": "index.md"}, {"F": ["FAMILY.md", "family/*.md"]}, {"N": ["notebooks/*.md"]}]
    )
    start, family, notebooks = site.on_config(config).nav
    assert start == {"Start": "index.md"}
    assert family["F"][:3] == ["FAMILY.md", "family/antialiasing.md", "family/analytic.md"]
    assert {path.name for path in (ROOT / "docs" / "family").iterdir()} == {page[7:] for page in family["F"][1:]}
    assert notebooks["N"] == [f"notebooks/{path.stem}.md" for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))]


def test_formulas_become_mathml():
    pytest.importorskip("latex2mathml", reason="of the extra [docs]")
    html = site_notebooks.formulas_in_mathml(
        r'<p><span class="arithmatex">\(a &lt; b\)</span></p><div class="arithmatex">\[\frac{1}{2}\]</div>'
    )
    assert html.count("<math") == 2 and "arithmatex" not in html and "<mo>&#x0003C;</mo>" in html
    assert re.search(r'<div class="formula"><math [^>]*display="block"><mrow><mfrac>', html)
    assert site_notebooks.formulas_in_mathml("<p>$5</p>") == "<p>$5</p>"


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
