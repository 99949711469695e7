"""``convert``: a model from any file into a PLY, a compact format or a page to send."""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import Commands, HelpFormatter, add_up_argument, decibels, integer

if TYPE_CHECKING:
    from minisplat_ref.app.runs.conversion import Choice, Source
    from minisplat_ref.io.formats import Format

DESCRIPTION = """\
Write the Gaussians of a run (if it has not ended, its newest whole checkpoint),
a checkpoint.npz, a PLY or a compact file. The suffix of OUT says what is
written:

  .ply    the 3DGS layout with every float
  .spz .sog .splat .glb .compressed.ply   for other programs
  .msz    ours, with a stated error (minisplat-ref extensions compression)
  .html   one page to send, which shows the scene in a browser, offline
  lod-meta.json   levels of detail that PlayCanvas streams, in a new folder

Compact formats have levels of precision, of which 0 is the finest:

  --max-bytes B   the finest level whose file has at most B bytes
  --max-drop dB   the coarsest level that loses at most so much PSNR, measured
                  on at most 24 training views of the run, or of --scene
"""
EPILOG = """\
--axes is that of the .spz that is read, or written if none is: RUB by its
specification, RDF (those of the PLY) in some programs.

examples:
  minisplat-ref convert runs/fox fox.ply
  minisplat-ref convert runs/fox fox.msz --max-drop 0.1
  minisplat-ref convert runs/fox fox.html
"""


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "convert",
        help="write a model as a PLY, compact file or web page",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="MODEL", help="run folder, checkpoint, PLY or compact file")
    parser.add_argument("output", type=Path, metavar="OUT", help="file to make or replace")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--max-bytes", type=integer(1), metavar="B", help="size that the file may have")
    how.add_argument("--max-drop", type=decibels, metavar="dB", help="PSNR that the file may lose")
    how.add_argument("--level", type=integer(0), metavar="N", help="precision (default: the format's own)")
    parser.add_argument("--scene", type=Path, metavar="PATH", help="photographs for --max-drop (default: the run's)")
    parser.add_argument(
        "--downscale", type=integer(1), metavar="D", help="how much smaller they are made (default: the run's, or 1)"
    )
    parser.add_argument(
        "--extension", metavar="E", help="extension that draws a file; core is 3DGS (default: what the file names)"
    )
    parser.add_argument("--drop-outliers", action="store_true", help="leave out what is far from all others")
    parser.add_argument("--axes", metavar="A", help="of an .spz (default: what it names, or RUB)")
    add_up_argument(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the file, and print its content."""
    from minisplat_ref.app.runs.conversion import (
        check_population,
        choose_format,
        describe_dropped,
        drop_outliers,
        encode_as,
        find_up_of,
        make_upright,
        open_source,
    )
    from minisplat_ref.app.runs.model_file import describe_parts
    from minisplat_ref.io.formats import mapped, write_file
    from minisplat_ref.io.other_places import SOG_LEVELS
    from minisplat_ref.io.upright import describe_up

    out: Path = args.output
    if out.suffix.lower() == ".html":
        return _write_page(args)
    if out.name == SOG_LEVELS:
        return _write_levels(args)
    format_ = choose_format(out)
    if args.up is not None and (format_ is None or format_.suffix != ".glb"):
        raise InputError(f"--up is for pages (.html) and for .glb, in which y is up; {out.suffix} has the scene's axes")
    if args.max_drop is None and (args.scene is not None or args.downscale is not None):
        raise InputError("--scene and --downscale are for --max-drop, which is not given: leave them out")
    of_input, format_ = _share_axes(args.axes, args.input, format_)
    source = open_source(args.input, args.extension, of_input)
    if args.drop_outliers:
        dropped = drop_outliers(source.model.gaussians)
        source = source._replace(model=source.model._replace(gaussians=dropped.population))
        if len(dropped.rows):
            what = describe_dropped(dropped.rows)
            print(f"minisplat-ref: {len(dropped.rows)} outliers are left out, {what}", file=sys.stderr)
    if format_ is None:
        options = ("max_bytes", "max_drop", "level")
        if given := [name for name in options if getattr(args, name) is not None]:
            raise InputError(
                f"a PLY has one precision, so --{given[0].replace('_', '-')} means nothing: leave it out, or choose a"
                " compact format"
            )
        source.owner.save(out, source.model.gaussians, source.label)
        lines = ["  SuperSplat opens it, splat-transform converts it, and a page to send is convert MODEL NAME.html"]
    else:
        check_population(source.model.gaussians, format_, source.what)
        format_ = format_._replace(encode=partial(encode_as, format_, out, source.label))
        choice, measured = _choose(args, source, format_)
        if format_.suffix == ".glb" and (up := find_up_of(args.input, source.model.gaussians, args.up)) is not None:
            print(describe_up(up))
            choice = choice._replace(content=format_.encode(make_upright(source.model.gaussians, up), choice.level))
        write_file(out, format_, choice.content, source.label)
        content = choice.content if isinstance(choice.content, bytes) else mapped(out)
        rows = [*format_.describe(content, out), *measured]
        lines = [f"  {name}: {value}" for name, value in rows]
    size = f"{out.stat().st_size:,} bytes"
    print(f"{len(source.model.gaussians.means):,} Gaussians of {source.what} in {out}, {size}", *lines, sep="\n")
    own = source.owner.representation.rates.of if source.owner.saves_plain else {}  # its files need none of these
    if parts := [name for name in source.model.shared if name not in own]:
        print(f"minisplat-ref: left out of {out}, which has Gaussians alone: {describe_parts(parts)}", file=sys.stderr)
    return 0


def _share_axes(axes: str | None, path: Path, format_: "Format | None") -> "tuple[str | None, Format | None]":
    """Return the axes of the input, and the format of the output with its own.

    Raises
    ------
    InputError
        Axes are named, and neither file is of a format with a choice, or there are no such axes.
    """
    from minisplat_ref.extensions.extension import find_format

    of_input = None if path.is_dir() else find_format(path)
    if axes is None or (of_input is not None and of_input.with_axes is not None):
        return axes, format_
    if format_ is None or format_.with_axes is None:
        raise InputError("--axes is for an .spz, whose programs disagree, and neither file is one: leave it out")
    return None, format_.with_axes(axes)


def _write_page(args: argparse.Namespace) -> int:
    """Write the model as a page that shows it, and print how to open it."""
    from minisplat_ref.app.runs.model_file import describe_parts, missing_parts
    from minisplat_ref.app.runs.model_source import open_source
    from minisplat_ref.app.runs.run_folder import CONFIG, scene_title
    from minisplat_ref.app.runs.settings import load
    from minisplat_ref.app.viewer.page import write_page
    from minisplat_ref.io.formats import write_content
    from minisplat_ref.io.upright import describe_up
    from minisplat_ref.rendering import SPLATTING
    from minisplat_ref.types import Gaussians

    out, path = args.output, args.input
    options = ("max_bytes", "max_drop", "level", "scene", "downscale")
    if given := [name for name in options if getattr(args, name) is not None]:
        raise InputError(f"a page has one precision, so --{given[0].replace('_', '-')} means nothing: leave it out")
    source = open_source(path, args.extension, axes=args.axes, up=args.up)
    trained = source.trained
    population = trained.model.gaussians
    own, plain = population._fields, Gaussians._fields
    if wrong := [name for name in own if name not in plain] or [name for name in plain if name not in own]:
        raise InputError(
            f"{path} {'has' if wrong[0] in own else 'lacks'} {', '.join(wrong)}, and a page shows plain Gaussians: look"
            f" at it with minisplat-ref view {path}"
        )
    name = scene_title(Path(load(path).scene)) if path.is_dir() and (path / CONFIG).is_file() else path.resolve().name
    cameras = [view for view in source.cameras if view.split != "test"] or source.cameras
    write_content(out, write_page(name, population, cameras, trained.background, source.up.direction))
    print(
        f"{len(population.means):,} Gaussians of {name} in {out}, {out.stat().st_size:,} bytes: open it in any browser"
    )
    if cameras:
        print(describe_up(source.up))
    lacks = [describe_parts(missing_parts(trained.model.shared))]
    own_renderer = trained.renderer.name.partition(" with ")[0]  # calibrations append their names
    if own_renderer != SPLATTING.name:
        lacks.append(own_renderer)
    if without := ", ".join(filter(None, lacks)):
        print(f"minisplat-ref: the page shows plain 3DGS, without {without}", file=sys.stderr)
    return 0


def _write_levels(args: argparse.Namespace) -> int:
    """Write the levels of detail of a run, and print what each loses."""
    from minisplat_ref.app.runs.levels import write_levels
    from minisplat_ref.app.runs.opened_run import open_run

    options = ("max_bytes", "max_drop", "level", "downscale", "extension", "axes", "up")
    if given := [name for name in options if getattr(args, name) is not None]:
        raise InputError(f"levels have their own sizes, so --{given[0].replace('_', '-')} means nothing: leave it out")
    levels = write_levels(open_run(args.input, args.scene), args.output)
    print(f"{len(levels)} levels of detail in {args.output}, which PlayCanvas streams; on training views they lose")
    for number, level in enumerate(levels):
        print(f"  level {number}: {level.n_gaussians:,} Gaussians, {level.drop:.2f} dB of PSNR")
    return 0


def _choose(args: argparse.Namespace, source: "Source", format_: "Format") -> "tuple[Choice, list[tuple[str, str]]]":
    """Return the requested level, and the measurements that led to it."""
    from minisplat_ref.app.runs import conversion

    gaussians = source.model.gaussians
    if args.max_bytes is not None:
        return conversion.finest_within(gaussians, format_, args.max_bytes), []
    if args.max_drop is not None:
        judge = conversion.make_judge(source, args.input, args.scene, args.downscale)
        choice = conversion.coarsest_within(gaussians, format_, args.max_drop, judge.measure_psnr)
        return choice, [("PSNR", f"{choice.drop:.3f} dB lost on {judge.views}")]
    level = format_.default_level if args.level is None else args.level
    if level >= len(format_.levels):
        raise InputError(f"--level {level} is too high: {format_.suffix} has levels 0 to {len(format_.levels) - 1}")
    if format_.write is None:
        return conversion.Choice(level, format_.encode(gaussians, level)), []
    return conversion.Choice(level, partial(conversion.write_as, format_, args.output, gaussians, level)), []
