"""The study ``multi-scale/downscale`` measures what levels gain in small pictures, and what they save."""

import argparse

import numpy as np

from minisplat_ref.extensions.shared_studies import add_scene, check_at_least, read_scene, write
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.reporting import markdown_table
from minisplat_ref.studies.study import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scene and the trainings."""
    add_scene(parser, downscale=1, iterations=1000)


def run(args: argparse.Namespace) -> None:
    """Train, measure, write the results, and print a table.

    Raises
    ------
    InputError
        The scene or the output folder cannot be used, or a number is too small.
    """
    from minisplat_ref.extensions.multi_scale import downscale

    check_at_least(1, downscale=args.downscale, seeds=args.seeds)
    check_at_least(10, iterations=args.iterations)
    scene = read_scene(args.scene, args.downscale)
    with making_folder(args.out) as folder:
        found = downscale.measure(scene, args.iterations, args.seeds)
        settings = {key: getattr(args, key) for key in ("scene", "downscale", "iterations", "seeds")}
        write(folder, {**settings, **downscale.summarise(found)}, downscale.draw(found))
    print("PSNR (dB) of test views, and thousands of pairs and of hits per view: means over the seeds\n")
    rows = []
    for name, runs in found.figures.items():
        psnr, pairs, hits = np.moveaxis(np.mean(np.array(runs), axis=0), -1, 0)  # [blocks] each
        cells = [f"{p:.2f}, {n / 1e3:.1f}, {h / 1e3:.0f}" for p, n, h in zip(psnr, pairs, hits, strict=True)]
        rows.append([name, f"{np.mean(found.counts[name]):,.0f}", *cells])
    print(markdown_table(["", "Gaussians", "1", *(f"1/{n}" for n in found.blocks[1:])], rows))


DOWNSCALE = Study("downscale", "a trained scene in smaller pictures, with and without levels", add_arguments, run)
