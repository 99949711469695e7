"""Measure the memory of a block's process when the scene has a large COLMAP model.

``python -m data_tools.measure_block_memory SCENE --blocks 2x2 --iterations 400 --observations 11000000 --out DIR``
copies a scene whose COLMAP model is text, with each observation in it as often as it takes to have that many, and
trains the copy in blocks. An observation that is repeated says nothing new, so that the training is that of the scene
itself, and only what reads the model takes longer and more. Printed is the most that each process has held
(``peak_rss_mb`` of its metrics.json: ``VmHWM`` on Linux).
"""

import argparse
import subprocess
import sys
from collections.abc import Iterable, Iterator
from itertools import repeat
from pathlib import Path

from minisplat_ref.app.blocks.plan import COARSE, load_block_training, load_plan
from minisplat_ref.app.runs import run_folder
from minisplat_ref.interface.reporting import describe_machine, markdown_table

MODEL = "sparse/0"
N_BEFORE_TRACK = 8  # words of a point's line: its number, place, colour and error
N_OF_TRACK = 2  # words of an element of a track: image, and place among its observations
N_OF_OBSERVATION = 3  # words of an observation: two coordinates and the point's number


def enlarge_model(scene: Path, copy: Path, n_observations: int) -> int:
    """Copy a scene, with each observation of its model as often; return how many observations there are now.

    Parameters
    ----------
    scene : Path
        With a COLMAP model as text.
    copy : Path
        A new folder. What is beside the model is linked.
    n_observations : int
        At least so many.
    """
    model, larger = scene / MODEL, copy / MODEL
    larger.mkdir(parents=True)
    for path in scene.iterdir():
        if path.name != "sparse":
            (copy / path.name).symlink_to(path.resolve())
    (larger / "cameras.txt").write_bytes((model / "cameras.txt").read_bytes())
    images = (model / "images.txt").read_text().splitlines()
    n_found = sum(len(line.split()) for line in images[1::2]) // N_OF_OBSERVATION
    times = -(-n_observations // n_found)
    observations = {images[i].split()[0]: len(images[i + 1].split()) // N_OF_OBSERVATION for i in _evens(images)}
    with open(larger / "images.txt", "w") as file:
        for i in _evens(images):
            file.write(images[i] + "\n" + " ".join(repeat(images[i + 1], times)) + "\n")
    with open(larger / "points3D.txt", "w") as file:
        for line in (model / "points3D.txt").read_text().splitlines():
            words = line.split()
            track = list(zip(words[N_BEFORE_TRACK::N_OF_TRACK], map(int, words[N_BEFORE_TRACK + 1 :: 2]), strict=True))
            elements = (f"{image} {k + turn * observations[image]}" for turn in range(times) for image, k in track)
            file.write(" ".join((*words[:N_BEFORE_TRACK], *elements)) + "\n")
    return times * n_found


def _evens(lines: list[str]) -> Iterable[int]:
    return range(0, len(lines), 2)


def peaks(folder: Path) -> Iterator[tuple[str, int, float]]:
    """Yield of each process of a training in blocks its name, its Gaussians, and its memory at most, MB."""
    plan, asked = load_plan(folder), load_block_training(folder)
    assert plan is not None
    names = (COARSE, *(planned.block.name for planned in plan.blocks))
    for name, run in (*((name, asked.run_folder_for(name)) for name in names), ("plan and merge", folder)):
        metrics = run_folder.read_json_object(run / run_folder.METRICS)
        yield name, metrics["n_gaussians"], metrics["peak_rss_mb"]


def main() -> None:
    """Copy, train, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--blocks", required=True)
    parser.add_argument("--iterations", type=int, required=True)
    parser.add_argument("--observations", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    scene, run = args.out / "scene", args.out / "run"
    n = enlarge_model(args.scene, scene, args.observations)
    words = ["train", str(scene), "--recipe", "3dgs-accel", "--iterations", str(args.iterations)]
    command = [sys.executable, "-m", "minisplat_ref", *words, "--blocks", args.blocks, "--out", str(run)]
    subprocess.run(command, check=True)
    n_bytes = sum(path.stat().st_size for path in (scene / MODEL).iterdir())
    print(f"{args.scene}, {n:,} observations, model of {n_bytes / 1e6:.0f} MB; {describe_machine()}\n")
    rows = [[name, f"{n_gaussians:,}", f"{megabytes:.0f}"] for name, n_gaussians, megabytes in peaks(run)]
    print(markdown_table(("process", "Gaussians", "peak memory (MB)"), rows))


if __name__ == "__main__":
    main()
