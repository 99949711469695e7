"""``info``: the content of a PLY, a checkpoint, a run or a scene."""

import argparse
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.interface.arguments import Commands, HelpFormatter

if TYPE_CHECKING:
    from minisplat_ref.app.runs.options import Settings
    from minisplat_ref.io.label import Label
    from minisplat_ref.types import Floats

NOT_SHOWN = ("per_view", "n_gaussians", "iterations", "lpips_reason")  # of metrics.json: too long, or said elsewhere

Rows = list[tuple[str, str]]

DESCRIPTION = """\
Say what is in a file or folder: counts, SH degree, bounds, sizes.

  point_cloud.ply   Gaussians in the 3DGS layout, from any program
  checkpoint.npz    a training that can be continued
  run folder        the --out of a training: settings, metrics, what fired
  scene folder      COLMAP (images/, sparse/0/) or transforms.json
  .spz and others   compact files of Gaussians, see minisplat-ref convert

Everything is read and checked. If something is damaged, info says what.
"""
EPILOG = """\
examples:
  minisplat-ref info runs/fox/point_cloud.ply
  minisplat-ref info photos/fox
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "info",
        help="say what is in a PLY, a checkpoint, a run or a scene",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("path", type=Path, metavar="FILE", help="any of the above")
    parser.add_argument("--model", metavar="M", help="folder of the COLMAP model in a scene (default sparse/0)")
    parser.add_argument("--axes", metavar="A", help="of an .spz, such as RUB, RDF (default: what it names, or RUB)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print a table of names and values."""
    from minisplat_ref.app.runs.model_file import find_file
    from minisplat_ref.app.runs.run_folder import CONFIG
    from minisplat_ref.io.formats import UNBUNDLED

    path: Path = args.path
    if args.model is not None and not path.is_dir():
        raise InputError(f"--model is for a scene with a COLMAP model, and {path} is none: leave it out")
    if not path.exists():
        raise InputError(f"{path} does not exist: give a file or folder to look into")
    path = find_file(path)
    is_compact = path.is_file() and path.suffix not in (".ply", ".csv", ".npz", ".json")
    if args.axes is not None and not is_compact:
        raise InputError(f"{path}: --axes is for .spz, whose programs disagree about them: leave it out")
    if path.name == UNBUNDLED:
        rows = _compact_rows(path, args.axes)
    elif path.suffix in (".ply", ".csv"):
        rows = _ply_rows(path)
    elif path.suffix == ".npz":
        rows = _checkpoint_rows(path)
    elif (path / CONFIG).exists():
        rows = _run_rows(path)
    elif path.is_dir() or path.suffix == ".json":
        rows = _scene_rows(path, args.model)
    else:
        rows = _compact_rows(path, args.axes)
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value}")
    return 0


def _ply_rows(path: Path) -> Rows:
    from minisplat_ref.app.runs.model_file import read_population, recorded_owner
    from minisplat_ref.extensions.extension import CORE
    from minisplat_ref.io.ply import further_properties, read_label
    from minisplat_ref.types import Gaussians

    label = read_label(path)
    try:
        owner = recorded_owner(path, label)
    except InputError as error:  # what 3DGS knows of it can be described all the same
        warnings.warn(str(error), InputWarning, stacklevel=2)
        owner = CORE
    fields = read_population(path, owner)._asdict()
    further = []
    if set(Gaussians._fields) <= set(fields):  # others are named as the file names them
        fields = {name: fields[name] for name in Gaussians._fields}
        further = [("further properties", ", ".join(names))] if (names := further_properties(path)) else []
    return [("PLY", _size(path)), *_label_rows(label), *_field_rows(fields), *further]


def _label_rows(label: "Label") -> Rows:
    """Return rows about the renderer of a file, and the parts of its run that it lacks."""
    from minisplat_ref.app.runs.model_file import describe_parts

    settings = f", with {', '.join(label.set)}" if label.set else ""
    rows = [] if label.extension is None else [("drawn by extension", f"{label.extension}{settings}")]
    return [*rows, *([("lacks", f"{describe_parts(label.lacks)} of its run")] if label.lacks else [])]


