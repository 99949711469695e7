"""Lego image by image: PSNR of the test images of runs, beside that of a rerun of the released 3DGS by others.

``python -m data_tools.published_images RUN [RUN ...]`` reads the metrics of runs that have ended, or what
``minisplat-ref eval RUN --out DIR`` has written of one that was stopped. A mean can agree by chance; two renderers that
agree image by image find the same images hard.

``published_lego.csv`` has the PSNR of 157 of the 200 test images, from the raw metrics in
``gaussian-splatting/blender/lego.json`` of jkulhanek/nerfbaselines on Hugging Face, at f84852e, read in a copy that
breaks off after them. It does not name the images. Read in the order of the file names, r_0, r_1, r_10, r_100, and so
on, its numbers are a smooth curve over the cameras, which go around the model, except at r_125, where those of our runs
are not smooth either. The mean of all 200 is 35.70 dB there.
"""

import argparse
import csv
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.runs.run_folder import METRICS, read_json_object
from minisplat_ref.errors import InputError
from minisplat_ref.interface.reporting import markdown_table

PUBLISHED = Path(__file__).with_name("published_lego.csv")


def read_published() -> dict[str, float]:
    """Return the published PSNR of test images, dB, by the name of the image."""
    with PUBLISHED.open(encoding="utf-8", newline="") as file:
        return {row["image"]: float(row["psnr"]) for row in csv.DictReader(file)}


class Agreement(NamedTuple):
    """The PSNR of a run's test images beside the published one."""

    n: int
    """Images that have both."""
    published: float
    """Mean over them, dB."""
    ours: float
    """Mean over them, dB."""
    spread: float
    """Standard deviation of the differences, ours minus published, dB."""
    correlation: float
    """Pearson's, of the two over the images."""
    lowest: tuple[str, float]
    """Image where ours is lowest beside the published one, and the difference, dB."""
    highest: tuple[str, float]
    """Where it is highest."""


def compare(folder: Path) -> Agreement:
    """Compare the test images of a run with the published ones.

    Raises
    ------
    InputError
        There are no metrics, or fewer than three of the test images are published.
    """
    if not (folder / METRICS).is_file():
        raise InputError(f"{folder} has no {METRICS}: give the --out folder of a training that has ended")
    metrics = read_json_object(folder / METRICS)
    ours = {view["name"].removeprefix("test_"): view["psnr"] for view in metrics["per_view"]}
    published = read_published()
    names = [name for name in published if name in ours]
    if len(names) < 3:
        raise InputError(f"{folder} has {len(names)} test images with a published figure: it is not of Lego")
    theirs, found = np.array([(published[name], ours[name]) for name in names]).T
    differences = found - theirs
    low, high = int(differences.argmin()), int(differences.argmax())
    return Agreement(
        len(names),
        float(theirs.mean()),
        float(found.mean()),
        float(differences.std(ddof=1)),
        float(np.corrcoef(theirs, found)[0, 1]),
        (names[low], float(differences[low])),
        (names[high], float(differences[high])),
    )


HEADING = ["run", "images", "published (dB)", "ours (dB)", "spread (dB)", "correlation", "lowest", "highest"]


def main(arguments: list[str] | None = None) -> int:
    """Compare runs image by image."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.published_images", description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="--out folder of a training on Lego")
    args = parser.parse_args(arguments)
    rows = []
    try:
        for folder in args.runs:
            found = compare(folder)
            means = [f"{x:.2f}" for x in (found.published, found.ours, found.spread)]
            ends = [f"{name} {difference:+.2f}" for name, difference in (found.lowest, found.highest)]
            rows.append([folder.name, str(found.n), *means, f"{found.correlation:.3f}", *ends])
    except InputError as error:
        print(f"published_images: error: {error}", file=sys.stderr)
        return 2
    print(markdown_table(HEADING, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
