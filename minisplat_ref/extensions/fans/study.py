"""The studies ``fans/profile`` and ``fans/refit``.

``profile``: which reach and rim stand best for a Gaussian seen from the front, for each number of sides; and what
becomes of a disc and of a ball that turn away from the camera.

``refit``: on a scene, what fans lose against the splats that they were made of, over reach, rim and sides; what is
gained by fitting these two numbers to photographs, and by training every vertex; how many layers a picture needs; and
what the meshes weigh. Splats are trained on for as many iterations as the vertices are, for comparison.
"""

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from minisplat_ref.extensions import shared_studies
from minisplat_ref.extensions import shared_trainings as shared
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.studies.study import Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KNOWN = ((2.5, 0.0), (2.3, 0.2), (2.7, 0.2))  # the best fan of 8 sides, and two that are used
RIM_COLORS = {0.0: shared.BLUE, 0.1: shared.YELLOW, 0.2: shared.RED}


def add_profile_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``."""
    shared_studies.add_out(parser)


def run_profile(args: argparse.Namespace) -> None:
    """Measure, write, print the tables.

    Raises
    ------
    InputError
        The output folder cannot be used.
    """
    from minisplat_ref.extensions.fans import profile
    from minisplat_ref.extensions.fans.claims import SIDES
    from minisplat_ref.extensions.fans.shapes import FanShape
    from minisplat_ref.reporting import markdown_table

    with making_folder(args.out) as folder:
        best = [profile.best_profile(n) for n in SIDES]
        shapes = [*best, *(FanShape(reach=reach, rim=rim) for reach, rim in KNOWN)]
        rows = [
            {**shape._asdict(), "error": profile.profile_error(shape), "mass": profile.mass(shape)} for shape in shapes
        ]
        tilts = profile.tilts()
        result = {"rows": rows, "angles": profile.ANGLES, "tilts": [tilt._asdict() for tilt in tilts]}
        shared_studies.write(folder, result, draw_profile(result))
    lines = [
        [f"{r['n_sides']}", f"{r['reach']:.2f}", f"{r['rim']:.2f}", f"{r['error']:.1%}", f"{r['mass']:.2f}"]
        for r in rows
    ]
    print("the best for each number of sides, then others of 8\n")
    print(markdown_table(["sides", "reach", "rim", "RMS error", "mass"], lines))
    print("\nRMS error of alpha, turned by\n")
    names = [f"{t.kind}, {'flat fan' if t.is_flat else 'solid fans'}" for t in tilts]
    lines = [[n, *(f"{e:.0%}" for e in t.errors)] for n, t in zip(names, tilts, strict=True)]
    print(markdown_table(["", *(f"{angle}°" for angle in profile.ANGLES)], lines))


def draw_profile(result: dict[str, Any]) -> "Figure":
    """Draw the error over the reach, and over the angle."""
    from matplotlib.figure import Figure

    from minisplat_ref.extensions.fans.profile import profile_error
    from minisplat_ref.extensions.fans.shapes import FanShape

    figure = Figure(figsize=(9.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    reaches = np.linspace(1.5, 3.5, 41)
    for rim, color in RIM_COLORS.items():
        left.plot(reaches, [100 * profile_error(FanShape(8, k, rim)) for k in reaches], color=color, label=f"rim {rim}")
    left.set(xlabel="reach k (standard deviations)", ylabel="RMS error of a fan of 8 sides (%)", ylim=(0, None))
    left.set_title("seen from the front", fontsize=9)
    for tilt in result["tilts"]:
        style = "-" if tilt["is_flat"] else "--"
        color = shared.BLUE if tilt["kind"] == "disc" else shared.RED
        label = f"{tilt['kind']}, {'flat fan' if tilt['is_flat'] else 'solid fans'}"
        right.plot(result["angles"], [100 * e for e in tilt["errors"]], style, color=color, label=label)
    right.set(xlabel="turned away by (degrees)", ylabel="RMS error of alpha (%)", ylim=(0, None))
    right.set_title("a disc stays a fan, a ball does not", fontsize=9)
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
        shared_studies.tidy(axes)
    return figure


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``refit``."""
    shared.add_scene_arguments(parser, iterations=1000, recipe="mini-splatting")
    parser.add_argument("--fine-tune", type=int, default=500, metavar="M", help="iterations afterwards (default 500)")


