"""One reading order: it names what exists, and the pages that show it are up to date."""

import re

import pytest

from data_tools import reading_order
from data_tools.reading_order import ORDER, ROOT, main
from minisplat_ref import reference

STEPS = [step for part in ORDER for step in part.steps]


@pytest.mark.parametrize(
    "name", [file for part in ORDER for file in (*part.files, *sum((s.files for s in part.steps), ()))]
)
def test_it_names_what_exists(name):
    path = ROOT / "minisplat_ref" / name
    assert path.is_dir() if name.endswith("/") else path.is_file()


@pytest.mark.parametrize("part", ORDER, ids=lambda part: part.subject)
def test_the_short_list_covers_the_steps(part):
    for step in part.steps:
        assert all(file.startswith(part.files) for file in step.files)


def test_every_notebook_is_in_it():
    named = {number for step in STEPS for number in step.notebooks}
    assert named == {int(path.name[:2]) for path in (ROOT / "notebooks").glob("[0-9]*.py")}


def test_the_reference_is_read_in_its_own_order():
    own = re.findall(r"^(\w+) +\S", reference.__doc__.split("===\n")[2], re.MULTILINE)
    here = [file[10:-3] for step in STEPS for file in step.files if file.startswith("reference/")]
    assert here == [name for name in own if name in here]


def test_the_pages_are_up_to_date(capsys):
    assert main(["--check"]) == 0, capsys.readouterr().out


def test_a_page_that_differs_is_named_and_written(tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{reading_order.BEGIN}\nold\n{reading_order.END}\nafter\n")
    monkeypatch.setattr(reading_order, "ROOT", tmp_path)
    monkeypatch.setattr(reading_order, "PAGES", {page: lambda: "new"})
    assert main(["--check"]) == 1 and "page.md: differs" in capsys.readouterr().out and "old" in page.read_text()
    assert main([]) == 0 and main(["--check"]) == 0
    assert page.read_text() == f"before\n{reading_order.BEGIN}\n\nnew\n\n{reading_order.END}\nafter\n"


def test_ranges():
    assert reading_order._ranges({0, 1, 2, 3, 7, 8, 11}) == "00 to 03, 07, 08, 11"
