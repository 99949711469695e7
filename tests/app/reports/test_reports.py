"""Reports: the kit that all pages are made of, in a browser; decisions, and lines that can be copied."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from browser import check_page
from minisplat_ref.app.cli import main
from minisplat_ref.app.reports import commands
from minisplat_ref.app.reports.images import fit_image, side_by_side, split_images
from minisplat_ref.app.reports.page import add_caption, cards, make_list, page, panel, section, slider, table
from minisplat_ref.app.runs.decisions_report import decisions_section, story
from minisplat_ref.app.runs.report_parts import training_curves, view_panel
from minisplat_ref.oracle.cases import Case, Report
from minisplat_ref.training.pace import Decision, Measurement, Pace

LONG = "a_name_without_any_space_" * 12


def image(level, height=30, width=40):
    return np.full((height, width, 3), level, np.uint8)


@pytest.fixture(scope="module")
def specimen(tmp_path_factory):
    """A page with one of everything, and texts that are too long."""
    log = [{"step": k, "loss": 1 / k, "psnr": 20.0 + k, "n_gaussians": 10 * k} for k in range(1, 9)]
    parts = [
        cards([(LONG[:40], LONG), ("1", "figure")]),
        section("Images", view_panel(LONG, image(200), image(100), image(0))),
        panel("two renders", [slider(image(200), {"one": image(100), "two": image(50)})], 1),
        add_caption(image(9, 600, 600), "large"),
        section("Curves", *training_curves(log)),
        table([[LONG, LONG], ["b", "2"]]),
        table([[f"row_{k}", *["12.345"] * 20, LONG] for k in range(80)], [f"column {k}" for k in range(22)]),
        table([["stage", "FAILED", "diverges"], ["other", "passed", "agrees"]], ["case", "verdict", "result"]),
        make_list(["one & <two>", LONG]),
    ]
    path = tmp_path_factory.mktemp("pages") / "specimen.html"
    path.write_text(page("A specimen <of> everything", LONG, parts), encoding="utf-8")
    return path


def test_a_page_escapes_what_it_is_given(specimen):
    text = specimen.read_text()
    assert "A specimen &lt;of&gt; everything" in text and "one &amp; &lt;two&gt;" in text
    assert text.count("data:image/png") == 6 and text.count("data:image/jpeg") == 1


def test_a_page_fits_a_phone_and_a_desk_in_light_and_dark(specimen, browser):
    check_page(browser, specimen)


def test_a_slider_moves_by_keyboard(specimen, browser):
    browser.open(specimen, width=390)
    browser.run("document.querySelector('.slider input').focus()")
    share = "document.querySelector('.slider').style.getPropertyValue('--at')"
    assert browser.run(share) == "50%"
    browser.press("ArrowRight", 39)
    assert browser.run(share) == "51%"
    browser.press("Home", 36)
    assert browser.run(share) == "0%"
    assert browser.run("document.activeElement.getAttribute('aria-label')") == "truth on the left, render on the right"


def test_a_slider_moves_by_pointer(specimen, browser):
    browser.open(specimen, width=1280)
    browser.run("document.querySelector('.slider').scrollIntoView()")
    x, y, width = browser.run(
        "(() => { const r = document.querySelector('.slider').getBoundingClientRect(); return [r.x, r.y, r.width] })()"
    )
    place = {"x": x + 0.25 * width, "y": y + 40, "button": "left", "clickCount": 1}
    browser.send("Input.dispatchMouseEvent", type="mousePressed", **place)
    assert browser.run("document.querySelector('.slider').style.getPropertyValue('--at')") == "25%"


def test_a_slider_shows_the_render_that_is_chosen(specimen, browser):
    browser.open(specimen, width=1280)
    box = "document.querySelectorAll('.slider')[1]"
    shown = f"[...{box}.querySelectorAll('figure')].map(figure => !figure.hidden)"
    assert browser.run(shown) == [True, True, False]
    browser.run(f"{box}.querySelector('select').selectedIndex = 1")
    browser.run(f"{box}.querySelector('select').dispatchEvent(new Event('change'))")
    assert browser.run(shown) == [True, False, True]


def test_without_script_a_slider_is_two_images(specimen, browser):
    """Their layout is read from the page's image: no script, no questions."""
    browser.open(specimen, width=1280, has_script=False)
    nodes = browser.send("DOM.getDocument", depth=-1)["root"]["nodeId"]
    images = browser.send("DOM.querySelectorAll", nodeId=nodes, selector=".slider:not(.live) img")["nodeIds"]
    boxes = [browser.send("DOM.getBoxModel", nodeId=node)["model"] for node in images]
    assert len(boxes) == 5 and all(box["width"] > 100 and box["height"] > 100 for box in boxes)
    left, right = (box["content"][0] for box in boxes[:2])
    assert right >= left + boxes[0]["width"]
    browser.send("Emulation.setScriptExecutionDisabled", value=False)


def test_on_a_phone_the_cells_of_a_wide_table_stand_below_each_other(specimen, browser):
    browser.open(specimen, width=390)
    table_ = "document.querySelector('.wide')"
    assert browser.run(f"{table_}.parentElement.scrollWidth <= {table_}.parentElement.clientWidth")
    tops = f"[...{table_}.querySelector('tbody tr').children].map(cell => cell.getBoundingClientRect().top)"
    found = browser.run(tops)
    assert found == sorted(set(found)) and len(found) > 4
    heading = browser.run(f"{table_}.querySelectorAll('thead th')[1].textContent")
    assert heading in browser.run(f"getComputedStyle({table_}.querySelector('td'), '::before').content")


