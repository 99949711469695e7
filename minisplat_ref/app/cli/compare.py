"""``compare``: trains a scene by several recipes, and sets their results side by side."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from minisplat_ref.app.runs.options import N_ITERATIONS, Settings, add_settings
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import (
    Commands,
    HelpFormatter,
    add_worker_arguments,
    integer,
    list_of,
    name,
    option_name,
)

if TYPE_CHECKING:
    from minisplat_ref.app.comparison.plan import Plan
    from minisplat_ref.types import Scene

DEFAULTS: dict[str, Any] = {
    "iterations": (N_ITERATIONS,),
    "seeds": (Settings.seed,),
    "downscale": Settings.downscale,
    "test_every": Settings.test_every,
    "eval_every": None,
    "budget": None,
    "simplify": None,
    "scene_type": None,
    "lpips_weights": None,
    "init": None,
    "folds": None,
}

DESCRIPTION = """\
Train a scene by several recipes, in turn or by workers, and set the results
side by side. DIR will hold a run folder RECIPE-seedS for each training,
compare.json, the figures as PNG, the table as table.csv and table.tex, and
report.html with all of it.

The first recipe is what the others are compared with. With --folds K each is
trained K times (RECIPE-foldF-seedS), and each photograph is held out once.
After Ctrl-C or a crash --resume continues: finished trainings are kept, one
that was cut off continues.
"""
EPILOG = """\
examples:
  minisplat-ref compare photos/fox --recipes 3dgs-accel,mini-splatting2 \\
      --iterations 3000,1800 --seeds 0,1,2 --out runs/fox-compared
  minisplat-ref compare photos/fox --recipes adaptive,mini-splatting --folds 4 \\
      --out runs/fox-folds
  minisplat-ref compare --resume runs/fox-compared --workers 2"""

INTERRUPTED = 130  # exit code, of a training too

COMPARE, REPORT = "compare.json", "report.html"
TABLE_CSV, TABLE_TEX = "table.csv", "table.tex"
PSNR_OVER_TIME, PSNR_OVER_ITERATIONS = "psnr_over_time.png", "psnr_over_iterations.png"
PSNR_OVER_COUNT, CHAMFER_OVER_ITERATIONS = "psnr_over_count.png", "chamfer_over_iterations.png"
GALLERY = "gallery.png"


def add_parser(commands: Commands) -> None:
    """Add the command. Options that are not given are absent, so that ``--resume`` can tell."""
    parser = commands.add_parser(
        "compare",
        help="train a scene by several recipes and compare them",
        usage="minisplat-ref compare [-h] SCENE --recipes A,B --out DIR [options]\n"
        "       minisplat-ref compare --resume DIR",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument("scene", nargs="?", metavar="SCENE", help="folder of a scene, as for train")
    parser.add_argument("--recipes", type=list_of(name), metavar="A,B", help="names as in train --recipe")
    parser.add_argument("--out", type=Path, metavar="DIR", help="new folder for the results")
    parser.add_argument("--resume", type=Path, metavar="DIR", help="continue the comparison in DIR")
    parser.add_argument(
        "--iterations",
        type=list_of(integer(1)),
        metavar="N",
        help="of every training, or N,M with a number for each recipe (default 3000)",
    )
    parser.add_argument("--seeds", type=list_of(integer(0)), metavar="S,T", help="of the trainings (default 0)")
    parser.add_argument(
        "--eval-every", type=integer(1), metavar="K", help="measure test views each K-th (default 24 times in all)"
    )
    add_settings(
        parser,
        budget="as for train, for the recipes that simplify to one",
        simplify="likewise: sampling, rank or merging",
        scene_type="likewise: indoor or outdoor",
        downscale="make the photographs D times smaller (default {default})",
        test_every="hold out every K-th for testing (default {default})",
    )
    parser.add_argument("--folds", type=integer(2), metavar="K", help="train K times: hold out each photograph once")
    parser.add_argument("--init", type=Path, metavar="START", help="as for train: points or run to start from")
    parser.add_argument("--lpips-weights", type=Path, metavar="NPZ", help="as for train, which measures LPIPS by it")
    add_worker_arguments(parser)
    parser.set_defaults(run=run, needs=("matplotlib",))


def run(args: argparse.Namespace) -> int:
    """Train, measure, write the files, print the table."""
    from minisplat_ref.app.comparison.plan import check, remove_if_unused, save_plan
    from minisplat_ref.app.comparison.runs import statuses, train_all, train_by_workers, warm_up
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.cluster import Workers
    from minisplat_ref.training.interruption import terminated_like_interrupted

    given, workers = vars(args), Workers(args.workers, args.cluster)
    plan = _resume(given) if "resume" in given else _new(given)
    scene = check(plan)
    stages = statuses(plan)
    if any(stage != "finished" for stage in stages):
        warm_up(plan, scene)
    run_folder.create(plan.folder)
    save_plan(plan)
    try:
        with terminated_like_interrupted():
            code = train_by_workers(plan, stages, workers) if workers.is_used else train_all(plan, stages)
            if code == 0:
                _report(plan, scene)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except InputError:
        remove_if_unused(plan.folder)
        raise
    if code == INTERRUPTED:
        print(f"minisplat-ref: interrupted; to continue: minisplat-ref compare --resume {plan.folder}", file=sys.stderr)
    elif code != 0:
        remove_if_unused(plan.folder)
    return code


def _new(given: dict[str, Any]) -> "Plan":
    from minisplat_ref.app.comparison.plan import Plan, check_free

    for needed, example in (("scene", "a SCENE to train on"), ("recipes", "--recipes A,B"), ("out", "--out DIR")):
        if needed not in given:
            raise InputError(f"give {example}, or --resume DIR to continue a comparison")
    if "folds" in given and "test_every" in given:
        raise InputError("--folds K holds out every K-th photograph in turn: leave out --test-every")
    check_free(given["out"])
    options = {name: given.get(name, default) for name, default in DEFAULTS.items()}
    options["test_every"] = options["folds"] or options["test_every"]
    n_lengths = len(options["iterations"])
    options["iterations"] *= len(given["recipes"]) if n_lengths == 1 else 1  # a single number is for all
    return Plan(scene=Path(given["scene"]), folder=given["out"], recipes=given["recipes"], **options)


def _resume(given: dict[str, Any]) -> "Plan":
    from minisplat_ref.app.comparison.plan import load_plan

    surplus = [option_name(name) for name in ("scene", "recipes", "out", *DEFAULTS) if name in given]
    if surplus:
        raise InputError(f"--resume takes the comparison's own settings: leave out {', '.join(surplus)}")
    return load_plan(given["resume"])


def _report(plan: "Plan", scene: "Scene") -> None:
    """Write the figures, the page, the tables and compare.json, and print the tables."""
    from minisplat_ref.app.comparison import figures
    from minisplat_ref.app.comparison.report import fired_title, notes, report_html
    from minisplat_ref.app.comparison.results import collect, to_json
    from minisplat_ref.app.comparison.table import table_cells
    from minisplat_ref.app.comparison.table_files import csv_table, latex_table
    from minisplat_ref.app.reports.plots import save_png
    from minisplat_ref.app.runs import run_folder
    from minisplat_ref.app.runs.recipe_actions import HEADING, remarks, rows
    from minisplat_ref.interface.reporting import markdown_table

    results = collect(plan, scene)
    save_png(figures.psnr_over_time(results.curves), plan.folder / PSNR_OVER_TIME)
    save_png(figures.psnr_over_iterations(results.curves), plan.folder / PSNR_OVER_ITERATIONS)
    save_png(figures.psnr_over_count(results.curves), plan.folder / PSNR_OVER_COUNT)
    if figures.is_chamfer_known(results.curves):
        save_png(figures.chamfer_over_iterations(results.curves), plan.folder / CHAMFER_OVER_ITERATIONS)
    save_png(figures.gallery(results.crops, plan.recipes), plan.folder / GALLERY)
    (plan.folder / REPORT).write_text(report_html(plan, scene, results), encoding="utf-8")
    run_folder.write_json(plan.folder / COMPARE, to_json(plan, scene, results))
    title = f"{scene.name}; {results.machine}"
    (plan.folder / TABLE_CSV).write_text(csv_table(results.recipes), encoding="utf-8", newline="")
    (plan.folder / TABLE_TEX).write_text(latex_table(results.recipes, title), encoding="utf-8")
    heading, *cells = table_cells(results.recipes)
    print(f"\n{title}\n\n{markdown_table(heading, cells)}\n")
    print("\n".join(notes(plan, results)))
    for fired in results.fired:
        print(f"\n{fired_title(fired)}\n\n{markdown_table(HEADING, rows(fired))}")
        print("\n".join(remarks(fired)))
    print(f"\nopen {(plan.folder / REPORT).resolve()}")
