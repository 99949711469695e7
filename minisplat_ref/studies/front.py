"""Parts that all studies share: the scene, means over seeds, the style of axes, and a folder with JSON and a figure.

Trainings take long. A study that appends the record of each to ``runs.jsonl`` as soon as it ends continues with the
missing ones when it is called again with the same folder.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.io import load_scene
from minisplat_ref.reporting import describe_machine
from minisplat_ref.reports.plots import GRID_COLOR, PNG_DPI
from minisplat_ref.studies import FIGURE, RESULT
from minisplat_ref.types import Scene

BLUE, RED = "#35608c", "#d2493f"
RUNS = "runs.jsonl"


def read_scene(source: str, downscale: int) -> Scene:
    """Load a folder, or make the synthetic scene of that name as ``minisplat-ref synthetic`` does by default.

    Raises
    ------
    InputError
        It is neither, or a synthetic scene is to be downscaled.
    """
    if Path(source).exists():
        return load_scene(Path(source), downscale=downscale)
    if source not in SCENE_NAMES:
        raise InputError(f"{source}: neither a folder nor one of {', '.join(SCENE_NAMES)}; give a scene")
    if downscale != 1:
        raise InputError(f"{source} is made at 160 x 120; write it with minisplat-ref synthetic for another size")
    return make_scene(source).scene


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Return what results depend on besides the method: photographs, their size, points, machine."""
    camera = scene.train_views[0].camera
    return {
        "scene": scene.name,
        "size": [camera.width, camera.height],
        "train_views": len(scene.train_views),
        "test_views": len(scene.test_views),
        "points": len(scene.points),
        "machine": describe_machine(),
    }


def title(description: dict[str, Any]) -> str:
    """Return the description in one line."""
    width, height = description["size"]
    return (
        f"{description['scene']}, {description['train_views']} training views of {width} x {height}; "
        f"{description['machine']}"
    )


def read_records(folder: Path, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Make the folder, or return its records of an earlier call with the same settings.

    Raises
    ------
    InputError
        The folder belongs to other settings, or contains something else.
    """
    path = folder / RUNS
    if not folder.exists():
        folder.mkdir(parents=True)
        path.write_text(json.dumps(settings) + "\n", encoding="utf-8")
        return []
    if not path.is_file():
        raise InputError(f"{folder} exists and is not of this study: give another --out")
    first, *lines = path.read_text(encoding="utf-8").splitlines()
    if json.loads(first) != settings:
        raise InputError(f"{folder} holds trainings of {first}: give another --out, or the same settings")
    return [json.loads(line) for line in lines]


def append(folder: Path, record: Mapping[str, Any]) -> None:
    """Append the record of a completed training."""
    with open(folder / RUNS, "a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def mean_and_deviation(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and sample standard deviation; the latter is 0 for one value."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def tidy(axes: Axes, grid: Literal["x", "both"] = "both") -> None:
    """Remove the frame above and on the right, and draw a pale grid for the named axes."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, color=GRID_COLOR)
    axes.set_axisbelow(True)


def write(folder: Path, result: dict[str, Any], figure: Figure) -> None:
    """Write the results and the figure into a folder that exists."""
    (folder / RESULT).write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    figure.savefig(folder / FIGURE, dpi=PNG_DPI, facecolor="white")
