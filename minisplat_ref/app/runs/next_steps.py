"""Commands that show a finished run, for the end of a training and for the reports."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from minisplat_ref.app.reports.commands import command
from minisplat_ref.types import Gaussians

PAGE = "scene.html"
FILM = "film.gif"
FILM_FPS = 16.0
FILM_OPTIONS = ("--cameras", "orbit", "--frames", "96", "--fps", f"{FILM_FPS:g}")  # six seconds
OPTIONAL = {"view": ("viser", "viewer"), "mesh": ("skimage", "meshes")}
"""Commands that need a package, and the extra that brings it."""


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
    purpose = "Look at it with depths, normals and training cameras"
    return Step(f"{purpose}{_extra('view')}", command("view", run))


def surface(run: Path, mesh: Path) -> Step:
    """Return the command that writes the surface of a run as a triangle mesh."""
    return Step(f"Write its surface as a triangle mesh{_extra('mesh')}", command("mesh", run, "--out", mesh))


def own_photographs() -> Step:
    """Return the command that does the same with other photographs."""
    return Step("Do the same with your own photographs, or a video", command("photos", "PHOTOS"))


def _extra(name: str) -> str:
    """Return what has to be installed before a command works here."""
    package, extra = OPTIONAL[name]
    return "" if find_spec(package) is not None else f" (pip install 'minisplat_ref[{extra}]')"
