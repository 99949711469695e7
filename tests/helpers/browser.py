"""Checks of pages in a headless Chromium, which :mod:`data_tools.browser` drives."""

from pathlib import Path

from data_tools.browser import WEBGL, Browser, find_browser

__all__ = ["WEBGL", "Browser", "check_page", "find_browser"]


def check_page(browser: Browser, path: Path) -> None:
    """Assert what holds for every report: nothing is loaded, nothing fails, nothing is wider than the window."""
    for width in (390, 1280):
        for is_dark in (False, True):
            browser.open(path, width=width, is_dark=is_dark)
            assert browser.complaints() == [] and browser.requests() == []
            # Where the script has not run there are no images to compare, or something is wrong.
            assert browser.run("document.querySelectorAll('.slider:not(.live)').length") == 0
            assert browser.run("document.documentElement.scrollWidth") <= width, browser.run(TOO_WIDE)
            assert browser.run("[...document.images].every(image => image.naturalWidth > 0)")
            light = browser.run("getComputedStyle(document.body).backgroundColor")
            assert (light != "rgb(246, 247, 249)") == is_dark
            assert browser.run(CONTRASTS) == []


TOO_WIDE = """
[...document.querySelectorAll("main *")].filter(node => node.getBoundingClientRect().right > innerWidth
  && !node.closest(".scroll, pre")).map(node => node.tagName + " " + node.textContent.slice(0, 40)).slice(0, 5)
"""
"""What reaches beyond the window."""

CONTRASTS = """
(() => {
  const parse = text => { const n = text.match(/[\\d.]+/g).map(Number); return n.length < 4 ? [...n, 1] : n; };
  const linear = c => (c /= 255) <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const behind = node => {
    for (; node; node = node.parentElement) {
      const color = parse(getComputedStyle(node).backgroundColor);
      if (color[3] > 0) return color;
    }
    return [255, 255, 255];
  };
  const weak = new Set();
  for (const node of document.querySelectorAll("h1, h2, p, li, b, span, th, td, pre, figcaption, .label, .bar, text")) {
    if (!node.textContent.trim()) continue;
    const style = getComputedStyle(node), ink = light(parse(node.tagName === "text" ? style.fill : style.color));
    const paper = light(behind(node)), ratio = (Math.max(ink, paper) + 0.05) / (Math.min(ink, paper) + 0.05);
    if (ratio < 4.5) weak.add(node.tagName + " " + ratio.toFixed(1) + " " + node.textContent.slice(0, 40));
  }
  return [...weak].slice(0, 5);
})()
"""
"""Texts whose contrast with what is behind them is below 4.5, as the accessibility guidelines ask of small text."""
