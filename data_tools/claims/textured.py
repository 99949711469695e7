"""Claims ``textured/counts`` and ``textured/limb`` (Textured-GS, arXiv 2407.09733).

``counts`` measures what textures gain at an equal number of Gaussians, and at an equal number of floats. The Gaussians
come from a training with Mini-Splatting or from a PLY. They are fine-tuned for the same number of iterations without
textures, with textures instead of view-dependent colour (the paper's form), and with both; textures of degree 1 and 2
are tried, too. Then only this many of the most important Gaussians are kept that the textured ones have no more floats
than the plain ones had. With ``--frozen`` positions and shapes stay.

``limb`` asks whether the colour jumps where rays begin to miss the ellipsoid. A row of rays crosses the limb of one
Gaussian; the largest change from one to the next is compared with that of a texture that ends at the limb.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit import claim
from data_tools.claims.kit.figures import subplots
from data_tools.claims.kit.tables import mean, spread, table
from minisplat_ref.extensions.textured.model import frames, meet
from minisplat_ref.extensions.textured.recipe import fine_tune, measure, prepare
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.strategy.importance import collect_importance, indoor
from minisplat_ref.strategy.ops import take
from minisplat_ref.strategy.simplify import most_important
from minisplat_ref.types import Camera, Floats, Gaussians, Scene

PLAIN = "3DGS"
PAPER, BOTH = "textures for view", "textures and view"
COLORS = {PLAIN: GREY, PAPER: RED, BOTH: BLUE}
STEPS = (0.1, 0.01, 0.001)  # px from ray to ray
COLUMNS = (
    ("number", mean("n_gaussians")),
    ("floats", mean("n_floats")),
    ("test PSNR", spread("psnr", 2)),
    ("test SSIM", spread("ssim", 4)),
    ("training PSNR", spread("training_psnr", 2)),
)


def run(args: argparse.Namespace) -> kit.Report:
    """Train, fine-tune and measure."""
    scene = kit.read_scene(args.scene, args.downscale)
    wholes = kit.populations(args, scene)
    fine_tuned = partial(fine_tune, scene=scene, iterations=args.fine_tune, is_frozen=args.frozen)
    runs = [outcomes(whole, scene, partial(fine_tuned, seed=seed)) for seed, whole in enumerate(wholes)]
    result = {
        **kit.describe_trainings(args, scene),
        "fine_tune": args.fine_tune,
        "is_frozen": args.frozen,
        "runs": runs,
    }
    frozen = ", positions and shapes frozen" if args.frozen else ""
    text = f"{scene.name}; fine-tuned {args.fine_tune} iterations{frozen}\n\n"
    rows = [row for run in runs for row in run]
    text += table(rows, {"kept": "Gaussians", "form": "with", "degree": "degree"}, COLUMNS)
    arms = {f"{row['form']}, {row['kept']}, degree {row['degree']}": row for rows in runs[:1] for row in rows}
    return kit.Report(result, draw(result), text, {name: row["psnr"] for name, row in arms.items()})


def outcomes(whole: Gaussians, scene: Scene, fine_tuned: Callable[[Any], Any]) -> list[dict[str, Any]]:
    """Return the measurements of each form of a trained population."""
    importance = indoor(collect_importance(whole, scene.train_views))
    jobs: list[tuple[str, str, int, Any]] = [("all", PLAIN, 0, whole)]
    jobs += [("all", PAPER, degree, prepare(whole, degree, True)) for degree in (1, 2, 3)]
    jobs.append(("all", BOTH, 3, prepare(whole, 3, False)))
    n_floats = len(whole.means) * kit.count_floats(whole)
    for form, replaces in ((PAPER, True), (BOTH, False)):
        n = n_floats // kit.count_floats(prepare(whole, 3, replaces))
        kept = take(whole, most_important(importance, min(n, int(np.count_nonzero(importance)))))
        jobs.append(("as many floats", form, 3, prepare(kept, 3, replaces)))
    rows = []
    for kept_by, form, degree, population in kit.with_progress(jobs, "populations"):
        after = fine_tuned(population)
        test, training = (measure(after, scene, views) for views in (scene.test_views, scene.train_views))
        rows.append(
            {
                "kept": kept_by,
                "form": form,
                "degree": degree,
                "n_gaussians": len(population.means),
                "n_floats": len(population.means) * kit.count_floats(population),
                "psnr": test.psnr,
                "ssim": test.ssim,
                "training_psnr": training.psnr,
            }
        )
    return rows


def draw(result: dict[str, Any]) -> Figure:
    """Draw PSNR against the number of floats, for test views and training views."""
    figure, panels = subplots((9.5, 3.6), 1, 2)
    for axes, key in zip(panels, ("psnr", "training_psnr"), strict=True):
        for form, color in COLORS.items():
            for kept, marker in (("all", "o"), ("as many floats", "s")):
                rows = [r for run in result["runs"] for r in run if (r["form"], r["kept"]) == (form, kept)]
                if rows:
                    x, y = [r["n_floats"] / 1e3 for r in rows], [r[key] for r in rows]
                    axes.plot(x, y, marker, color=color, label=f"{form}, {kept}")
        axes.set(xlabel="thousands of floats", ylabel=f"{'test' if key == 'psnr' else 'training'} PSNR (dB)")
    axes.legend()
    figure.suptitle(result["scene"])
    return figure


def colors_across(step: float) -> tuple[Floats, Floats]:
    """Return the colours of rays across a round Gaussian's limb, with the texture and without it beyond the limb."""
    camera = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 50.0, 50.0, 100, 100)
    means, quats, scales = np.array([[0.1, 0.0, 4.0]]), np.array([[1.0, 0.2, 0.3, 0.1]]), np.full((1, 3), 0.4)
    p = 50 + 25 * means[:, :2]
    xs = np.arange(p[0, 0] + 9, p[0, 0] + 11.5, step)  # the limb is about 10 px from the centre
    met = meet(frames(means, quats, scales, camera), p, np.column_stack([xs, np.full(len(xs), 50.0)]))
    texture = sh_basis(met.directions[0], 3)[:, 1:] @ np.random.default_rng(0).normal(size=15)  # [P]
    return texture, np.where(np.sum(met.q[0] ** 2, axis=1) < 1, texture, 0)


def run_limb(args: argparse.Namespace) -> str:
    """Return the largest change from ray to ray."""
    rows = []
    for step in kit.with_progress(STEPS, "spacings"):
        continued, cut = (float(np.abs(np.diff(colors)).max()) for colors in colors_across(step))
        rows.append([f"{step:g}", f"{continued:.2g}", f"{cut:.2g}"])
    table = markdown_table(["rays apart (px)", "nearest point beyond", "no texture beyond"], rows)
    return f"largest change of a texture from ray to ray across the limb\n\n{table}"


CLAIMS = (
    claim.declare(
        "counts",
        "textures at equal numbers of Gaussians, and of floats",
        run,
        *claim.trainings(1000, "mini-splatting"),
        claim.fine_tune(500),
        claim.argument("--frozen", action="store_true", help="train no positions and shapes"),
    ),
    claim.declare("limb", "whether a texture jumps where rays begin to miss", run_limb),
)
