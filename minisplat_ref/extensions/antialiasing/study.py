"""The study ``antialiasing/zoom`` measures what filters and integrals gain at other sizes than the trained one."""

import argparse

import numpy as np

from minisplat_ref.extensions.shared_studies import add_scene, check_at_least, read_scene, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scene and the trainings."""
    add_scene(parser, downscale=4, iterations=1000)


def run(args: argparse.Namespace) -> None:
    """Train, measure, write the results, and print a table.

    Raises
    ------
    InputError
        The scene or the output folder cannot be used, or a number is too small.
    """
    from minisplat_ref.extensions.antialiasing import zoom

    check_at_least(1, downscale=args.downscale, iterations=args.iterations, seeds=args.seeds)
    scene = read_scene(args.scene)
    with making_folder(args.out) as folder:
        found = zoom.measure(scene, args.downscale, args.iterations, args.seeds)
        settings = {key: getattr(args, key) for key in ("scene", "downscale", "iterations", "seeds")}
        write(folder, {**settings, **zoom.summarise(found)}, zoom.draw(found))
    print("PSNR (dB) of test views: mean over the seeds ± half their range\n")
    rows = [
        [name, f"{np.mean(found.counts[name]):,.0f}", *(_mean_and_spread(values) for values in zip(*runs, strict=True))]
        for name, runs in found.psnr.items()
    ]
    print(markdown_table(["recipe", "Gaussians", *(f"x {zoom:g}" for zoom in found.zooms)], rows))


def _mean_and_spread(values: tuple[float, ...]) -> str:
    return f"{np.mean(values):.2f} ± {np.ptp(values) / 2:.2f}"


ZOOM = Study("zoom", "a scene seen from farther and nearer than in training", add_arguments, run)