def _compact_rows(path: Path, axes: str | None) -> Rows:
    from minisplat_ref.app.runs.model_file import format_with_axes
    from minisplat_ref.extensions.extension import all_formats, find_format
    from minisplat_ref.io.formats import label_of, read_content

    format_ = find_format(path)
    if format_ is None:
        suffixes = ", ".join(known.suffix for _, known in all_formats())
        raise InputError(
            f"{path} is none of .ply, checkpoint .npz, run folder, scene folder, transforms.json, {suffixes}"
        )
    format_ = format_with_axes(path, axes) or format_
    content = read_content(path)
    fields = format_.decode(content, path)._asdict()
    label = _label_rows(label_of(path, format_, content))
    return [(format_.suffix, _size(path)), *label, *format_.describe(content, path), *_field_rows(fields)]


def _checkpoint_rows(path: Path) -> Rows:
    from minisplat_ref.io.checkpoint import load_checkpoint
    from minisplat_ref.io.frames import return_fields
    from minisplat_ref.training.representation import WORLD_UNITS
    from minisplat_ref.training.saved_state import check_fields, read_counters, read_frame, recorded_recipe

    arrays, metadata = load_checkpoint(path)
    fields = _group(arrays, "gaussians")
    check_fields(path, fields)
    fields = return_fields(fields, WORLD_UNITS, read_frame(path, metadata))
    rows = [
        ("iteration", f"{read_counters(path, metadata).step:,}"),
        ("recipe", "{} for {} iterations".format(*recorded_recipe(metadata))),
        *_field_rows(fields),
    ]
    shared = ", ".join(f"{name} {_shape(array)}" for name, array in _group(arrays, "shared").items())
    return [("checkpoint", _size(path)), *rows, *([("shared", shared)] if shared else [])]


def _group(arrays: "Mapping[str, Floats]", name: str) -> "dict[str, Floats]":
    """Return the arrays of one group of a checkpoint, by their own names."""
    return {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}


def _shape(array: "Floats") -> str:
    return f"[{', '.join(map(str, array.shape))}]"


def _run_rows(folder: Path) -> Rows:
    from dataclasses import asdict

    from minisplat_ref.app.runs.checkpoints import newest
    from minisplat_ref.app.runs.run_folder import CHECKPOINT, EVENTS, METRICS, PREVIOUS, read_json_object
    from minisplat_ref.app.runs.settings import load

    settings = load(folder)
    rows = [("state", _state_of_run(folder, settings.iterations))]
    rows += [(name.replace("_", " "), _short(value)) for name, value in asdict(settings).items() if _says(value)]
    if (folder / METRICS).exists():
        metrics = read_json_object(folder / METRICS)
        rows += [
            (name.replace("_", " "), _short(value))
            for name, value in metrics.items()
            if name not in NOT_SHOWN and _says(value)
        ]
    if (folder / EVENTS).exists():
        rows += _event_rows(folder, settings)
    if (folder / CHECKPOINT).exists() or (folder / PREVIOUS).exists():
        rows += newest(folder, _checkpoint_rows)
    return rows


def _state_of_run(folder: Path, iterations: int) -> str:
    from minisplat_ref.app.runs.checkpoints import read_step
    from minisplat_ref.app.runs.run_folder import has_begun, is_finished

    going_on = f"minisplat-ref train --resume {folder}"
    step = read_step(folder)
    if step is None:
        return "complete, without a checkpoint" if has_begun(folder) else f"has not begun: {going_on}"
    if step < iterations and not is_finished(folder, iterations):
        return f"incomplete, {step:,} of {iterations:,} iterations are saved: {going_on}"
    return (
        f"complete after {step:,} iterations"
        if is_finished(folder, iterations) or is_finished(folder, step)
        else f"trained, but not measured: {going_on}"
    )


def _event_rows(folder: Path, settings: "Settings") -> Rows:
    """Return rows about the mechanisms of the recipe that were active, and those that never were."""
    from minisplat_ref.app.runs.events import count_published_times, describe, never_fired, read_mechanisms
    from minisplat_ref.app.runs.run_folder import EVENTS, is_finished
    from minisplat_ref.extensions.extension import find_recipe

    published = count_published_times(find_recipe(settings.recipe, extension=settings.extension))
    found = read_mechanisms(folder / EVENTS, published)
    never = never_fired(found, published)
    rows = [(f"fired: {mechanism.action}", describe(mechanism)) for mechanism in found]
    name = "never fired" if is_finished(folder, settings.iterations) else "not fired yet"
    return [*rows, *([(name, ", ".join(never))] if never else [])]


