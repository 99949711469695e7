"""Claim ``omg/files``: what the codes and networks of a training cost in bytes and in quality, beside other files.

The paper is Optimized Minimal Gaussians, arXiv 2503.16924. Each training's result is measured as it is, as ``.omg`` of
its own codes and networks, and as every file that ``convert`` can write at every level. All rows of a seed are the same
trained Gaussians, read again from the file.
"""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import subplots, with_deviation
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.extensions.extension import all_formats, find_recipe
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.recipe import OMG
from minisplat_ref.extensions.omg.trained_file import read_training
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.io.frames import return_population
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import FILE_FRAME, Frame, Gaussians, Model, Scene

TRAINED, RESULT = ".omg of the training", "as trained"
COLUMNS = (
    ("bytes", spread("n_bytes", 0)),
    ("bytes per Gaussian", spread(lambda row: row["n_bytes"] / max(1, row["gaussians"]), 1)),
    ("PSNR (dB)", spread("psnr", 2)),
    ("lost (dB)", spread("lost", 2)),
)
COLORS = {".msz": BLUE, ".spz": GREY, ".omg": OCHRE, TRAINED: RED}


def run(args: argparse.Namespace) -> kit.Report:
    """Train, or read checkpoints, and measure every file."""
    scene = kit.read_scene(args.scene, args.downscale)
    runs: list[dict[str, Any]] = []
    for name, (model, frame) in _trainings(args, scene):
        measured = list(kit.with_progress(_rows(model, frame, scene), f"files, {name}"))
        runs.append({"training": name, "gaussians": len(model.gaussians.means), "rows": measured})
    origin = {"checkpoints": [str(path) for path in args.checkpoints]} if args.checkpoints else {"recipe": OMG.name}
    result = {**kit.describe_scene(scene), **origin, "iterations": args.iterations, "runs": runs}
    counts = with_deviation([float(of["gaussians"]) for of in runs], 0)
    text = f"{kit.title(result)}\n{counts} Gaussians\n\n"
    rows = [{**row, "gaussians": of["gaussians"]} for of in runs for row in of["rows"]]
    text += table(rows, {"file": "file"}, COLUMNS)
    return kit.Report(result, draw(result), text)


def _trainings(args: argparse.Namespace, scene: Scene) -> Iterator[tuple[str, tuple[Model, Frame]]]:
    """Yield each training by its name; those of checkpoints, or one for each seed."""
    for path in args.checkpoints:
        yield str(path), read_training(path)
    for seed in range(0 if args.checkpoints else args.seeds):
        state = kit.train_with_progress(scene, find_recipe(OMG.name, args.iterations), seed)
        yield f"seed {seed}", (state.model, state.frame)


def _rows(model: Model, frame: Frame, scene: Scene) -> Iterator[dict[str, Any]]:
    """Yield size and PSNR of the Gaussians as they are, and of each file of them."""
    plain = Gaussians(*model.gaussians[: len(Gaussians._fields)])
    gaussians = plain if frame == FILE_FRAME else return_population(plain, WORLD_UNITS, frame)

    def psnr_of(found: Gaussians) -> float:
        psnr = evaluate(found, scene.test_views, RenderSettings(scene.background)).psnr
        assert psnr is not None, "a claim has test views"
        return psnr

    whole = psnr_of(gaussians)
    yield {"file": RESULT, "n_bytes": sum(field.nbytes for field in gaussians), "psnr": whole, "lost": 0.0}
    content = trained_file.encode(model, frame)
    files = [(TRAINED, content, trained_file.decode(content, TRAINED))]
    for _, format_ in all_formats():
        for level, _ in enumerate(format_.levels):
            content = format_.encode(gaussians, level)
            files.append((f"{format_.suffix} {level}", content, format_.decode(content, format_.suffix)))
    for name, content, back in files:
        psnr = psnr_of(back)
        yield {"file": name, "n_bytes": len(content), "psnr": psnr, "lost": whole - psnr}


def draw(result: dict[str, Any]) -> Figure:
    """Draw PSNR against bytes, the mean over the trainings, of each format through its levels."""
    figure, axes = subplots((6.4, 4.0))
    by_file = list(zip(*(of["rows"] for of in result["runs"]), strict=True))
    for kind, color in COLORS.items():
        own = [rows for rows in by_file if rows[0]["file"].rpartition(" ")[0] == kind or rows[0]["file"] == kind]
        points = [[np.mean([row[key] for row in rows]) for rows in own] for key in ("n_bytes", "psnr")]
        axes.plot(np.divide(points[0], 1e3), points[1], "s" if len(own) == 1 else "o-", ms=5, color=color, label=kind)
    axes.axhline(float(np.mean([row["psnr"] for row in by_file[0]])), color=GREY, lw=0.8, ls="--", label=RESULT)
    axes.set(xscale="log", xlabel="kB", ylabel="PSNR (dB)", title=f"{result['scene']}: bytes and quality")
    axes.legend()
    return figure
