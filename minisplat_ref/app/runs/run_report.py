"""The ``report.html`` of a training, made of the files that the run's folder holds when it has been measured."""

import platform
from pathlib import Path
from typing import Any

from minisplat_ref import __version__
from minisplat_ref.app.reports.commands import command, how_to_call
from minisplat_ref.app.reports.images import fit_image, split_images
from minisplat_ref.app.reports.page import add_caption, cards, code, curves, folded, page, paragraph, section, table
from minisplat_ref.app.reports.plots import can_plot
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.decisions_report import decisions_section
from minisplat_ref.app.runs.events import count_published_times, read_mechanisms
from minisplat_ref.app.runs.next_steps import own_photographs, ways_to_look
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.progress import read_log
from minisplat_ref.app.runs.recipe_actions import Fired
from minisplat_ref.app.runs.report_parts import ERROR_TEXT, curve, fired_tables, training_curves, view_panel
from minisplat_ref.app.runs.settings import configure_recipe, load
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import PURPLE
from minisplat_ref.io import read_image
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.names import file_names
from minisplat_ref.training.pace import pace_from_json
from minisplat_ref.types import Scene

N_SHOWN = 6  # test views with images; all are in the table
LARGEST = 1000  # pixels of an image's longer side in the page

VIEWS_TEXT = f"""\
The training never saw these views. PSNR is that of the rendering as it is; with the exposure that the photograph's own
tracks show, to which nothing else is fitted; and after the affine map of the colours that fits best. {ERROR_TEXT}"""
PSNRS = ("psnr", "psnr_exposed", "psnr_corrected")
BLOCKS_TEXT = """\
The scene was trained in blocks, each from the photographs in which it fills a quarter of the pixels. Of each block,
this model has what lies in its core. The blocks' own pages are in the folder blocks."""
NO_CURVES = "Curves are drawn by matplotlib: pip install 'minisplat_ref[photos]'. Their numbers are in log.jsonl."
FIRED_TEXT = """\
What the recipe does besides gradient steps, in this run: how often, in how many steps as published, when, and by how
many Gaussians their number rose or fell."""


def write_report(folder: Path, scene: Scene, metrics: dict[str, Any], shown: str = "") -> None:
    """Write the page of a run.

    Parameters
    ----------
    folder : Path
    scene : Scene
        That it was trained on.
    metrics : dict
        The content of ``metrics.json``, which is written after the page, since it marks the end of a run.
    shown : str
        The part that shows the scene (:func:`.report_parts.showcase`), if there is something to look at already.

    Raises
    ------
    InputError
        A file of the run is damaged, or the page cannot be written.
    """
    text = report_html(folder, scene, metrics, shown)
    with replacing(folder / run_folder.REPORT) as temporary:
        temporary.write_text(text, encoding="utf-8")


def report_html(folder: Path, scene: Scene, metrics: dict[str, Any], shown: str = "") -> str:
    """Return the page as text of one self-contained HTML file."""
    settings = load(folder)
    log, n_iterations = read_log(folder / run_folder.LOG), metrics["iterations"]
    introduction = (
        f"{metrics['n_gaussians']:,} Gaussians, trained for {n_iterations:,} iterations by the recipe {settings.recipe}"
        f" on {len(scene.train_views)} photographs."
    )
    sections = [*([shown] if shown else []), cards(_key_figures(metrics, log[0]["n_gaussians"] if log else None))]
    if metrics["per_view"]:
        sections.append(_views(folder, metrics["per_view"]))
    if (folder / run_folder.BLOCK_PLAN).exists():
        plan = add_caption(
            read_image(folder / run_folder.BLOCK_PLAN)[..., :3], "cores, and around them what each block trains"
        )
        sections.append(section("Trained in blocks", paragraph(BLOCKS_TEXT), plan))
    if (folder / run_folder.DECISIONS).exists():
        pace = pace_from_json(run_folder.read_json_object(folder / run_folder.DECISIONS))
        cooling = configure_recipe(settings).cooling
        holds_out = cooling is not None and cooling.holds_out(len(scene.train_views))
        sections.append(decisions_section(pace, n_iterations, has_schedule=cooling is None, holds_out=holds_out))
    if log:
        sections.append(section("How the training went", _curves(folder, log)))
    if (folder / run_folder.EVENTS).exists():
        sections.append(_fired(folder, settings, n_iterations))
    sections += [
        section("What was run", table(_settings(folder, settings, metrics, scene))),
        section("What to try next", *_next_steps(folder, settings, is_shown=bool(shown))),
    ]
    return page(run_folder.scene_title(Path(settings.scene)), introduction, sections)


def _key_figures(metrics: dict[str, Any], n_first: int | None) -> list[tuple[str, str]]:
    views = metrics["per_view"]
    figures = []
    if views:
        worst = _worst_first(views)[0]
        figures = [
            (_decibels(metrics["psnr"]), f"PSNR, mean of {len(views)} held-out view{'s'[: len(views) > 1]}"),
            (_decibels(worst["psnr"]), f"PSNR of the worst, {worst['name']}"),
            (f"{metrics['ssim']:.3f}", "SSIM, mean of the same"),
        ]
    if metrics["lpips"] is not None:
        figures.append((f"{metrics['lpips']:.3f}", f"LPIPS by {metrics['lpips_network']}, mean of the same"))
    start = "" if n_first is None else f", from {n_first:,} at the first record"
    return [
        *figures,
        (f"{metrics['n_gaussians']:,}", f"Gaussians{start}"),
        (f"{metrics['train_seconds']:,.0f} s", f"training, {metrics['iterations']:,} iterations"),
    ]


