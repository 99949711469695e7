"""``python -m data_tools.same_results BEFORE``: compare what this tree computes with another worktree of it.

For refactors that must change nothing. In both trees, every recipe trains a small synthetic scene, and every check of
the oracle is run; then Gaussians are compared byte by byte, and figures to the last digit. Times are left out, and so
are words, which a refactor may change.
"""

import argparse
import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from minisplat_ref.extensions import folders
from minisplat_ref.extensions.extension import load_extension
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods import RECIPES

SCENE = ("--views", "8", "--width", "64", "--height", "48", "--points", "400", "--test-every", "4")
ITERATIONS = 300
CHECKS = ("gradients", "hard-cases", "truth")
TIMES = {"seconds", "ms", "time", "rate", "memory"}  # words in the names of figures that no two runs share


def recipe_options() -> dict[str, list[str]]:
    """Return the options of ``train`` for each recipe of the core and of the extensions, by its name."""
    options = {name: ["--recipe", name] for name in RECIPES}
    for name in folders():
        options |= {
            recipe.name: ["--extension", name, "--recipe", recipe.name] for recipe in load_extension(name).recipes
        }
    return options


def run(tree: Path, *arguments: str) -> int:
    """Run a command of the package in a tree; return its exit code, where 1 is a check's verdict, and 2 a refusal."""
    command = [sys.executable, "-m", "minisplat_ref", *arguments]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1, 2):
        raise RuntimeError(f"{' '.join(command)} in {tree} ended with {done.returncode}:\n{done.stderr}")
    return done.returncode


def train(tree: Path, scene: Path, options: list[str], out: Path, iterations: int) -> dict[str, Any]:
    """Train, and return what must not change; of a recipe that needs more than a scene, that it is refused."""
    words = ("train", str(scene), *options, "--iterations", str(iterations), "--seed", "0", "--out", str(out))
    if run(tree, *words) == 2:
        return {"is_refused": True}
    metrics = json.loads((out / "metrics.json").read_text())
    bytes_of_model = (out / "point_cloud.ply").read_bytes()
    return {"sha256": hashlib.sha256(bytes_of_model).hexdigest()[:16], "psnr": metrics["psnr"], "ssim": metrics["ssim"]}


def check(tree: Path, name: str, out: Path) -> Any:
    """Run a check of the oracle, and return the figures of its report."""
    run(tree, "oracle", name, "--json", str(out))
    return figures_of(json.loads(out.read_text()))


def figures_of(value: Any) -> Any:
    """Return a JSON value without words, and without entries that are times, memory or the machine."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if not TIMES & set(re.findall(r"[a-z]+", k.lower()))}
        return {k: figures_of(v) for k, v in kept.items() if not isinstance(v, str)}
    return [figures_of(item) for item in value if not isinstance(item, str)] if isinstance(value, list) else value


def describe(result: Any) -> str:
    """Return a result in few words."""
    if isinstance(result, dict) and "is_refused" in result:
        return "needs more than a scene"
    return (
        f"{result['psnr']:.3f} dB, {result['sha256']}" if isinstance(result, dict) and "sha256" in result else "figures"
    )


def main() -> None:
    """Compare, print a table, and exit with 1 if anything differs."""
    parser = argparse.ArgumentParser(
        prog="python -m data_tools.same_results", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("before", type=Path, metavar="BEFORE", help="another worktree")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, metavar="N", help="per training (default 300)")
    args = parser.parse_args()
    trees = [args.before.resolve(), Path(__file__).resolve().parents[1]]
    rows, n_different = [], 0
    with TemporaryDirectory() as name, ThreadPoolExecutor(2) as both:
        scene = Path(name, "room")
        run(trees[0], "synthetic", "room", "--out", str(scene), *SCENE)
        tasks: dict[str, list[Callable[[], Any]]] = {}
        for recipe, options in recipe_options().items():
            outs = [Path(name, f"{i}-{recipe}") for i in range(2)]
            pairs = zip(trees, outs, strict=True)
            tasks[recipe] = [partial(train, tree, scene, options, out, args.iterations) for tree, out in pairs]
        for checked in CHECKS:
            outs = [Path(name, f"{i}-{checked}.json") for i in range(2)]
            tasks[f"oracle {checked}"] = [
                partial(check, tree, checked, out) for tree, out in zip(trees, outs, strict=True)
            ]
        for what, calls in tasks.items():
            before, now = both.map(lambda call: call(), calls)
            n_different += before != now
            shown = describe(now)
            rows.append([what, shown, "same" if before == now else "DIFFERENT"])
            print(*rows[-1], sep="\t", file=sys.stderr, flush=True)
    print(markdown_table(["what", "now", "compared"], rows))
    sys.exit(n_different > 0)


if __name__ == "__main__":
    main()
