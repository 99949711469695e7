"""The table of what renderers compute, and a page with their pictures beside ours."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image

from data_tools.conformance.judging import LEVELS, OF_A_HIT, Habits, Verdict, image_of
from data_tools.conformance.probes import PROBES, golden_of
from data_tools.conformance.renderers import RENDERERS, Renderer
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Floats

ZOOM = 3
HEAD = """# Conformance: what public renderers compute

Written by `python -m data_tools.conformance --out DIR`, which fetches each renderer in the version named here and
shows it {n} probes: scenes of one to forty Gaussians, 96 x 64 pixels, each of which isolates a rule. A renderer is
judged by the profile that is nearest to its pictures (`VIEWER`: no clamp of alpha, no stop), with habits of viewers
that no profile has: Gaussians cut off at the square root of 8 deviations, or lowered to 0 there, and no low-pass.
(That of gsplat.js is 0.3 in quarters of px^2, 0.075 px^2, which these probes hardly tell from none.) A picture of 8
bits agrees if no pixel is more than {levels} levels (of 255) off, and {more} more for each hit, which a buffer of 8
bits rounds; pixels at the cut are not compared. Where it differs, each planted fault of the oracle is tried, and one
that leaves no more is named: it makes this picture, and need not be its cause. The rest is unexplained: no single
rule makes that picture. That is not yet to say that it is wrong. Two errors were confirmed by hand and in the source:
of [gsplat.js](conformance/gsplatjs.md) and of [GaussianSplats3D](conformance/gaussian-splats-3d.md).

"""


class Result(NamedTuple):
    """What was found of one renderer."""

    renderer: Renderer
    habits: Habits | None
    verdicts: Mapping[str, Verdict]
    reason: str = ""
    """Why there is none."""


def table(results: Sequence[Result]) -> str:
    """Return docs/CONFORMANCE.md."""
    lines = [HEAD.format(n=len(PROBES), levels=LEVELS, more=OF_A_HIT)]
    rows = []
    for result in results:
        verdicts = list(result.verdicts.values())
        counts = [sum(v.result == kind for v in verdicts) for kind in ("agrees", "rule", "unexplained")]
        n_missing = sum(v.result == "no picture" for v in verdicts)
        said = result.reason or (f"{n_missing} without a picture" if n_missing else "")
        shown = [str(n) for n in counts] if verdicts else ["", "", ""]
        rows.append(
            [
                result.renderer.what,
                result.renderer.version,
                "" if result.habits is None else result.habits.name,
                *shown,
                said,
            ]
        )
    heading = ["renderer", "version", "nearest profile", "agrees", "differs as a rule", "unexplained", "remarks"]
    lines += [markdown_table(heading, rows), ""]
    for result in results:
        if result.verdicts:
            lines += [f"## {result.renderer.what}, {result.renderer.version}", "", _details(result), ""]
    lines += ["## The probes", ""]
    lines += [f"- `{probe.name}`: {probe.rule}" for probe in PROBES]
    return "\n".join(lines) + "\n"


def _details(result: Result) -> str:
    rows = [
        [v.probe, v.words, f"{v.largest:.1f}", f"{v.rms:.2f}", f"{v.quantised:.1f}", f"{v.left:.1f}"]
        for v in result.verdicts.values()
    ]
    return markdown_table(["probe", "result", "largest", "RMS", "of 8 bits alone", "left by the rule"], rows)


def page(results: Sequence[Result], pictures: Mapping[str, Mapping[str, Floats]]) -> str:
    """Return a page: of each probe ours, theirs, and ten times the difference."""
    parts = ["<!doctype html><meta charset='utf-8'><title>Conformance</title>"]
    parts.append("<style>body{font:14px sans-serif;margin:2em}img{image-rendering:pixelated;margin:2px}</style>")
    for result in results:
        habits = result.habits
        if habits is None:
            continue
        title = f"{result.renderer.what}, by {habits.name}: ours, theirs, difference x 10"
        parts.append(f"<h2>{html.escape(title)}</h2>")
        for probe in PROBES:
            if probe.name not in pictures[result.renderer.name]:
                continue
            theirs = pictures[result.renderer.name][probe.name]
            ours = np.clip(image_of(golden_of(probe, habits.conventions), habits), 0, 1)
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
