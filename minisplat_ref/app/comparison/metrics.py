"""Metrics of finished runs, and their aggregates over seeds and folds."""

import math
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.types import NOTHING

TRAINING_COPIES = 4  # the model, its gradients, and Adam's two moments, all of one size


class Metric(NamedTuple):
    """A row of the table."""

    key: str
    """Name in compare.json."""
    title: str
    """Its meaning, with the unit."""
    format: str
    """Of a value."""
    relation: Literal["ratio", "difference"] | None
    """How a recipe is compared with the first; decibels and SSIM have no meaningful ratio."""


METRICS = (
    Metric("psnr", "PSNR (dB)", ".2f", "difference"),
    Metric("psnr_exposed", "PSNR with the photographs' own exposures (dB)", ".2f", "difference"),
    Metric("psnr_corrected", "PSNR after the best affine map of the colours (dB)", ".2f", "difference"),
    Metric("ssim", "SSIM", ".4f", "difference"),
    Metric("lpips", "LPIPS", ".4f", "difference"),
    Metric("best_psnr", "best PSNR on the way (dB)", ".2f", "difference"),
    Metric("best_iteration", "reached at iteration", ",.0f", None),
    Metric("chamfer", "Chamfer distance to the true surface (extents)", ".4f", "ratio"),
    Metric("n_gaussians", "Gaussians", ",.0f", "ratio"),
    Metric("train_seconds", "training (s)", ".1f", "ratio"),
    Metric("train_cpu_seconds", "processor time of all threads (s)", ".1f", "ratio"),
    Metric("seconds_to_first", "until the first's final PSNR (s)", ".1f", "ratio"),
    Metric("iterations_to_first", "the same (iterations)", ",.0f", "ratio"),
    Metric("iterations_per_second", "iterations/s", ".1f", "ratio"),
    Metric("peak_rss_mb", "peak memory of the process (MB)", ".0f", "ratio"),
    Metric("densifying_mb", "model, gradients, moments while densifying (MB)", ".1f", "ratio"),
    Metric("densified_mb", "the same afterwards (MB)", ".1f", "ratio"),
    Metric("render_fps", "rendering (views/s)", ".1f", "ratio"),
    Metric("ply_bytes", "PLY (bytes)", ",.0f", "ratio"),
)
"""The rows, top to bottom."""

RunMetrics = Mapping[str, float | None]
"""Values of one run by the keys of ``METRICS``; None where something was not measured or not reached."""

PER_PHOTOGRAPH = ("psnr", "psnr_exposed", "psnr_corrected", "ssim", "lpips")
"""Keys of the metrics that each test view has."""


class Spread(NamedTuple):
    """Aggregate over several seeds, or photographs."""

    mean: float | None
    """None unless every run has a value."""
    std: float | None
    """Sample standard deviation; None without a mean and of a single value."""


def spread(values: Sequence[float | None]) -> Spread:
    """Return mean and standard deviation."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return Spread(None, None)
    return Spread(float(np.mean(known)), float(np.std(known, ddof=1)) if len(known) > 1 else None)


class RecipeMetrics(NamedTuple):
    """All runs of one recipe."""

    recipe: str
    """Its name."""
    runs: Sequence[RunMetrics]
    """One per seed and fold."""
    photographs: Mapping[str, RunMetrics] = NOTHING
    """With folds, by the name of each photograph, the metrics :data:`PER_PHOTOGRAPH`: its mean over the seeds."""

    def is_per_photograph(self, metric: Metric) -> bool:
        """Return whether a metric is one of each photograph, held out once."""
        return bool(self.photographs) and metric.key in PER_PHOTOGRAPH

    def compute_spread(self, metric: Metric) -> Spread:
        """Return mean and standard deviation of a metric over the photographs, or else over the runs."""
        return spread(self._collect_values(metric))

    def compute_error(self, metric: Metric) -> float | None:
        """Return the standard error of the mean; None of a single value, or where one lacks."""
        values = self._collect_values(metric)
        std = spread(values).std
        return None if std is None else std / math.sqrt(len(values))

    def error_of_difference(self, metric: Metric, first: "RecipeMetrics") -> float | None:
        """Return the standard error of the mean difference to the first recipe, paired by photograph or by run.

        Recipes that are trained with one seed see the same views in the same order; the effect of such a seed on both
        is no part of the difference, nor is the difficulty of a photograph. None of a single pair, or where a value
        lacks.
        """
        pairs = zip(self._collect_values(metric), first._collect_values(metric), strict=True)
        differences = [ours - theirs for ours, theirs in pairs if ours is not None and theirs is not None]
        if len(differences) < max(2, len(self._collect_values(metric))):
            return None
        return float(np.std(differences, ddof=1) / math.sqrt(len(differences)))

    def _collect_values(self, metric: Metric) -> list[float | None]:
        sources = self.photographs.values() if self.is_per_photograph(metric) else self.runs
        return [source[metric.key] for source in sources]


def read_curve(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a run's test views on the way: step, seconds, psnr, ssim, n_gaussians, perhaps chamfer."""
    return read_log(folder / run_folder.CURVE)


