"""Commands that show a finished run, for the end of a training and for the reports."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.app.reports.commands import command
from minisplat_ref.types import Gaussians

PAGE = "scene.html"


class Step(NamedTuple):
    """A command, and its purpose."""

    purpose: str
    """An imperative sentence without its full stop."""
    line: str
    """To be copied into a terminal, in any folder."""


def ways_to_look(run: Path, fields: Sequence[str]) -> list[Step]:
    """Return the commands that show a run in a browser.

    Parameters
    ----------
    run : Path
        Folder of the run.
    fields : sequence of str
        Of its population. A page shows those of plain Gaussians; a run that has more is shown by the viewer alone.
    """
    line = command("convert", run, run / PAGE)
    page = Step("Write one page that shows it in any browser, offline, and that can be sent", line)
    return [page, live_view(run)] if set(fields) <= set(Gaussians._fields) else [live_view(run)]


def live_view(run: Path) -> Step:
    """Return the command that shows a run with its layers and training cameras, by the renderer of its recipe."""
    return Step(
        "Look at it with depths, normals and training cameras (pip install 'minisplat_ref[viewer]')",
        command("view", run),
    )
