"""``compare``: trains a scene by several recipes, and sets their results side by side."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from minisplat_ref.experiments.arguments import Commands, HelpFormatter, integer, listed, name

DESCRIPTION = """\
Train a scene by several recipes, one training after the other, and set the
results side by side. DIR will hold a run folder RECIPE-seedS for each training,
compare.json, the figures as PNG, and report.html with all of it.

The first recipe is what the others are compared with.
"""
EPILOG = """\
example:
  minisplat-ref compare photos/fox --recipes 3dgs-accel,mini-splatting2 \\
      --iterations 3000,1800 --seeds 0,1,2 --out runs/fox-compared"""

COMPARE, REPORT = "compare.json", "report.html"
PSNR_OVER_TIME, PSNR_OVER_COUNT, GALLERY = "psnr_over_time.png", "psnr_over_count.png", "gallery.png"


def add_parser(commands: Commands) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "compare",
        help="train a scene by several recipes and compare them",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="folder of a scene, as for train")
    parser.add_argument("--recipes", type=listed(name), required=True, metavar="A,B", help="names as in train --recipe")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the results")
    parser.add_argument(
        "--iterations",
        type=listed(integer(1)),
        default=(3000,),
        metavar="N",
        help="of every training, or N,M with a number for each recipe (default 3000)",
    )
    parser.add_argument(
        "--seeds", type=listed(integer(0)), default=(0,), metavar="S,T", help="of the trainings (default 0)"
    )
    parser.add_argument(
        "--budget", type=integer(1), metavar="N", help="as for train, for the recipes that simplify to one"
    )
    parser.add_argument(
        "--simplify", choices=("sampling", "rank", "merging"), metavar="S", help="likewise: sampling, rank or merging"
    )
    parser.add_argument("--scene-type", choices=("indoor", "outdoor"), metavar="T", help="likewise: indoor or outdoor")
    parser.add_argument(
        "--downscale", type=integer(1), default=1, metavar="D", help="make the photographs D times smaller (default 1)"
    )
    parser.add_argument(
        "--test-every", type=integer(0), default=8, metavar="K", help="hold out every K-th for testing (default 8)"
    )
    parser.add_argument("--init", type=Path, metavar="PLY", help="as for train: points to start from")
    parser.add_argument("--lpips-weights", type=Path, metavar="NPZ", help="as for train, which measures LPIPS by it")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, measure, write the files, print the table."""
    from minisplat_ref.experiments import run_folder
    from minisplat_ref.experiments.comparison.plan import Plan, check
    from minisplat_ref.experiments.comparison.runs import train_all, warm_up

    plan = Plan(
        scene=args.scene,
        folder=args.out,
        recipes=args.recipes,
        iterations=_for_each(args.iterations, len(args.recipes)),
        seeds=args.seeds,
        downscale=args.downscale,
        test_every=args.test_every,
        budget=args.budget,
        simplify=args.simplify,
        scene_type=args.scene_type,
        lpips_weights=args.lpips_weights,
        init=args.init,
    )
    scene = check(plan)
    warm_up(plan, scene)
    run_folder.create(plan.folder)
    code = train_all(plan)
    if code != 0:
        if not any(plan.folder.iterdir()):  # the first training was refused
            plan.folder.rmdir()
        return code

    from minisplat_ref.experiments.comparison import figures
    from minisplat_ref.experiments.comparison.report import notes, report_html
    from minisplat_ref.experiments.comparison.results import collect, to_json
    from minisplat_ref.experiments.comparison.table import table_cells
    from minisplat_ref.experiments.plots import save_png
    from minisplat_ref.reporting import markdown_table

    results = collect(plan, scene)
    save_png(figures.psnr_over_time(results.curves), plan.folder / PSNR_OVER_TIME)
    save_png(figures.psnr_over_count(results.curves), plan.folder / PSNR_OVER_COUNT)
    save_png(figures.gallery(results.crops, plan.recipes), plan.folder / GALLERY)
    (plan.folder / REPORT).write_text(report_html(plan, scene, results), encoding="utf-8")
    run_folder.write_json(plan.folder / COMPARE, to_json(plan, scene, results))
    heading, *rows = table_cells(results.recipes)
    print(f"\n{scene.name}; {results.machine}\n\n{markdown_table(heading, rows)}\n")
    print("\n".join(notes(plan, results)))
    print(f"open {(plan.folder / REPORT).resolve()}")
    return 0


def _for_each(iterations: Sequence[int], n_recipes: int) -> tuple[int, ...]:
    """Repeat a single number for all recipes."""
    return tuple(iterations) * (n_recipes if len(iterations) == 1 else 1)
