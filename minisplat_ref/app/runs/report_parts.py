"""Parts that the reports of runs share: held-out views with their errors, curves over the training, and mechanisms."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from minisplat_ref.app.reports.images import Image8, fit_image
from minisplat_ref.app.reports.page import add_caption, film, link, panel, section, slider, table
from minisplat_ref.app.reports.plots import plot, to_svg
from minisplat_ref.app.runs.recipe_actions import HEADING, Fired, remarks_by_mechanism, rows
from minisplat_ref.interface.palette import BLUE, GREEN, RED
from minisplat_ref.io import read_image

ERROR_TEXT = """\
Error is the mean absolute difference of the three channels: dark is none, bright is a quarter of the range or more."""

FILM_WIDTH = 640  # pixels at most, of the film in a page

Records = Sequence[Mapping[str, Any]]
"""Of ``log.jsonl`` or ``curve.jsonl``."""


def showcase(report: Path, page: Path, frames: Sequence[Path], fps: float) -> str:
    """Return the part of a report that shows the scene: a link to its page, and a film.

    Parameters
    ----------
    report : Path
        The file of the report, from which the link leads to the page.
    page : Path
        The page that shows the scene.
    frames : sequence of Path
        Images of the film, in their order.
    fps : float
        Images per second.
    """
    target = Path(os.path.relpath(page.resolve(), report.resolve().parent)).as_posix()
    images = [fit_image(read_image(path)[..., :3], FILM_WIDTH) for path in frames]
    moving = film(images, fps, "a film along the path of the cameras")
    return section("The scene", link("Look around in this browser.", target), moving)


def view_panel(label: str, truth: Image8, render: Image8, error: Image8) -> str:
    """Return a panel of a held-out view: truth against render, and the error beside them.

    Parameters
    ----------
    label : str
        Name of the view, and its metrics.
    truth, render, error : ndarray of shape (H, W, 3)
        sRGB.
    """
    return panel(label, [slider(truth, {"render": render}), add_caption(error, "error")], n_columns=2)


def training_curves(log: Records) -> list[str]:
    """Return loss, PSNR and number of Gaussians over the iterations, as SVG."""
    kinds = (("loss", "loss", RED), ("psnr", "PSNR of training views (dB)", BLUE), ("n_gaussians", "Gaussians", GREEN))
    return [curve(log, key, title, color) for key, title, color in kinds]


def curve(records: Records, key: str, title: str, color: str) -> str:
    """Return one field of the records over the iterations, as SVG."""
    with plot(title, "iterations") as (figure, axes):
        marker = "o" if len(records) == 1 else None  # a line of one point shows nothing
        steps, values = ([record[name] for record in records] for name in ("step", key))
        axes.plot(steps, values, color=color, lw=1.8, marker=marker)
    return to_svg(figure)


def fired_tables(fired: Fired) -> list[str]:
    """Return the actions of a recipe's mechanisms, and their notes."""
    acted, noted = rows(fired), remarks_by_mechanism(fired)
    return [*([table(acted, HEADING)] if acted else []), *([table(noted.items())] if noted else [])]