def _worst_first(views: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sort views by PSNR; that of equal images, null in the file, is the best."""
    return sorted(views, key=lambda view: (view["psnr"] is None, view["psnr"] or 0.0))


def _decibels(psnr: float | None) -> str:
    return "equal" if psnr is None else f"{psnr:.2f} dB"


def _views(folder: Path, views: list[dict[str, Any]]) -> str:
    """Show views spread evenly from the worst to the best, and the measures of all."""
    names = [view["name"] for view in views]
    stems = dict(zip(names, file_names(names), strict=True))
    ranked = _worst_first(views)
    n = min(N_SHOWN, len(ranked))
    shown = [ranked[round(k * (len(ranked) - 1) / max(n - 1, 1))] for k in range(n)]
    panels = []
    for view in shown:
        strip = read_image(folder / run_folder.RENDERS / f"{stems[view['name']]}.png")
        images = (fit_image(image, LARGEST) for image in split_images(strip, 3))
        rank = f" ({ranked.index(view) + 1} of {len(ranked)})" if len(ranked) > 1 else ""
        panels.append(view_panel(f"{view['name']}{rank}: {_describe_measures(view)}", *images))
    how = f" Shown are {n} of {len(ranked)}, from the worst to the best." if n < len(ranked) else " The worst is first."
    has_lpips = ranked[0]["lpips"] is not None
    heading = [
        "view",
        "PSNR (dB)",
        "with its own exposure",
        "colours fitted",
        "SSIM",
        *(["LPIPS"] if has_lpips else []),
    ]
    cells = [
        [
            view["name"],
            *("equal" if view[key] is None else f"{view[key]:.2f}" for key in PSNRS),
            f"{view['ssim']:.4f}",
            *([f"{view['lpips']:.4f}"] if has_lpips else []),
        ]
        for view in ranked
    ]
    return section("Held-out views", paragraph(VIEWS_TEXT + how), *panels, table(cells, heading))


def _describe_measures(view: dict[str, Any]) -> str:
    return f"PSNR {_decibels(view['psnr'])}, SSIM {view['ssim']:.3f}"


def _curves(folder: Path, log: list[dict[str, Any]]) -> str:
    if not can_plot():
        return paragraph(NO_CURVES)
    measured = read_log(folder / run_folder.CURVE)
    if not measured:
        return curves(training_curves(log))
    return curves([*training_curves(log), curve(measured, "psnr", "PSNR of test views (dB)", PURPLE)], n_columns=2)


def _fired(folder: Path, settings: Settings, n_iterations: int) -> str:
    recipe = find_recipe(settings.recipe)
    published = count_published_times(recipe)
    runs = [read_mechanisms(folder / run_folder.EVENTS, published)]
    fired = Fired(settings.recipe, n_iterations, recipe.iterations, published, runs)
    return folded("What fired, and when", paragraph(FIRED_TEXT), *fired_tables(fired))


def _settings(folder: Path, settings: Settings, metrics: dict[str, Any], scene: Scene) -> list[tuple[str, str]]:
    camera = scene.train_views[0].camera
    sets = ", ".join(f"{name}={value}" for name, value in settings.set.items())
    further = [("Settings", sets)] if sets else []
    if settings.extension is not None:
        further.append(("Extension", settings.extension))
    memory = "not known here" if metrics["peak_rss_mb"] is None else f"{metrics['peak_rss_mb']:.0f} MB at most"
    return [
        (
            "Scene",
            f"{len(scene.train_views)} training and {len(scene.test_views)} test views of {camera.width} x"
            f" {camera.height} pixels, {len(scene.points):,} points, in {settings.scene}",
        ),
        ("Recipe", f"{settings.recipe}, planned for at most {settings.schedule_iterations:,} iterations"),
        *further,
        ("Seed", f"{settings.seed}"),
        ("Conventions", settings.profile),
        ("Backend", settings.backend),
        ("Memory", memory),
        ("Program", f"minisplat_ref {__version__}, Python {platform.python_version()}, {platform.system()}"),
        ("Files", f"{folder.resolve()}: Gaussians, metrics, log, checkpoint, images of all test views in renders"),
    ]


def _next_steps(folder: Path, settings: Settings, *, is_shown: bool) -> list[str]:
    population = find_recipe(settings.recipe, extension=settings.extension).representation.population
    looking = ways_to_look(folder, population._fields)
    steps = [
        *((f"{step.purpose}:", step.line) for step in (looking[-1:] if is_shown else looking)),  # the page is there
        ("Walk around the scene:", command("render", folder, "--cameras", "orbit")),
        ("Measure it again, or with LPIPS:", command("eval", folder)),
        ("Make it smaller, if that costs at most 0.1 dB:", _simplify(folder)),
        ("Pack it for a viewer on the web:", command("convert", folder, folder.parent / f"{folder.name}.spz")),
        (f"{own_photographs().purpose}:", own_photographs().line),
    ]
    return [*map(paragraph, how_to_call()), *(part for text, line in steps for part in (paragraph(text), code(line)))]


def _simplify(folder: Path) -> str:
    return command("simplify", folder, "--out", folder.parent / f"{folder.name}-small", "--max-drop", "0.1")
