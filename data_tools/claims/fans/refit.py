"""Claims ``fans/profile`` and ``fans/refit`` (MeshSplats, arXiv 2502.07754).

``profile``: which reach and rim approximate a Gaussian best seen from the front, for each number of sides; and what
becomes of a disc and of a ball that turn away from the camera.

``refit``: on a scene, what fans lose against the splats that they were made of, over reach, rim and sides; what is
gained by fitting these two numbers to photographs, and by training every vertex; how many layers an image needs; and
what the meshes weigh. Splats are trained on for as many iterations as the vertices are, for comparison.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.fans import measures as claims
from data_tools.claims.fans import profile
from data_tools.claims.fans.profile import profile_error
from data_tools.claims.fans.shape_search import render_clipped
from data_tools.claims.kit.figures import mean_and_deviation, show, subplots, table_of
from data_tools.claims.kit.tables import first, spread, table
from minisplat_ref.extensions.fans.model import FanShape
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE, RED
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.types import Scene

KNOWN = ((2.5, 0.0), (2.3, 0.2), (2.7, 0.2))  # the best fan of 8 sides, and two that are used
COLUMNS = (
    ("reach, rim", first(lambda row: f"{row['reach']:.2f}, {row['rim']:.2f}" if "reach" in row else "")),
    ("test PSNR", spread("psnr", 2)),
    ("test SSIM", spread("ssim", 4)),
    ("training PSNR", spread("training_psnr", 2)),
    ("triangles", first(lambda row: f"{row['triangles']:,}" if "triangles" in row else "")),
    ("bytes of the .ply", first(lambda row: f"{row['bytes']:,}" if "bytes" in row else "")),
)
RIM_COLORS = {0.0: BLUE, 0.1: OCHRE, 0.2: RED}


def run_profile(args: argparse.Namespace) -> kit.Report:
    """Compare fans with a Gaussian from the front and from the side."""
    best = [profile.best_profile(n) for n in claims.SIDES]
    shapes = [*best, *(FanShape(reach=reach, rim=rim) for reach, rim in KNOWN)]
    rows = [{**shape._asdict(), "error": profile_error(shape), "mass": profile.mass(shape)} for shape in shapes]
    tilts = profile.tilts()
    result = {"rows": rows, "angles": profile.ANGLES, "tilts": [tilt._asdict() for tilt in tilts]}
    lines = [
        [f"{r['n_sides']}", f"{r['reach']:.2f}", f"{r['rim']:.2f}", f"{r['error']:.1%}", f"{r['mass']:.2f}"]
        for r in rows
    ]
    by_angle = {
        f"{t.kind}, {'flat fan' if t.is_flat else 'solid fans'}": dict(zip(profile.ANGLES, t.errors, strict=True))
        for t in tilts
    }
    text = "the best for each number of sides, then others of 8\n\n"
    text += markdown_table(["sides", "reach", "rim", "RMS error", "mass"], lines)
    text += f"\n\nRMS error of alpha, rotated by\n\n{table_of('', by_angle, '.0%', '°')}"
    return kit.Report(result, draw_profile(result), text)


def draw_profile(result: dict[str, Any]) -> Figure:
    """Draw the error over the reach, and over the angle."""
    figure, (left, right) = subplots((9.5, 3.6), 1, 2)
    reaches = np.linspace(1.5, 3.5, 41)
    for rim, color in RIM_COLORS.items():
        left.plot(reaches, [100 * profile_error(FanShape(8, k, rim)) for k in reaches], color=color, label=f"rim {rim}")
    left.set(xlabel="reach k (standard deviations)", ylabel="RMS error of a fan of 8 sides (%)", ylim=(0, None))
    left.set_title("seen from the front", fontsize=9)
    for tilt in result["tilts"]:
        style = "-" if tilt["is_flat"] else "--"
        color = BLUE if tilt["kind"] == "disc" else RED
        label = f"{tilt['kind']}, {'flat fan' if tilt['is_flat'] else 'solid fans'}"
        right.plot(result["angles"], [100 * e for e in tilt["errors"]], style, color=color, label=label)
    right.set(xlabel="turned away by (degrees)", ylabel="RMS error of alpha (%)", ylim=(0, None))
    right.set_title("a disc stays a fan, a ball does not", fontsize=9)
    for axes in (left, right):
        axes.legend()
    return figure


def run(args: argparse.Namespace) -> kit.Report:
    """Train, convert, refit and measure."""
    scene = kit.read_scene(args.scene, args.downscale)
    judge = claims.judge_of(scene)
    runs: list[dict[str, Any]] = []
    images: dict[str, Any] = {}
    for seed, gaussians in enumerate(kit.populations(args, scene)):
        with progress_bar(f"seed {seed}", "models", 4) as bar:
            shapes = {name: claims.shape_rows(gaussians, judge, shape) for name, shape in claims.FORMS.items()}

            def told(name: str, bar: Any = bar) -> None:
                bar.set_description(name)
                bar.update()

            rows, forms = claims.refit_rows(gaussians, judge, args.fine_tune, seed, told)
        layers = {name: claims.layer_rows(forms[f"{name}, vertices"], judge) for name in claims.FORMS}
        runs.append({"n_gaussians": len(gaussians.means), "shapes": shapes, "rows": rows, "layers": layers})
        images = images or render_forms(forms, scene)
    result = {**kit.describe_trainings(args, scene), "fine_tune": args.fine_tune, "runs": runs}
    text = f"{scene.name}; {runs[0]['n_gaussians']:,} Gaussians, vertices trained for {args.fine_tune} iterations\n\n"
    return kit.Report(result, draw(result, images), text + tables(runs))


def render_forms(forms: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """Return the first test view, as a photograph and by some of the forms."""
    view = scene.test_views[0].load()
    names = ["splats", claims.FLAT, f"{claims.FLAT}, reach and rim", f"{claims.FLAT}, vertices"]
    renders = {name: render_clipped(forms[name], view, background=scene.background) for name in names}
    return {"photograph": view.image / 255, **renders}


def tables(runs: list[dict[str, Any]]) -> str:
    """Return what the forms reach, the shapes of the first seed, and the layers."""
    text = table([row for run in runs for row in run["rows"]], {"form": ""}, COLUMNS)
    for name, shapes in runs[0]["shapes"].items():
        text += f"\n\n{name} against splats of degree 0, seed 0\n\n"
        text += table(shapes, {"n_sides": "sides", "reach": "reach", "rim": "rim"}, [("PSNR", first("psnr", ".2f"))])
    for name, (whole, *rows) in runs[0]["layers"].items():
        cells = ", ".join(f"{row['layers']}: {row['rms_levels']:.2g}" for row in rows)
        text += f"\n\n{name}: {whole['mean']:.1f} layers a pixel, at most {whole['most']}"
        text += f"\nRMS of the nearest alone, in 8-bit levels, {cells}"
    return text


def draw(result: dict[str, Any], images: dict[str, Any]) -> Figure:
    """Draw PSNR over the reach, what refitting brings, and images."""
    figure = Figure(figsize=(12.0, 6.6), layout="constrained")
    parts: Any = figure.subfigures(2, 1)
    left, right = parts[0].subplots(1, 2)
    run = result["runs"][0]
    for name, style in (("flat fans", "o-"), ("solid fans", "s--")):
        for rim, color in RIM_COLORS.items():
            rows = [row for row in run["shapes"][name] if row["rim"] == rim and row["n_sides"] == 8]
            label = f"{name}, rim {rim:g}"
            left.plot([r["reach"] for r in rows], [r["psnr"] for r in rows], style, color=color, label=label, ms=4)
    left.set(xlabel="reach k (standard deviations)", ylabel="PSNR against splats of degree 0 (dB)")
    left.legend(fontsize=7)
    names = [row["form"] for row in run["rows"]]
    psnrs = [mean_and_deviation([r["rows"][i]["psnr"] for r in result["runs"]]) for i in range(len(names))]
    colors = [GREY if name.startswith("splats") else RED if "vertices" in name else BLUE for name in names]
    places = np.arange(len(names))[::-1]
    right.barh(places, [p for p, _ in psnrs], xerr=[d for _, d in psnrs], color=colors, height=0.7)
    right.set_yticks(places, names, fontsize=8)
    right.set(xlabel="test PSNR (dB)", xlim=(min(p for p, _ in psnrs) - 2, None))
    for axes, (title, image) in zip(parts[1].subplots(1, len(images)), images.items(), strict=True):
        show(axes, image, title)
    figure.suptitle(f"{result['scene']}, {run['n_gaussians']:,} Gaussians, seed 0 where it is one")
    return figure
