"""Measure what training in blocks costs: PSNR beside that of the whole, at seams and elsewhere, time and memory.

``python -m data_tools.measure_blocks SCENE --blocks 2x2 --iterations 2400 --seeds 0,1,2 --out DIR`` trains the whole
and blocks, in which each photograph is shown as often, for each seed, and prints a table: mean and standard deviation
over the seeds. If the blocks of the first seed took over a tenth more processor time, it also trains shorter ones,
which take as much as the whole. Training continues where it was cut off.

A pixel of a test view belongs to a seam if the Gaussian that weighs most in it, in the model of the whole, is nearer to
an edge between cores than a twentieth of the cameras' reach.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.blocks.plan import COARSE, Plan, count_iterations, load_block_training, load_plan
from minisplat_ref.app.blocks.train import is_unfinished
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.scoring import load_trained
from minisplat_ref.app.runs.settings import load, load_frame, load_photographs
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io.frames import return_points
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Bools, Floats, View

BAND = 0.05  # of the cameras' reach
SHARE_MIN = 1 / 1.1  # of the blocks' processor time in that of the whole, below which shorter ones are trained, too
CPU_TIME, SHORTER = "train_cpu_seconds", "blocks of the same processor time"
HEADING = (
    *("training", "iterations", "processor s", "Gaussians", "PSNR (dB)", "SSIM"),
    *("at seams (dB)", "elsewhere (dB)", "largest process (MB)"),
)


class Trained(NamedTuple):
    """A training that has ended."""

    folder: Path
    parts: tuple[Path, ...]
    """Run folders of all trainings that made it."""
    iterations: int
    """Of all these together."""

    @property
    def metrics(self) -> dict[str, Any]:
        """Of its end."""
        return run_folder.read_json_object(self.folder / run_folder.METRICS)

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all its trainings."""
        return float(self.metrics[CPU_TIME])

    @property
    def peak_mb(self) -> float:
        """Memory of the largest of the processes that train it, without those of the coarse and the merged model."""
        parts = [part for part in self.parts if part.name != COARSE] or self.parts
        return max(run_folder.read_json_object(part / run_folder.METRICS)["peak_rss_mb"] for part in parts)


def train_briefly(words: list[str]) -> None:
    """Train briefly, so that no training's time is that of the compiler."""
    with tempfile.TemporaryDirectory() as folder:
        brief = [*words, "--iterations", "20", "--out", str(Path(folder) / "run")]
        subprocess.run([sys.executable, "-m", "minisplat_ref", "train", *brief], check=True)


def train(folder: Path, words: list[str]) -> Trained:
    """Train into a folder, from where it is."""
    begun = is_unfinished(folder) or run_folder.has_begun(folder)
    if not (folder / run_folder.METRICS).exists():
        command = ["--resume", str(folder)] if begun else [*words, "--out", str(folder)]
        subprocess.run([sys.executable, "-m", "minisplat_ref", "train", *command], check=True)
    plan = load_plan(folder) if (folder / run_folder.BLOCKS).exists() else None
    if plan is None:
        return Trained(folder, (folder,), run_folder.read_json_object(folder / run_folder.METRICS)["iterations"])
    names = [COARSE, *(planned.block.name for planned in plan.blocks)]
    training = load_block_training(folder)
    return Trained(folder, tuple(map(training.run_folder_for, names)), count_iterations(training, plan))


