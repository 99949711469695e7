"""Say how long a training in blocks takes on several machines, on paper, by the times of one that has ended.

``python -m data_tools.block_times RUN --machines 1,2,4,8,16`` takes the processor seconds of the coarse model and of
each block, as machines of one thread would take them, and gives the next block, in the order of the plan, to the
machine that is free first, as ``train --blocks --cluster`` does. Plan and merge, with the training of the merged model,
are not divided: their seconds are those between files of RUN, so RUN must not have been interrupted there. What goes
over the network is what a block reads (its part of the scene, the coarse model, its photographs) and what the merge
reads of it; waiting for that is left out.
"""

import argparse
import heapq
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from data_tools.measure_blocks import CPU_TIME
from minisplat_ref.app.blocks.plan import COARSE, PLAN, load_block_training, load_plan
from minisplat_ref.app.runs import run_folder
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import integer
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.io.colmap import image_folder

HEADING = ("machines", "coarse (s)", "plan (s)", "blocks (s)", "merge (s)", "together (s)", "times as fast", "at work")


class Phases(NamedTuple):
    """Seconds and bytes of a training in blocks."""

    coarse: float
    plan: float
    blocks: tuple[float, ...]
    """In the order of the plan."""
    merge: float
    n_read: tuple[int, ...]
    """Bytes that each block reads."""
    n_written: tuple[int, ...]
    """Bytes that the merge reads of each block."""


def time_of_blocks(seconds: Sequence[float], n_machines: int) -> float:
    """Return when the last block ends if each goes to the machine that is free first."""
    free_at = [0.0] * n_machines
    for block in seconds:
        heapq.heappush(free_at, heapq.heappop(free_at) + block)
    return max(free_at)


def read_phases(run: Path) -> Phases:
    """Read the phases of a training in blocks.

    Raises
    ------
    InputError
        There is none in the folder, or it has not ended.
    """
    plan = load_plan(run) if (run / PLAN).is_file() else None
    if plan is None or not (run / run_folder.METRICS).is_file():
        raise InputError(f"{run}: no training in blocks that has ended; `minisplat-ref train --blocks` makes one")
    training = load_block_training(run)
    photographs = [file for file in image_folder(Path(training.settings.scene)).rglob("*") if file.is_file()]
    coarse = training.run_folder_for(COARSE)
    seconds, n_read, n_written, ends = [], [], [], []
    for name in (planned.block.name for planned in plan.blocks):
        folder = training.run_folder_for(name)
        part = folder.with_suffix(".json")
        shown = {shown_name for shown_name, *_ in run_folder.read_json_object(part)["masks"]}
        first = run_folder.CHECKPOINT if training.is_continued else run_folder.POINT_CLOUD
        files = [part, folder.with_suffix(".npz"), coarse / first]
        files += [file for file in photographs if file.stem in shown]
        seconds.append(run_folder.read_json_object(folder / run_folder.METRICS)[CPU_TIME])
        n_read.append(sum(file.stat().st_size for file in files))
        merged = [run_folder.POINT_CLOUD, *([run_folder.CHECKPOINT] if training.is_continued else [])]
        n_written.append(sum((folder / file).stat().st_size for file in merged))
        ends.append((folder / run_folder.METRICS).stat().st_mtime)
    return Phases(
        coarse=run_folder.read_json_object(coarse / run_folder.METRICS)[CPU_TIME],
        plan=(run / PLAN).stat().st_mtime - (coarse / run_folder.METRICS).stat().st_mtime,
        blocks=tuple(seconds),
        merge=(run / run_folder.METRICS).stat().st_mtime - max(ends),
        n_read=tuple(n_read),
        n_written=tuple(n_written),
    )


def row_of(phases: Phases, n_machines: int) -> list[str]:
    """Return the cells of a number of machines, in the order of HEADING."""
    alone = phases.coarse + phases.plan + phases.merge
    one, several = (alone + time_of_blocks(phases.blocks, n) for n in (1, n_machines))
    blocks = time_of_blocks(phases.blocks, n_machines)
    numbers = (phases.coarse, phases.plan, blocks, phases.merge, several)
    share = (alone + sum(phases.blocks)) / (n_machines * several)
    return [str(n_machines), *(f"{number:.0f}" for number in numbers), f"{one / several:.2f}", f"{share:.0%}"]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.block_times", description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="folder of `minisplat-ref train --blocks`, which has ended")
    parser.add_argument("--machines", default="1,2,4,8,16", help="numbers of machines (default %(default)s)")
    args = parser.parse_args(arguments)
    try:
        numbers = [integer(1)(word) for word in args.machines.split(",")]
        phases = read_phases(args.run)
    except (InputError, argparse.ArgumentTypeError) as error:
        print(f"block_times: error: {error}", file=sys.stderr)
        return 2
    print(f"{describe_machine()}\n\n{markdown_table(HEADING, [row_of(phases, n) for n in numbers])}")
    read, written = sum(phases.n_read) / 1e6, sum(phases.n_written) / 1e6
    print(f"\n{len(phases.blocks)} blocks read {read:.0f} MB and write {written:.0f} MB; the longest takes", end=" ")
    print(f"{max(phases.blocks):.0f} s, the shortest {min(phases.blocks):.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
