"""A comparison as a report: one line for each stage, over all scenes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.comparison.renderers import Renderer
from minisplat_ref.oracle.comparison.staged import STAGES, Row, Status, excess, first_divergence


def as_report(renderer: Renderer, rows: list[Row], settings: Mapping[str, Any]) -> Report:
    """One case for each stage that was given, with the scene where it is furthest off."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    first = first_divergence(rows)
    given = [stage for stage in STAGES if any(r.stage == stage and r.status != "not given" for r in rows)]
    verdict = (
        f"all {len(given)} stages that it gives agree"
        if first is None
        else f"the first stage that diverges is {first.stage}, in scene {first.scene}"
    )
    where = f"scene {scenes[0]}" if len(scenes) == 1 else f"{len(scenes)} scenes"
    cases = [_case([row for row in rows if row.stage == stage], first) for stage in given]
    details = [{"scene": row.scene, "stage": row.stage, "result": row.status, **_figures([row])} for row in rows]
    return Report(
        title=f"{renderer.name} against the reference, {where}: {verdict}",
        cases=tuple(cases),
        settings={
            **settings,
            "renderer": renderer.name,
            "fed_with_truth": renderer.is_staged,
            "not_given": [stage for stage in STAGES if stage not in given],
            "first_divergence": None if first is None else {"stage": first.stage, "scene": first.scene},
            "scenes": [{k: _finite(v) for k, v in detail.items()} for detail in details],
        },
    )


def _case(rows: list[Row], first: Row | None) -> Case:
    """One stage over all scenes."""
    order: tuple[Status, ...] = ("diverges", "harmless", "agrees", "not given")
    worst = min(rows, key=lambda row: (order.index(row.status), -excess(row)))
    is_first = first is not None and worst.stage == first.stage
    where = f"{worst.scene}: " if len(rows) > 1 and worst.status in ("diverges", "harmless") else ""
    return Case(
        name=worst.stage,
        passed=worst.status != "diverges",
        figures={"result": "DIVERGES FIRST" if is_first else worst.status, **_figures(rows)},
        note=f"{where}{worst.note}".removesuffix(": ") if worst.note or where else "",
    )


def _figures(rows: list[Row]) -> dict[str, Figure]:
    """Largest errors and summed counts of a stage."""
    figures: dict[str, Figure] = {}
    differences = [row.difference for row in rows if row.difference is not None]
    bounds = [row.bounds for row in rows if row.bounds is not None]
    if differences:
        worst = max(differences, key=lambda d: d.excess)
        figures = {
            "max error": worst.max_error,
            "RMS": worst.rms_error,
            "relative": worst.relative,
            "allowed": worst.tolerance,
            "over": sum(d.n_over for d in differences),
            "of": sum(d.n for d in differences),
        }
    if bounds:
        figures = {"over": sum(b.n_different for b in bounds), "of": sum(b.n for b in bounds)}
    if any(row.stage in ("T", "image") for row in rows) and differences:
        figures["flips"] = sum(d.n_flips for d in differences)
        figures["candidates"] = sum(row.n_candidates for row in rows)
    return figures


def _finite(value: Any) -> Any:
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value