def read_metrics(folder: Path, target_psnr: float, render_fps: float) -> dict[str, float | None]:
    """Return the metrics of a finished run.

    Parameters
    ----------
    folder : Path
        The run.
    target_psnr : float
        dB; how soon the run has reached it is one of the metrics.
    render_fps : float
        How fast its Gaussians are rendered, views per second.
    """
    metrics = run_folder.read_json_object(folder / run_folder.METRICS)
    end = densification_end(run_folder.read_json_object(folder / run_folder.CONFIG)["recipe"])
    curve = read_curve(folder)
    best = best_record(curve)
    reached = first_to_reach(curve, target_psnr)
    densifying, densified = peak_training_mb(read_log(folder / run_folder.LOG), end)
    return {
        "psnr": metrics["psnr"],
        "psnr_exposed": metrics["psnr_exposed"],
        "psnr_corrected": metrics["psnr_corrected"],
        "ssim": metrics["ssim"],
        "lpips": metrics["lpips"],
        "best_psnr": best["psnr"],
        "best_iteration": best["step"],
        "chamfer": curve[-1].get("chamfer"),
        "n_gaussians": metrics["n_gaussians"],
        "train_seconds": metrics["train_seconds"],
        "train_cpu_seconds": metrics.get("train_cpu_seconds"),
        "seconds_to_first": None if reached is None else reached["seconds"],
        "iterations_to_first": None if reached is None else reached["step"],
        "iterations_per_second": metrics["iterations"] / metrics["train_seconds"],
        "peak_rss_mb": metrics["peak_rss_mb"],
        "densifying_mb": densifying,
        "densified_mb": densified,
        "render_fps": render_fps,
        "ply_bytes": (folder / run_folder.POINT_CLOUD).stat().st_size,
    }


def read_photographs(folders: Iterable[Path]) -> dict[str, dict[str, float | None]]:
    """Return the metrics of each photograph that some finished runs have measured, the mean where several have."""
    found: dict[str, list[Mapping[str, float | None]]] = {}
    for folder in folders:
        for view in run_folder.read_json_object(folder / run_folder.METRICS)["per_view"]:
            found.setdefault(view["name"], []).append(view)
    return {
        name: {key: spread([view[key] for view in views]).mean for key in PER_PHOTOGRAPH}
        for name, views in sorted(found.items())
    }


def final_psnr(folder: Path) -> float:
    """Return the PSNR of a run's last record, dB."""
    return float(read_curve(folder)[-1]["psnr"])


def best_record(curve: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the record of the highest PSNR; of equal ones the first."""
    return max(curve, key=lambda record: record["psnr"])


def first_to_reach(curve: Sequence[Mapping[str, Any]], psnr: float) -> Mapping[str, Any] | None:
    """Return the first record of at least this PSNR; None where there is none.

    The PSNR may have been reached at any time since the record before: this is the latest it can have been.
    """
    return next((record for record in curve if record["psnr"] >= psnr), None)


def peak_training_mb(log: Sequence[Mapping[str, Any]], end: float) -> tuple[float | None, float | None]:
    """Return the peak memory of model, gradients and moments before iteration ``end``, and from it on, MB.

    None for a stage without records.
    """
    before = [record for record in log if record["step"] < end]
    after = [record for record in log if record["step"] >= end]

    def peak(records: Sequence[Mapping[str, Any]]) -> float | None:
        return max((TRAINING_COPIES * float(record["model_mb"]) for record in records), default=None)

    return peak(before), peak(after)


def densification_end(recipe: Mapping[str, Any]) -> float:
    """Return the iteration at which a recipe, as config.json describes it, has stopped cloning and splitting.

    Mini-Splatting simplifies in this iteration; 3DGS continues with its Gaussians. Infinite where there is no such end.
    """
    events = [event for event in recipe["events"] if event["action"] == "clone_and_split"]
    stops = [math.inf if event["stop"] is None else event["stop"] * Fraction(event["factor"]) for event in events]
    return max(map(float, stops), default=math.inf)


def relation(metric: Metric, value: Spread, first: Spread) -> float | None:
    """Compare a recipe's mean with that of the first recipe: its ratio or difference; None where one lacks."""
    if metric.relation is None or value.mean is None or first.mean is None:
        return None
    if metric.relation == "ratio" and first.mean == 0:
        return None
    return value.mean - first.mean if metric.relation == "difference" else value.mean / first.mean
