"""The site as a browser shows it, from files: nothing is cut at three widths or fetched, and notebooks are pages."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from browser import Browser, find_browser

ROOT = Path(__file__).parents[2]
WIDTHS = (1920, 1360, 390)  # a desk, a laptop, a phone
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))
SECONDS = 30.0  # for a search, which takes less than one on an idle machine

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("material") is None, reason="needs the extra [docs]"),
    pytest.mark.skipif(not NOTEBOOKS, reason="a source distribution has no stored notebooks"),
]

OUTSIDE = """
(() => {
  const found = [], column = document.querySelector(".md-content").getBoundingClientRect();
  if (document.documentElement.scrollWidth > innerWidth) found.push("the page scrolls sideways");
  for (const table of document.querySelectorAll(".md-content table:not([class])")) {
    const frame = table.closest(".md-typeset__scrollwrap"), name = table.textContent.trim().slice(0, 40);
    if (!frame) { found.push("no frame: " + name); continue; }
    const box = frame.getBoundingClientRect();
    if (box.left < column.left - 1 || box.right > column.right + 1) found.push("outside: " + name);
    const isCut = frame.scrollWidth > frame.clientWidth && getComputedStyle(frame).overflowX !== "auto";
    if (isCut) found.push("cut: " + name);
    for (const cell of table.querySelectorAll("th, td"))
      if (cell.offsetWidth > frame.clientWidth) found.push("does not wrap: " + cell.textContent.slice(0, 40));
  }
  return [...new Set(found)].slice(0, 5);
})()
"""
"""What is not where a reader sees it."""

FRAMES = """
(() => {
  const isFrame = node => {
    const style = getComputedStyle(node);
    return parseFloat(style.borderTopWidth) > 0 || !/, 0\\)$|transparent/.test(style.backgroundColor);
  };
  const frames = block => [block, ...block.querySelectorAll("div, pre, code")].filter(isFrame);
  return [...document.querySelectorAll(".md-content .highlight")].map(block => frames(block).length);
})()
"""
"""How many frames, borders or backgrounds, each block of code has."""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built without a warning."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    program = find_browser()
    if program is None:
        pytest.skip("needs Chromium")
    with Browser(program, tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def test_every_page_fits_and_loads_nothing(site, browser):
    some = ("*.html", "measured/*.html", "family/*.html", "notebooks/1*.html", "api/strategy.html")
    pages = [page for pattern in some for page in site.glob(pattern) if page.name != "404.html"]
    assert len(pages) >= 60
    wrong = []
    for page in pages:
        browser.open(page, width=WIDTHS[0])
        wrong += [f"{page.relative_to(site)}: {each}" for each in browser.complaints()]
        wrong += [f"{page.relative_to(site)}: {url}" for url in browser.requests() if not url.startswith("file:")]
        for width in WIDTHS:
            browser.send(
                "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 700
            )
            wrong += [f"{page.relative_to(site)} at {width}: {each}" for each in browser.run(OUTSIDE)]
        assert set(browser.run(FRAMES)) <= {1}, page
    assert not wrong, "\n" + "\n".join(wrong)


def test_notebooks_are_pages_with_their_outputs(site, browser):
    for notebook in NOTEBOOKS:
        html = (site / "notebooks" / f"{notebook.stem}.html").read_text(encoding="utf-8")
        n_images = notebook.read_text(encoding="utf-8").count('"image/png":')
        assert len(re.findall('<img alt="Output', html)) == n_images and "arithmatex" not in html
    browser.open(site / "notebooks" / "01_covariance_and_projection.html", width=WIDTHS[1])
    assert browser.run("[...document.images].every(image => image.naturalWidth > 0)")
    heights = browser.run("[...document.querySelectorAll('.formula math')].map(formula => formula.clientHeight)")
    assert len(heights) >= 3 and min(heights) > 10
    assert browser.run("document.querySelector('details').textContent").count("$") == 0


def test_a_page_that_is_opened_as_a_file_can_be_searched(site, browser):
    browser.open(site / "index.html", width=WIDTHS[1])
    browser.run("document.querySelector('[data-md-component=search-query]').focus()")
    browser.send("Input.insertText", text="transmittance")
    found = """new Promise((resolve, reject) => {
      const begin = Date.now(), look = () => {
        const n = document.querySelectorAll(".md-search-result__item").length;
        n || Date.now() - begin > %d ? resolve(n) : setTimeout(look, 100);
      }; look(); })"""
    answer = browser.send(
        "Runtime.evaluate", expression=found % (1000 * SECONDS), awaitPromise=True, returnByValue=True
    )
    assert answer["result"]["value"] > 3