def seam_errors(trained: Trained, whole: Trained, plan: Plan) -> tuple[float, float]:
    """Return the PSNR of the test views' pixels at seams and elsewhere, dB."""
    settings, frame = load(whole.folder), load_frame(whole.folder)
    scene = load_photographs(settings, frame)
    (reference, drawn_reference), (_, drawn) = (_renderer(t.folder, scene.background) for t in (whole, trained))
    coordinates = plan.plane.coordinates(return_points(reference.means, frame))  # [N, 2]
    centers = np.stack([view.camera.center for view in scene.train_views])
    reach = float(np.ptp(plan.plane.coordinates(return_points(centers, frame)), axis=0).max())
    is_near = np.append(seam_distance(plan, coordinates) < BAND * reach, False)  # [N + 1]
    errors: dict[bool, list[Floats]] = {True: [], False: []}
    for view in scene.test_views:
        at_seam = is_near[drawn_reference(view).stats.dominant_ids]  # [H, W]
        error = (np.clip(drawn(view).image, 0, 1) - view.image / 255.0) ** 2
        for where in errors:
            errors[where].append(error[(at_seam == where) & _counts(view)].reshape(-1))
    at_seams, elsewhere = (-10.0 * np.log10(np.concatenate(errors[where]).mean()) for where in (True, False))
    return float(at_seams), float(elsewhere)


def _counts(view: View) -> Bools:
    return np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask


def seam_distance(plan: Plan, coordinates: Floats) -> Floats:
    """Return [P] how far points [P, 2] of the plane are from the nearest edge of the core that they are in."""
    distance = np.full(len(coordinates), np.inf)
    for planned in plan.blocks:
        inside = planned.block.core.contains(coordinates)
        edges = np.abs(np.stack([coordinates[inside] - corner for corner in planned.block.core]))  # [2, Q, 2]
        distance[inside] = edges.min(axis=(0, 2))
    return distance


def _renderer(folder: Path, background: Floats) -> Any:
    trained = load_trained(folder)
    settings = RenderSettings(background, backend=CPU, renderer=trained.renderer)
    return trained.model.gaussians, lambda view: settings.render_view(trained.model, view, frozenset({"stats"}))[0]


def row_of(trained: Trained, seams: tuple[float, float]) -> list[float]:
    """Return the numbers of one training, in the order of HEADING."""
    metrics = trained.metrics
    numbers = [trained.iterations, trained.cpu_seconds, metrics["n_gaussians"]]
    return [*numbers, metrics["psnr"], metrics["ssim"], *seams, trained.peak_mb]


def main() -> None:
    """Train, measure, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--blocks", required=True)
    parser.add_argument("--iterations", type=int, required=True)
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--recipe", default="3dgs-accel")
    parser.add_argument("--downscale", default="1")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    train_briefly([args.scene, "--recipe", args.recipe, "--downscale", args.downscale])
    rows: dict[str, list[list[float]]] = {}
    fewer: int | None = None
    for seed in args.seeds.split(","):
        words = [args.scene, "--recipe", args.recipe, "--downscale", args.downscale, "--seed", seed]
        whole = train(args.out / f"whole-{seed}", [*words, "--iterations", str(args.iterations)])
        words += ["--blocks", args.blocks]
        often = train(args.out / f"often-{seed}", [*words, "--iterations", str(args.iterations)])
        plan = load_plan(often.folder)
        assert plan is not None
        arms = {"whole": whole, "blocks": often}
        if not rows and (share := whole.cpu_seconds / often.cpu_seconds) < SHARE_MIN:
            fewer = round(args.iterations * share)
        if fewer is not None:
            arms[SHORTER] = train(args.out / f"shorter-{seed}", [*words, "--iterations", str(fewer)])
        for name, trained in arms.items():
            rows.setdefault(name, []).append(row_of(trained, seam_errors(trained, whole, plan)))
    print(f"{args.scene}, {args.blocks} blocks, seeds {args.seeds}; {describe_machine()}\n")
    print(markdown_table(HEADING, [[name, *_cells(np.array(values))] for name, values in rows.items()]))


def _cells(values: Floats) -> list[str]:
    digits = (0, 0, 0, 2, 4, 2, 2, 0)
    means, deviations = values.mean(axis=0), values.std(axis=0, ddof=1) if len(values) > 1 else None
    cells = [f"{mean:,.{n}f}" for mean, n in zip(means, digits, strict=True)]
    if deviations is None:
        return cells
    return [
        f"{cell} ± {deviation:.{n}f}" if n else cell
        for cell, deviation, n in zip(cells, deviations, digits, strict=True)
    ]


if __name__ == "__main__":
    main()
