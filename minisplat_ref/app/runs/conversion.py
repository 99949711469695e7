"""Models from any file, and the choice of a precision: the finest that fits, or the coarsest that is good enough.

The loss by a compact file is measured on photographs that were *trained* on, at most 24 of them: the choice of a level
is a decision like others, and the test views must not influence it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from minisplat_ref.app.runs.model_file import find_file, make_label, read_model
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import CORE, Extension, all_formats, find_format, owner_of
from minisplat_ref.io import viewpoints
from minisplat_ref.io.formats import Format, with_label
from minisplat_ref.io.frames import frame_of_means, place_scene
from minisplat_ref.io.label import NO_LABEL, Label
from minisplat_ref.io.other_places import SOG_LEVELS
from minisplat_ref.io.ply import are_far
from minisplat_ref.io.upright import Up, choose_up, upright_rotation
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.training.compensation import with_compensation
from minisplat_ref.training.sky import with_sky
from minisplat_ref.types import FILE_FRAME, Frame, Gaussians, Ints, Model, number_views, some_of

VIEWS_MAX = 24
OUTLIER_REACH = 1000.0  # extents of most of a scene; a sky of Gaussians is less than a hundred away
ROWS_NAMED = 5  # that a message names
NO_DROP = 1e-5  # dB: files have another order, in which Gaussians of equal depth are blended; 2e-7 has been seen


class Source(NamedTuple):
    """A model, and where it comes from."""

    model: Model
    """In the frame of its scene's files."""
    owner: Extension
    """The owner of the population."""
    what: str
    """In a few words."""
    frame: Frame = FILE_FRAME
    """The frame in which it is rendered."""
    label: Label = NO_LABEL
    """The label for a file of its population."""


class Choice(NamedTuple):
    """A file at one level, ready to be written."""

    level: int
    content: bytes | Callable[[BinaryIO], None]
    """Of the file, or what writes it into an open file."""
    drop: float | None = None
    """dB of PSNR that are lost; None where it was not measured."""


def open_source(path: Path, extension: str | None = None, axes: str | None = None) -> Source:
    """Read a model from a run folder, a checkpoint, a PLY or a compact file.

    Parameters
    ----------
    path : Path
    extension : str, optional
        The one that renders a file, instead of the one in its label; runs and checkpoints have theirs.
    axes : str, optional
        Those of an .spz, instead of those that it names.

    Raises
    ------
    InputError
        It is none of these, or damaged, or ``extension`` is given where it is known.
    """
    path = find_file(path) if path.exists() else path
    is_checkpoint = path.suffix == ".npz"
    if path.is_dir() or is_checkpoint:
        if extension is not None:
            raise InputError(f"{path} has its extension recorded: leave out --extension {extension}")
        return _open_checkpoint(path) if is_checkpoint else _open_run(path)
    if not path.exists():
        raise InputError(f"{path} does not exist: give a run folder, a checkpoint, a PLY or a compact file")
    read = read_model(path, extension, axes)
    return Source(Model(read.population), read.owner, path.name, frame_of_means(read.population.means), read.label)


def _open_run(folder: Path) -> Source:
    from minisplat_ref.app.runs.checkpoints import newest_model
    from minisplat_ref.app.runs.settings import find_owner, load, load_frame, return_model

    settings = load(folder)
    saved = newest_model(folder, settings)
    what = "the run's result" if saved.unfinished is None else f"iteration {saved.unfinished}"
    owner, frame = find_owner(settings), load_frame(folder)
    label = make_label(owner, saved.model.shared, settings.set)
    return Source(return_model(saved.model, owner, frame), owner, what, frame, label)


def _open_checkpoint(path: Path) -> Source:
    """Read a checkpoint without its run: the population is that of its recipe, which an extension may own."""
    from minisplat_ref.app.runs.settings import return_model
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.training.saved_state import read_bundles, read_counters, read_frame, recorded_recipe

    arrays, metadata = load_checkpoint(path)
    step = read_counters(path, metadata).step
    fields = {name.removeprefix("gaussians.") for name in arrays if name.startswith("gaussians.")}
    owner = CORE if fields == set(Gaussians._fields) else owner_of(recorded_recipe(metadata)[0]) or CORE
    bundles = read_bundles(path, arrays, owner.representation.population)
    model, frame = Model(bundles.gaussians, bundles.shared), read_frame(path, metadata)
    label = make_label(owner, model.shared, {})
    return Source(return_model(model, owner, frame), owner, f"iteration {step}", frame, label)


