"""``python -m data_tools.same_speed BEFORE``: compare how fast this tree and another worktree of it are.

For refactors that must not cost time: training iterations, the passes of ``bench``, and the seconds from the program's
start to its end after one iteration, with compiled kernels and without. The two trees alternate, so that both meet the
same machine; the table has the least time of each, and the median and range of the ratios of single rounds. Each tree
has its own folder of kernels.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from minisplat_ref.interface.reporting import describe_machine, markdown_table

SCENE = ("--views", "8", "--width", "320", "--height", "240", "--points", "10000", "--test-every", "4")
WARM_UP, ITERATIONS = 20, 100
RATE = f"""
import sys, time
from minisplat_ref.io import load_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.training.loop import train
times = []
recipe = get_recipe("3dgs-accel")._replace(iterations={WARM_UP + ITERATIONS}, events=())
train(load_scene(sys.argv[1]), recipe, seed=0, on_step=lambda _: times.append(time.perf_counter()))
print((times[-1] - times[{WARM_UP - 1}]) / {ITERATIONS})
"""
"""Seconds of an iteration on 10,000 Gaussians, whose number stays; it uses only what both trees have."""


class Tree(NamedTuple):
    """A worktree, and where its compiled kernels are."""

    root: Path
    kernels: Path

    def run(self, *arguments: str, kernels: Path | None = None) -> str:
        """Run Python in the tree, and return what it prints."""
        environment = os.environ | {"PYTHONPATH": str(self.root), "NUMBA_CACHE_DIR": str(kernels or self.kernels)}
        command = [sys.executable, *arguments]
        return subprocess.run(
            command, cwd=self.root, env=environment, stdout=subprocess.PIPE, text=True, check=True
        ).stdout


def time_iteration(tree: Tree, scene: Path, folder: Path) -> dict[str, float]:
    """Return the seconds of a training iteration."""
    return {"iteration, 10,000 Gaussians in 320 x 240": float(tree.run("-c", RATE, str(scene)))}


def time_bench(tree: Tree, scene: Path, folder: Path) -> dict[str, float]:
    """Return the seconds of the passes of ``bench`` on one workload."""
    out = folder / "bench.json"
    tree.run("-m", "minisplat_ref", "bench", "--workloads", "synth5k", "--backends", "cpu-f32", "--json", str(out))
    figures = json.loads(out.read_text())["cases"][-1]  # after the reference
    return {f"bench synth5k, {name}": figures[f"least {name} ms"] / 1e3 for name in ("forward", "both")}


def time_start(tree: Tree, scene: Path, folder: Path) -> dict[str, float]:
    """Return the seconds of a training of one iteration, from start to end of the program."""
    return {"one iteration, kernels cached": _start(tree, scene, folder / "warm", tree.kernels)}


def time_cold_start(tree: Tree, scene: Path, folder: Path) -> dict[str, float]:
    """Return the same without any compiled kernel."""
    return {"one iteration, no kernels": _start(tree, scene, folder / "cold", folder / "kernels")}


def _start(tree: Tree, scene: Path, out: Path, kernels: Path) -> float:
    start = time.perf_counter()
    options = ("--recipe", "3dgs-accel", "--iterations", "1", "--out", str(out))
    tree.run("-m", "minisplat_ref", "train", str(scene), *options, kernels=kernels)
    return time.perf_counter() - start


def main() -> None:
    """Time both trees, alternating, and print a table."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.same_speed", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("before", type=Path, metavar="BEFORE", help="another worktree")
    parser.add_argument("--rounds", type=int, default=3, metavar="N", help="of each measurement (default 3)")
    parser.add_argument("--cold", action="store_true", help="also without compiled kernels, which takes minutes")
    args = parser.parse_args()
    with TemporaryDirectory() as name:
        roots = (args.before.resolve(), Path(__file__).resolve().parents[1])
        trees = [Tree(root, Path(name, f"kernels{i}")) for i, root in enumerate(roots)]
        scene = Path(name, "room")
        trees[0].run("-m", "minisplat_ref", "synthetic", "room", "--out", str(scene), *SCENE)
        tasks = [time_iteration, time_bench, time_start, *([time_cold_start] if args.cold else [])]
        for tree in trees:
            time_iteration(tree, scene, Path(name))  # compiles
            time_bench(tree, scene, Path(name))
        seconds: dict[str, list[list[float]]] = {}
        for i in range(args.rounds):
            for j, tree in list(enumerate(trees))[:: 1 if i % 2 else -1]:
                for task in tasks:
                    with TemporaryDirectory(dir=name) as folder:
                        for what, value in task(tree, scene, Path(folder)).items():
                            seconds.setdefault(what, [[], []])[j].append(value)
    rows = []
    for what, (before, now) in seconds.items():
        ratios = [b / a for a, b in zip(before, now, strict=True)]
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        rows.append(
            [what, *(f"{1e3 * min(v):,.1f}" for v in (before, now)), f"{statistics.median(ratios):.2f}", spread]
        )
    print(f"{describe_machine()}; {args.rounds} rounds\n")
    print(markdown_table(["what", "before, ms", "now, ms", "ratio", "of single rounds"], rows))


if __name__ == "__main__":
    main()
