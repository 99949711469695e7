"""The studies ``vr/foveation`` and ``vr/yaw``, of a trained scene."""

import argparse
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.shared_studies import add_out, check_at_least, read_scene, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study

FULLS = (2.0, 4.0, 8.0, 12.0)  # degrees


def add_foveation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scene, ``--ply``, ``--downscale``, ``--repeats`` and ``--out``."""
    parser.add_argument("scene", metavar="SCENE", help="folder of a scene, or a synthetic one")
    parser.add_argument("--ply", type=Path, required=True, metavar="FILE", help="Gaussians that were trained on it")
    parser.add_argument("--downscale", type=int, default=1, metavar="D", help="use photographs at 1/D of their size")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="timings per picture (default 3)")
    add_out(parser)


def run_foveation(args: argparse.Namespace) -> None:
    """Draw the test views at rates by eccentricity, write the results, and print two tables.

    Raises
    ------
    InputError
        The scene, the PLY or the output folder cannot be used.
    """
    from minisplat_ref.extensions.vr import measures
    from minisplat_ref.io.ply import load_ply
    from minisplat_ref.types import Model

    check_at_least(1, downscale=args.downscale, repeats=args.repeats)
    scene, model = read_scene(args.scene, args.downscale), Model(load_ply(args.ply))
    with making_folder(args.out) as folder:
        rows = measures.foveated(model, scene.test_views, scene.background, FULLS, args.repeats)
        result = {"scene": scene.name, "gaussians": len(model.gaussians.means), "rows": rows}
        write(folder, result, measures.draw_foveated(rows))
    first = rows[0]
    n_views, n = len(scene.test_views), len(model.gaussians.means)
    print(f"{scene.name}, {n_views} test views, {n:,} Gaussians, gaze in the middle\n")
    table = [
        [
            "everywhere" if row is first else f"{row['full']:g} degrees",
            *(f"{100 * row[name] / first[name]:.0f}" for name in ("n_samples", "n_pairs", "seconds")),
            f"{row['weighted_psnr']:.2f}",
            f"{row['psnr']:.2f}",
            "" if row is first else f"{row['weighted_psnr_of_whole']:.1f}",
        ]
        for row in rows
    ]
    heads = [
        "in full",
        "rays (%)",
        "pairs (%)",
        "time (%)",
        "weighted PSNR (dB)",
        "PSNR (dB)",
        "of the whole picture (dB)",
    ]
    print(markdown_table(heads, table))
    print()
    zones = [
        [
            f"{row['full']:g}",
            f"{zone['begins']:.1f}",
            str(zone["block"] ** 2),
            f"{zone['n_tiles']:,}",
            f"{zone['n_samples']:,}",
        ]
        for row in rows[1:]
        for zone in row["zones"]
    ]
    print(markdown_table(["in full (degrees)", "zone begins at", "pixels a ray", "tiles", "rays"], zones))


def add_yaw_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--ply``, ``--steps`` and ``--out``."""
    parser.add_argument("--ply", type=Path, required=True, metavar="FILE", help="point_cloud.ply of a run")
    parser.add_argument(
        "--steps", type=int, default=40, metavar="N", help="steps of a yaw of +-10 degrees (default 40)"
    )
    add_out(parser)


def run_yaw(args: argparse.Namespace) -> None:
    """Turn the first test camera of a run, write the results, and print a table.

    Raises
    ------
    InputError
        The PLY, the cameras beside it or the output folder cannot be used.
    """
    from minisplat_ref.extensions.vr import measures
    from minisplat_ref.io import viewpoints
    from minisplat_ref.io.ply import load_ply

    check_at_least(1, steps=args.steps)
    gaussians = load_ply(args.ply)
    cameras = [view.camera for view in viewpoints.read(args.ply.parent / "cameras.json") if view.split == "test"]
    if not cameras or not len(gaussians.means):
        raise InputError(f"{args.ply} has no Gaussians, or its cameras.json no test views: give the PLY of a run")
    with making_folder(args.out) as folder:
        found = measures.yaw_steps(gaussians, cameras[0], 6, 10.0, args.steps)
        result = {"gaussians": len(gaussians.means), "steps": args.steps, "ways": found}
        write(folder, result, measures.draw_yaw(found, 10.0))
    step, n = 20 / args.steps, len(gaussians.means)
    print(f"Largest change of a fixed ray's colour in a step of {step:g} degrees, {n:,} Gaussians\n")
    rows = [[method, f"{max(steps):.1e}", f"{sorted(steps)[len(steps) // 2]:.1e}"] for method, steps in found.items()]
    print(markdown_table(["method", "largest", "median of the steps"], rows))


FOVEATION = Study(
    "foveation", "work against PSNR with fewer rays away from the gaze", add_foveation_arguments, run_foveation
)
YAW = Study("yaw", "colours of fixed rays through a trained scene while the camera turns", add_yaw_arguments, run_yaw)