def choose_format(path: Path) -> Format | None:
    """Return the format that a file to be written has by its name; None for a PLY.

    Raises
    ------
    InputError
        There is no such format.
    """
    format_ = find_format(path)
    if format_ is None and path.suffix != ".ply":
        written = [known.suffix for _, known in all_formats() if known.levels]
        suffixes = " or ".join([".ply", *written, ".html (a page to send)", SOG_LEVELS])
        raise InputError(f"{path} is not named like a PLY or another format: give a name that ends in {suffixes}")
    if format_ is not None and not format_.levels:
        raise InputError(f"{path}: a {format_.suffix} is read, but not written: choose another format")
    return format_


def find_up_of(path: Path, gaussians: Gaussians, given: str | None) -> Up | None:
    """Return what is up in a run, or as it is given; None for a file of which nobody says it.

    Raises
    ------
    InputError
        ``given`` makes no sense.
    """
    from minisplat_ref.app.runs.run_folder import CAMERAS, CONFIG
    from minisplat_ref.app.runs.settings import load_up

    views = viewpoints.read(path / CAMERAS) if (path / CAMERAS).is_file() else []
    recorded = load_up(path) if (path / CONFIG).is_file() else None
    return choose_up(given, recorded, views, gaussians.means)


def make_upright(gaussians: Gaussians, up: Up) -> Gaussians:
    """Return Gaussians turned about the origin, so that -y is up."""
    turn = upright_rotation(up.direction)  # [3, 3]
    one = Deformation(turn[None], np.zeros(len(gaussians.means), np.int64))
    return deform(gaussians, gaussians.means.astype(np.float64) @ turn.T, one)


def check_population(population: Any, format_: Format, what: str) -> None:
    """Refuse a population that has further fields than a compact format holds.

    Raises
    ------
    InputError
        It has.
    """
    if lacking := [name for name in Gaussians._fields if name not in population._fields]:
        raise InputError(f"{what} has no {', '.join(lacking)}, which a {format_.suffix} holds: convert it to a PLY")
    further = [name for name in population._fields if name not in Gaussians._fields]
    if further:
        raise InputError(
            f"{what} has {', '.join(further)}, which {format_.suffix} does not hold: convert it to a PLY, which does"
        )


class Dropped(NamedTuple):
    """A population without its outliers."""

    population: Any
    rows: Ints
    """Of the outliers."""


def drop_outliers(population: Any) -> Dropped:
    """Return a population without Gaussians that are far from all others or far larger than all of them.

    Far is :data:`OUTLIER_REACH` times the extent of the middle 80 % of the centres, away from their median. The same
    multiple of that extent is the size from which on a Gaussian is too large.
    """
    means = population.means.astype(np.float64)
    if len(means) < 2:
        return Dropped(population, np.zeros(0, np.int64))
    low, middle, high = np.quantile(means, (0.1, 0.5, 0.9), axis=0)
    reach = OUTLIER_REACH * max(float(np.linalg.norm(high - low)), np.finfo(np.float64).tiny)
    is_far = np.linalg.norm(means - middle, axis=1) > reach
    is_large = population.log_scales.max(axis=1) > np.log(reach)
    is_outlier = is_far | is_large
    rows = np.flatnonzero(is_outlier)
    if not len(rows):
        return Dropped(population, rows)  # itself, not a copy
    return Dropped(type(population)(*(field[~is_outlier] for field in population)), rows)


def describe_dropped(rows: Ints) -> str:
    """Name the rows of outliers, the first few of them."""
    named = ", ".join(map(str, rows[:ROWS_NAMED].tolist()))
    return f"row {named}" if len(rows) == 1 else f"rows {named}{', ...' if len(rows) > ROWS_NAMED else ''}"


def encode_as(format_: Format, path: Path, label: Label, gaussians: Gaussians, level: int) -> bytes:
    """Return the content of a file at one level, with its label if it has a place for it; an error names the file.

    Raises
    ------
    InputError
        A value does not fit the format.
    """
    with _naming(path, gaussians):
        return with_label(format_, format_.encode(gaussians, level), label)


def write_as(format_: Format, path: Path, gaussians: Gaussians, level: int, file: BinaryIO) -> None:
    """Write what :func:`encode_as` returns, of a format that is written a piece at a time and has no place for a label.

    Raises
    ------
    InputError
        A value does not fit the format.
    """
    assert format_.write is not None and format_.write_label is None
    with _naming(path, gaussians):
        format_.write(file, gaussians, level)