def test_wide_tables_scroll_under_the_names_of_their_rows(specimen, browser):
    browser.open(specimen, width=720)
    table_ = "document.querySelectorAll('.data')[0]"
    left = f"{table_}.querySelector('tbody th').getBoundingClientRect().left"
    before = browser.run(left)
    assert browser.run(f"{table_}.parentElement.scrollLeft = 300, {table_}.parentElement.scrollLeft") == 300
    assert browser.run(left) == before


# Pages of checks; those of runs and of bench are in the tests of their commands


def test_the_page_of_a_comparison_in_a_browser(tmp_path, browser):
    path = tmp_path / "page.html"
    arguments = ["oracle", "compare", "planted:half-off-diagonal", "--scene", "sh3", "--report", str(path)]
    assert main(arguments) == 1
    check_page(browser, path)
    assert "DIVERGES FIRST" in browser.run("document.querySelector('td.bad + td').textContent")


def test_a_page_that_cannot_be_written_is_one_line(tmp_path, capsys):
    path = tmp_path / "absent" / "page.html"
    assert main(["oracle", "compare", "reference", "--scene", "equality", "--report", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_page_of_a_check_says_what_failed(tmp_path):
    from minisplat_ref.app.reports.check_report import report_html

    cases = (Case("right", True, {"error": 1e-9}), Case("wrong", False, {"error": 0.5}, "why"))
    text = report_html(Report("checks: of two", cases, {"dtype": "float32", "records": [{"a": 1}]}))
    assert "1 of 2" in text and "What failed" in text and text.count(">wrong<") == 2
    assert "float32" in text and "Records" not in text


# What adaptive has decided


def measured(step, psnr):
    return Measurement(step, (psnr - 1, psnr + 1), 100 * step, 1000 * step)


PACE = Pace(
    tuple(measured(100 * k, 20 + k) for k in range(1, 9)),
    (
        Decision(800, "cool down", "they gain little", 0.25, 0.05),
        Decision(801, "prune", "9 of 10 carry 0.98", None, None),
    ),
    n_pairs=800_000,
    cooling_from=800,
    last_step=1280,
)


def test_decisions_are_told_with_their_evidence():
    text = story(PACE, 1280)
    assert "from 21.00 dB after 100 iterations to 28.00 dB after 800" in text
    assert text.startswith("2 training views were held back and measured 8 times: from")
    of_few = story(PACE, 1280, holds_out=False)
    assert of_few.startswith("2 training views, trained on like all others, were measured 8 times: from")
    assert text.endswith("continued to iteration 1,280, its end.")
    page_ = decisions_section(PACE, 1280)
    assert page_.count("<svg") == 2 and "A red line has the slope" in page_ and "0.050" in page_
    for decision, effect in (("cool down", "the learning rates began to fall"), ("prune", "Gaussians were removed")):
        assert page_.count(f"{decision}: {effect}<") == 1 and page_.count(effect) == 1, "in the table alone"
    assert page_.count("9 of 10 carry 0.98") == 1


def test_a_training_that_was_stopped_says_so():
    assert story(PACE, 1000).endswith("stopped at iteration 1,000 of the 1,280 that it had planned.")
    early = decisions_section(Pace(), 40)
    assert "stopped at iteration 40, before the learning rates fell" in early and "<svg" not in early


# Pieces


def test_images_come_apart_as_they_were_joined(rng):
    parts = [rng.integers(0, 256, (5, 7, 3), dtype=np.uint8) for _ in range(3)]
    assert all(np.array_equal(a, b) for a, b in zip(split_images(side_by_side(parts), 3), parts, strict=True))


def test_large_images_are_averaged_down():
    assert fit_image(image(80, 300, 400), 100).shape == (75, 100, 3) and fit_image(image(80), 100).shape == (
        30,
        40,
        3,
    )
    assert np.all(fit_image(image(80, 300, 400), 100) == 80)


def test_paths_in_a_command_are_absolute_and_quoted(monkeypatch, tmp_path):
    monkeypatch.setattr(commands, "program", lambda: "minisplat-ref")
    monkeypatch.chdir(tmp_path)
    line = commands.command("render", Path("a run"), "--cameras", "orbit")
    assert shlex.split(line) == ["minisplat-ref", "render", str(tmp_path / "a run"), "--cameras", "orbit"]


def test_a_command_is_written_as_it_is_typed(monkeypatch, tmp_path):
    """By the program's name; where an environment has to be activated before, a line says how."""
    script, activate = tmp_path / "my env" / "minisplat-ref", tmp_path / "my env" / "activate"
    script.parent.mkdir()
    script.touch(), activate.touch()
    monkeypatch.setattr(commands.sys, "executable", str(script.parent / "python"))
    monkeypatch.setattr(commands.shutil, "which", lambda name: None)
    assert commands.command("demo") == "minisplat-ref demo"
    assert commands.how_to_call() == [f"in a new terminal, give first: . '{activate}'"]
    activate.unlink()
    assert commands.command("demo") == f"'{script.parent}/python' -m minisplat_ref demo"
    monkeypatch.setattr(commands.shutil, "which", lambda name: "/usr/bin/minisplat-ref")
    assert commands.command("demo") == "minisplat-ref demo" and commands.how_to_call() == []


def test_the_program_is_found_from_anywhere(monkeypatch):
    monkeypatch.setattr(commands.shutil, "which", lambda name: None)
    monkeypatch.setattr(commands, "_activate", lambda: None)
    assert commands.how_to_call() == []
    assert commands.program().endswith("-m minisplat_ref")
    monkeypatch.setattr(commands, "_is_installed", lambda: False)
    assert commands.program().startswith(f"cd {shlex.quote(str(Path(commands.__file__).parents[3]))} && ")
