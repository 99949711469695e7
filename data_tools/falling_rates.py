"""The error of held-out views while the rates of ``adaptive`` fall, beside what the prune's line predicts.

A run in which nothing is removed meanwhile is made by ``minisplat-ref train SCENE --recipe adaptive --set max_pruned=0
--set min_views=0 --set max_psnr_cost=9 --set max_ssim_cost=1 --out RUN``. ``python -m data_tools.falling_rates RUN
[RUN ...]`` then prints, for each of the moments at which a slice could be removed, the factor of the means' rate, the
PSNR of the held-out views, and what :func:`minisplat_ref.methods.adaptive.prune.predict_unpruned` predicts from the
first N_FITTED of them. In a run that was pruned, the difference is what that cost.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from minisplat_ref.app.runs import run_folder
from minisplat_ref.errors import InputError
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.methods.adaptive.prune import N_FITTED, predict_unpruned
from minisplat_ref.methods.adaptive.recipe import ADAPTIVE
from minisplat_ref.training.pace import pace_from_json


def rows_of(folder: Path) -> list[list[str]]:
    """Return the row of each moment of a run: its name, rate, Gaussians, PSNR, prediction and difference, SSIM's, too.

    Raises
    ------
    InputError
        The run has not come to a slice.
    """
    file = folder / run_folder.DECISIONS
    if not file.is_file():
        raise InputError(f"{file} is missing: give the --out folder of a training of adaptive that has ended")
    pace = pace_from_json(run_folder.read_json_object(file))
    measured = pace.while_cooling
    if len(measured) <= N_FITTED or ADAPTIVE.cooling is None:
        raise InputError(f"{folder} was measured {len(measured)} times while its rates fell: {N_FITTED + 1} are needed")
    rates = [ADAPTIVE.cooling.factors(m.step, pace)[1] for m in measured]
    predicted = predict_unpruned(10.0 ** (-np.array([m.psnrs for m in measured]) / 10.0), rates)
    psnrs = (-10.0 * np.log10(predicted)).mean(axis=1)
    ssims = 1.0 - predict_unpruned(1.0 - np.array([m.ssims for m in measured]), rates).mean(axis=1)
    return [
        [
            folder.name,
            f"{rate / rates[0]:.3f}",
            f"{m.n_gaussians:,}",
            f"{m.psnr:.2f}",
            f"{psnr:.2f}",
            f"{m.psnr - psnr:+z.2f}",
            f"{m.ssim - ssim:+z.4f}",
        ]
        for m, rate, psnr, ssim in zip(measured, rates, psnrs, ssims, strict=True)
    ]


HEADING = ["run", "rate", "Gaussians", "held out (dB)", "predicted", "difference", "of SSIM"]


def main(arguments: list[str] | None = None) -> int:
    """Print the moments of runs."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.falling_rates", description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="--out folder of a training of adaptive")
    args = parser.parse_args(arguments)
    try:
        rows = [row for folder in args.runs for row in rows_of(folder)]
    except InputError as error:
        print(f"falling_rates: error: {error}", file=sys.stderr)
        return 2
    print(markdown_table(HEADING, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