def _scene_rows(path: Path, model: str | None) -> Rows:
    from minisplat_ref.app.runs.notices import describe_exposures, describe_place, describe_sizes
    from minisplat_ref.io import list_scene
    from minisplat_ref.io.frames import place_scene
    from minisplat_ref.io.inventory import take_inventory
    from minisplat_ref.io.scene import TEST_EVERY, build_reading, build_scene

    listing = list_scene(path, TEST_EVERY, model)
    photos = (*listing.train_photos, *listing.test_photos)
    is_parallel = any(photo.lens is not None and photo.lens.is_parallel for photo in photos)
    scene = build_scene(listing, build_reading(1, None, not is_parallel, listing.alpha_is_mask, is_parallel))
    place = describe_place(place_scene(scene))
    views = (*scene.train_views, *scene.test_views)
    focals = sorted(view.camera.fx for view in views)
    n_masks = sum(view.mask is not None for view in views)
    return [
        ("scene", scene.name),
        ("files", one_line(take_inventory(path, scene, model).line)),
        ("views", f"{len(views)}: {len(scene.train_views)} training, {len(scene.test_views)} test"),
        ("image sizes", describe_sizes([(view.camera.width, view.camera.height) for view in views])),
        ("focal length", f"{focals[0]:.1f} to {focals[-1]:.1f} {'pixels per world unit' if is_parallel else 'px'}"),
        *([("masks", f"{n_masks} of {len(views)} views")] if n_masks else []),
        ("points", f"{len(scene.points):,}"),
        *_bounds_rows(scene.points),
        ("exposures", describe_exposures(scene)),
        ("extent", f"{scene.extent:.4g} world units"),
        *([("frame", place)] if place else []),
        ("background", _vector(scene.background)),
    ]


def _field_rows(fields: "Mapping[str, Floats]") -> Rows:
    """Describe a population by its fields: the well-known ones by what they mean, others by their shapes."""
    import numpy as np

    from minisplat_ref.types import Gaussians

    means = fields["means"]
    is_of_gaussians = set(Gaussians._fields) <= set(fields)
    rows = [("Gaussians" if is_of_gaussians else "primitives", f"{len(means):,}")]
    if "sh_rest" in fields and fields["sh_rest"].ndim == 3:
        rows.append(("SH degree", str(math.isqrt(fields["sh_rest"].shape[1] + 1) - 1)))
    rows += _bounds_rows(means)
    if len(means) and "log_scales" in fields:
        with np.errstate(over="ignore", invalid="ignore"):
            rows.append(("scales", _quantiles(np.exp(fields["log_scales"])) + " world units"))
    if len(means) and "opacity_logits" in fields:
        opacities = 0.5 * (1 + np.tanh(0.5 * fields["opacity_logits"]))  # [N]
        rows.append(("opacities", _quantiles(opacities)))
    further = ", ".join(f"{name} {_shape(field)}" for name, field in fields.items() if name not in Gaussians._fields)
    return [*rows, *([("further fields", further)] if further else [])]


def _bounds_rows(points: "Floats") -> Rows:
    import numpy as np

    if len(points) == 0:
        return []
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    return [
        ("bounds", f"{_vector(points.min(axis=0))} to {_vector(points.max(axis=0))}"),
        ("1 to 99 %", f"{_vector(low)} to {_vector(high)}"),
    ]


def _quantiles(values: "Floats") -> str:
    import numpy as np

    low, median, high = np.quantile(values, (0.01, 0.5, 0.99))
    return f"median {median:.3g}, 1 to 99 %: {low:.3g} to {high:.3g}"


def _vector(values: "Floats") -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.2f} MB"


def _says(value: Any) -> bool:
    """Return whether a setting or metric is worth a row: it was given, measured or switched on."""
    return value is not None and value is not False and value != {}


def _short(value: Any) -> str:
    if value is True:
        return "yes"
    if isinstance(value, dict):
        return ", ".join(f"{name}={setting}" for name, setting in value.items())
    return f"{value:.4f}" if isinstance(value, float) else str(value)