def run(args: argparse.Namespace) -> None:
    """Train, convert, refit, measure, write, print the tables.

    Raises
    ------
    InputError
        The scene, the recipe, the PLY or the output folder cannot be used.
    """
    from tqdm import tqdm

    from minisplat_ref.extensions.fans import claims

    shared_studies.check_at_least(1, **{"fine-tune": args.fine_tune})
    scene = shared.read_scene(args)
    with making_folder(args.out) as folder:
        populations = shared.populations(args, scene)
        judge = claims.judge_of(scene)
        runs = []
        for seed, gaussians in enumerate(populations):
            with tqdm(total=4, desc=f"seed {seed}", leave=False, disable=None) as bar:
                shapes = {name: claims.shape_rows(gaussians, judge, shape) for name, shape in claims.FORMS.items()}

                def told(name: str, bar: Any = bar) -> None:
                    bar.set_postfix_str(name)
                    bar.update()

                rows, forms = claims.refit_rows(gaussians, judge, args.fine_tune, seed, folder, told)
            layers = {name: claims.layer_rows(forms[f"{name}, vertices"], judge) for name in claims.FORMS}
            runs.append({"n_gaussians": len(gaussians.means), "shapes": shapes, "rows": rows, "layers": layers})
            if seed == 0:
                pictures = pictures_of(forms, scene)
        result = {**shared.describe(args, scene), "fine_tune": args.fine_tune, "runs": runs}
        shared_studies.write(folder, result, draw(result, pictures))
    print(f"{scene.name}; {runs[0]['n_gaussians']:,} Gaussians, vertices trained for {args.fine_tune} iterations\n")
    print_tables(runs)


def pictures_of(forms: dict[str, Any], scene: Any) -> dict[str, Any]:
    """Return crops of the first test view by their titles."""
    from minisplat_ref.extensions.fans import claims
    from minisplat_ref.extensions.fans.tuning import render_clipped

    view = scene.test_views[0].load()
    names = ["splats", claims.FLAT, f"{claims.FLAT}, reach and rim", f"{claims.FLAT}, vertices"]
    drawings = {name: render_clipped(forms[name], view, background=scene.background) for name in names}
    return {"photograph": view.image / 255, **drawings}


def print_tables(runs: list[dict[str, Any]]) -> None:
    """Print what the forms reach, the shapes of the first seed, and the layers."""
    from minisplat_ref.reporting import markdown_table

    lines = []
    for rows in zip(*(run["rows"] for run in runs), strict=True):
        first = rows[0]
        measures = [
            shared.with_deviation([row[key] for row in rows], digits)
            for key, digits in (("psnr", 2), ("ssim", 4), ("training_psnr", 2))
        ]
        fit = f"{first['reach']:.2f}, {first['rim']:.2f}" if "reach" in first else ""
        size = [f"{first[key]:,}" if key in first else "" for key in ("triangles", "bytes")]
        lines.append([first["form"], fit, *measures, *size])
    heading = ["", "reach, rim", "test PSNR", "test SSIM", "training PSNR", "triangles", "bytes of the .ply"]
    print(markdown_table(heading, lines))
    for name, shapes in runs[0]["shapes"].items():
        lines = [[str(s["n_sides"]), f"{s['reach']:g}", f"{s['rim']:g}", f"{s['psnr']:.2f}"] for s in shapes]
        print(f"\n{name} against splats of degree 0, seed 0\n")
        print(markdown_table(["sides", "reach", "rim", "PSNR"], lines))
    for name, (whole, *rows) in runs[0]["layers"].items():
        cells = ", ".join(f"{row['layers']}: {row['rms_levels']:.2g}" for row in rows)
        print(f"\n{name}: {whole['mean']:.1f} layers a pixel, at most {whole['most']}")
        print(f"RMS of the nearest alone, in 8-bit levels, {cells}")


def draw(result: dict[str, Any], pictures: dict[str, Any]) -> "Figure":
    """Draw PSNR over the reach, what refitting brings, and pictures."""
    from matplotlib.figure import Figure

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
    left.legend(frameon=False, fontsize=7)
    names = [row["form"] for row in run["rows"]]
    psnrs = [shared.mean_and_deviation([r["rows"][i]["psnr"] for r in result["runs"]]) for i in range(len(names))]
    colors = [
        shared.GREY if name.startswith("splats") else shared.RED if "vertices" in name else shared.BLUE
        for name in names
    ]
    places = np.arange(len(names))[::-1]
    right.barh(places, [p for p, _ in psnrs], xerr=[d for _, d in psnrs], color=colors, height=0.7)
    right.set_yticks(places, names, fontsize=8)
    right.set(xlabel="test PSNR (dB)", xlim=(min(p for p, _ in psnrs) - 2, None))
    for axes in (left, right):
        shared_studies.tidy(axes)
    for axes, (title, image) in zip(parts[1].subplots(1, len(pictures)), pictures.items(), strict=True):
        axes.imshow(np.clip(image, 0, 1))
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
    figure.suptitle(f"{result['scene']}, {run['n_gaussians']:,} Gaussians, seed 0 where it is one")
    return figure


PROFILE = Study("profile", "which fan stands best for a Gaussian, from any side", add_profile_arguments, run_profile)
"""``fans/profile``."""
REFIT = Study("refit", "what a scene loses as a mesh, and what refitting gives back", add_arguments, run)
"""``fans/refit``."""
