"""The measurements that docs/measured reports of whole training runs on real scenes.

``python -m data_tools.measure scenes SCENE... --out DIR`` trains every scene through the command line, as a user would,
and prints a table. ``python -m data_tools.measure rate SCENE`` times training iterations while the number of Gaussians
stays the same. Times depend on the machine; compare figures of one run only. ``minisplat-ref bench`` measures stages
beside their errors, :mod:`data_tools.machine` what this machine's limits are.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.loop import train

WARM_UP = 20  # iterations that compile and are not timed


def measure_scenes(
    scenes: list[Path], out: Path, recipe: str, iterations: int, lpips_weights: Path | None = None
) -> None:
    """Train each scene through the command line into ``out/NAME`` and print a table of their ``metrics.json``."""
    rows = []
    options = ["--recipe", recipe, "--iterations", str(iterations)]
    if lpips_weights is not None:
        options += ["--lpips-weights", str(lpips_weights)]
    for scene in scenes:
        folder = out / scene.name
        command = [sys.executable, "-m", "minisplat_ref", "train", str(scene), "--out", str(folder)]
        subprocess.run([*command, *options], check=True)
        metrics = json.loads((folder / "metrics.json").read_text())
        rate = metrics["iterations"] / metrics["train_seconds"]
        rows.append(
            [
                scene.name,
                f"{metrics['psnr']:.2f}",
                f"{metrics['ssim']:.3f}",
                *([] if lpips_weights is None else [f"{metrics['lpips']:.3f}"]),
                f"{metrics['n_gaussians']:,}",
                f"{metrics['train_seconds']:.0f}",
                f"{rate:.1f}",
                f"{metrics['peak_rss_mb']:.0f}",
            ]
        )
    print(f"\n{recipe}, {iterations} iterations, seed 0, full size; {describe_machine()}\n")
    lpips = () if lpips_weights is None else ("LPIPS",)
    heading = ("scene", "PSNR (dB)", "SSIM", *lpips, "Gaussians", "seconds", "iterations/s", "peak memory (MB)")
    print(markdown_table(heading, rows))


def measure_rate(scene_folder: Path, n: int, iterations: int) -> None:
    """Print how many training iterations a second there are while the number of Gaussians stays at ``n``."""
    scene = load_scene(scene_folder)
    chosen = np.random.default_rng(0).choice(len(scene.points), n, replace=False)
    scene = scene._replace(points=scene.points[chosen], point_colors=scene.point_colors[chosen])
    recipe = get_recipe("3dgs-accel")._replace(iterations=WARM_UP + iterations, events=())
    times: list[float] = []
    train(scene, recipe, seed=0, on_step=lambda _: times.append(time.perf_counter()))
    seconds = np.diff(times[WARM_UP - 1 :])
    camera = scene.train_views[0].camera
    print(
        f"{scene.name}, {camera.width} x {camera.height}, {n} Gaussians, {iterations} iterations; {describe_machine()}"
    )
    print(f"{iterations / seconds.sum():.1f} iterations/s, median {1e3 * np.median(seconds):.1f} ms")


def main() -> None:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.measure", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    scenes = commands.add_parser("scenes", help="train scenes and print PSNR, SSIM, count, time and memory")
    scenes.add_argument("scene", type=Path, nargs="+")
    scenes.add_argument("--out", type=Path, required=True, help="new folder for the runs")
    scenes.add_argument("--recipe", default="3dgs-accel")
    scenes.add_argument("--iterations", type=int, default=3_000)
    scenes.add_argument("--lpips-weights", type=Path, help="measure LPIPS, too: see minisplat-ref eval --help")
    rate = commands.add_parser("rate", help="training iterations per second at a constant number of Gaussians")
    rate.add_argument("scene", type=Path)
    rate.add_argument("--gaussians", type=int, default=10_000)
    rate.add_argument("--iterations", type=int, default=300)
    arguments = parser.parse_args()
    if arguments.command == "rate":
        measure_rate(arguments.scene, arguments.gaussians, arguments.iterations)
    else:
        measure_scenes(arguments.scene, arguments.out, arguments.recipe, arguments.iterations, arguments.lpips_weights)


if __name__ == "__main__":
    main()