@contextmanager
def _naming(path: Path, gaussians: Gaussians) -> Iterator[None]:
    """Refuse centres that are far from the origin, and let errors name the file and the outliers."""
    if are_far(gaussians):
        distance = float(np.abs(np.median(gaussians.means, axis=0)).max())
        raise InputError(
            f"{path} cannot be written: its centres are some {distance:.6g} from the origin, where float32 has steps of"
            f" {np.spacing(np.float32(distance)):.2g}; write a PLY, which holds them in float64"
        )
    try:
        yield
    except InputError as error:
        rows = drop_outliers(gaussians).rows
        way_out = f"; or leave out what is far from all others ({describe_dropped(rows)}) by --drop-outliers"
        raise InputError(f"{path} cannot be written: {error}{way_out if len(rows) else ''}") from None


def finest_within(gaussians: Gaussians, format_: Format, max_bytes: int) -> Choice:
    """Return the finest level whose file has at most this many bytes.

    Raises
    ------
    InputError
        None has.
    """
    size = 0
    for level in range(len(format_.levels)):
        content = format_.encode(gaussians, level)
        if len(content) <= max_bytes:
            return Choice(level, content)
        size = len(content)
    raise InputError(
        f"no level of {format_.suffix} fits {max_bytes:,} bytes, the coarsest takes {size:,}: allow more, or simplify"
        " the model first"
    )


def coarsest_within(
    gaussians: Gaussians, format_: Format, max_drop: float, measure_psnr: Callable[[Gaussians], float]
) -> Choice:
    """Return the coarsest level that loses at most this many dB.

    Parameters
    ----------
    gaussians : Gaussians
    format_ : Format
        Levels are tried from the coarsest on, and the first that is good enough is taken.
    max_drop : float
        dB.
    measure_psnr : callable
        The PSNR, dB, of Gaussians on the views that count.

    Raises
    ------
    InputError
        None is good enough.
    """
    before = measure_psnr(gaussians)
    drop = 0.0
    for level in reversed(range(len(format_.levels))):
        content = format_.encode(gaussians, level)
        drop = before - measure_psnr(format_.decode(content, format_.suffix))
        if drop <= max_drop + NO_DROP:
            return Choice(level, content, drop)
    raise InputError(
        f"every level of {format_.suffix} loses more than {max_drop:g} dB, the finest {drop:.3f}: allow more, or choose"
        " another format"
    )


class Judge(NamedTuple):
    """Measures Gaussians on photographs."""

    measure_psnr: Callable[[Gaussians], float]
    views: str
    """A description in a few words."""


def make_judge(source: Source, path: Path, scene: Path | None, downscale: int | None) -> Judge:
    """Return a function that measures a model on training views: of its run, or of a scene.

    Parameters
    ----------
    source : Source
        Its shared parameters and its renderer are used, too; exposures and poses with the run's own photographs only.
    path : Path
        Where it comes from; if that is a run, its settings and photographs are taken.
    scene : Path, optional
        Where the photographs are; those of the run by default.
    downscale : int, optional
        Factor by which they are made smaller; that of the run, or 1, by default.

    Raises
    ------
    InputError
        There is neither a run nor a scene, or the photographs cannot be read.
    """
    from minisplat_ref.app.runs.scoring import choose_renderer
    from minisplat_ref.app.runs.settings import load, load_photographs, place_model
    from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
    from minisplat_ref.io import load_scene
    from minisplat_ref.metrics import evaluate
    from minisplat_ref.rendering.backends import get_backend

    profile, backend = GSPLAT_MAIN.name, "cpu"
    renderer = with_sky(with_compensation(source.owner.representation.renderer))
    if path.is_dir():
        settings = load(path)
        photographs = load_photographs(
            replace(
                settings,
                scene=settings.scene if scene is None else str(scene),
                downscale=settings.downscale if downscale is None else downscale,
            ),
            source.frame,
        )
        profile, backend = settings.profile, settings.backend
        if scene is None:  # its own photographs, for which it may have exposures and poses
            renderer = choose_renderer(settings, source.model)
            photographs = photographs._replace(train_views=number_views(photographs.train_views))
    elif scene is not None:
        photographs = place_scene(load_scene(scene, downscale=downscale or 1, undistort=True), source.frame)
    else:
        raise InputError(f"--max-drop needs photographs to measure on, and {path} is no run: give --scene PATH")
    views = some_of(photographs.train_views, VIEWS_MAX)

    def measure_psnr(gaussians: Gaussians) -> float:
        psnr = evaluate(
            place_model(source.model._replace(gaussians=gaussians), source.owner, source.frame),
            views,
            RenderSettings(
                photographs.background, renderer=renderer, backend=get_backend(backend), conventions=PROFILES[profile]
            ),
        ).psnr
        assert psnr is not None
        return psnr

    return Judge(measure_psnr, f"{len(views)} of {len(photographs.train_views)} training views of {photographs.name}")
