"""The table of what renderers compute, and a page with their pictures beside ours."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image

from data_tools.conformance.habits import image_of
from data_tools.conformance.judging import EXACT, LEVELS, OF_A_HIT, SMALL, Verdict
from data_tools.conformance.probes import PROBES
from data_tools.conformance.renderers import RENDERERS, Renderer
from data_tools.conformance.sources import SOURCES
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Floats

ZOOM = 3
HEAD = """# Conformance: what public renderers compute

Written by `python -m data_tools.conformance --out DIR`, which fetches each renderer in the version named here and
shows it {n} probes: scenes of one to forty Gaussians, 96 x 64 pixels, each of which isolates a rule. {n_run} renderers
ran, {n_whole} of which agree with the reference on every probe. The reference follows a renderer's own rules, which
its source states: a profile (`VIEWER`: no clamp of alpha, no stop), and habits that no profile has, listed with each.
So "agrees" does not say that it computes what 3DGS does; it says that what differs is known, and the list is that.
A picture of 8 bits agrees if no pixel is more than {levels} levels (of 255) off, and {more} more for each hit, which a
buffer of 8 bits rounds; the corners of quads lie on a grid of 1/16 pixel, and pixels at a cut are not compared. Forty
hits may so be 21 levels off, which is why `faint` tells only large differences. Where a picture differs, each planted
fault of the oracle is tried. One that explains it is named, below {small:.0f} levels of difference only if it leaves at
most {exact:.0f}; it makes this picture, and need not be its cause. The rest is unexplained, which is not yet to say
that it is wrong. Two errors are planted, a camera moved by four pixels, and Gaussians that are a fifth larger and
fainter: of the {n_agree} pictures that agree {n_seen} would not with either, {n_one} would not with one of them, and
{n_none} would agree with both, since they are empty. Errors that a second calculation confirmed: {reports}.

"""
REPORTS = ("gaussian-splats-3d", "gsplatjs", "babylon", "antimatter15", "torch-splatting")


class Result(NamedTuple):
    """What was found of one renderer."""

    renderer: Renderer
    verdicts: Mapping[str, Verdict]
    """By the probes; none of a renderer that did not run."""
    reason: str = ""
    """Why there is none."""


def table(results: Sequence[Result]) -> str:
    """Return docs/CONFORMANCE.md."""
    ran = [result for result in results if result.verdicts]
    whole = [result for result in ran if all(v.result == "agrees" for v in result.verdicts.values())]
    reports = ", ".join(f"[{name}](conformance/{name}.md)" for name in REPORTS)
    seen = [len(v.seen) for result in ran for v in result.verdicts.values() if v.result == "agrees"]
    errors = {"n_agree": len(seen), "n_seen": seen.count(2), "n_one": seen.count(1), "n_none": seen.count(0)}
    numbers = errors | {"levels": LEVELS, "more": OF_A_HIT, "small": SMALL, "exact": EXACT}
    lines = [HEAD.format(n=len(PROBES), n_run=len(ran), n_whole=len(whole), reports=reports, **numbers)]
    rows = []
    for result in results:
        verdicts, habits = list(result.verdicts.values()), result.renderer.habits
        kinds = ("agrees", "rule", "unexplained", "no picture")
        counts = [str(sum(v.result == kind for v in verdicts)) if verdicts else "" for kind in kinds]
        n_rules = str(len(habits.rules)) if habits is not None and verdicts else ""
        profile = habits.conventions.name if habits is not None and verdicts else ""
        rows.append([result.renderer.what, result.renderer.version, profile, n_rules, *counts, result.reason])
    heading = [
        "renderer",
        "version",
        "profile",
        "rules that differ from it",
        "agrees",
        "differs as a further rule",
        "unexplained",
        "no picture",
        "why it did not run",
    ]
    lines += [markdown_table(heading, rows), ""]
    for result in ran:
        renderer = result.renderer
        lines += [f"## {renderer.what}, {renderer.version}", "", f"Fetched by {renderer.source}.", ""]
        if renderer.habits is not None and renderer.habits.rules:
            lines += [f"Rules that differ from `{renderer.habits.conventions.name}`, and where they are stated:", ""]
            places = {name: stated.place for name, stated in SOURCES[renderer.name].items()}
            lines += [*(f"- {words}: {places[name]}" for name, words in renderer.habits.rules.items()), ""]
        lines += [_details(result), ""]
    lines += ["## The probes", ""]
    lines += [f"- `{probe.name}`: {probe.rule}" for probe in PROBES]
    return "\n".join(lines) + "\n"


def _details(result: Result) -> str:
    rows = [
        [v.probe, v.words, f"{v.largest:.1f}", f"{v.rms:.2f}", f"{v.quantised:.1f}", f"{v.left:.1f}", _seen(v)]
        for v in result.verdicts.values()
    ]
    heading = ["probe", "result", "largest", "RMS", "of 8 bits alone", "left by the rule", "planted errors seen"]
    return markdown_table(heading, rows)


def _seen(verdict: Verdict) -> str:
    return "" if verdict.result != "agrees" else " and ".join(verdict.seen) or "neither"


def page(results: Sequence[Result], pictures: Mapping[str, Mapping[str, Floats]]) -> str:
    """Return a page: of each probe ours, theirs, and ten times the difference."""
    parts = ["<!doctype html><meta charset='utf-8'><title>Conformance</title>"]
    parts.append("<style>body{font:14px sans-serif;margin:2em}img{image-rendering:pixelated;margin:2px}</style>")
    for result in results:
        habits = result.renderer.habits
        if habits is None or not result.verdicts:
            continue
        title = f"{result.renderer.what}, by {habits.name}: ours, theirs, difference x 10"
        parts.append(f"<h2>{html.escape(title)}</h2>")
        for probe in PROBES:
            if probe.name not in pictures[result.renderer.name]:
                continue
            theirs = pictures[result.renderer.name][probe.name]
            ours = np.clip(image_of(probe, habits), 0, 1)
            shown = (ours, theirs, np.clip(10 * np.abs(ours - theirs), 0, 1))
            images = "".join(f"<img alt='' src='{_png(image)}'>" for image in shown)
            words = html.escape(f"{probe.name}: {result.verdicts[probe.name].words}")
            parts.append(f"<p>{words}<br>{images}</p>")
    return "\n".join(parts)


def _png(image: Floats) -> str:
    data = np.rint(255 * image).astype(np.uint8).repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
    buffer = io.BytesIO()
    Image.fromarray(data).save(buffer, "PNG")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


NAMES = {renderer.name: renderer for renderer in RENDERERS}
