"""Measures a trained scene on its test views, and keeps the images: ``metrics.json`` and ``renders/``."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.reports.images import error_image, side_by_side, to_8_bits
from minisplat_ref.app.runs.checkpoints import newest_model
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.run_folder import RENDERS
from minisplat_ref.app.runs.settings import configure_recipe, load, load_background
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputWarning, one_line
from minisplat_ref.interface.progress import progress_bar
from minisplat_ref.io import write_image
from minisplat_ref.io.atomic import replacing_folder
from minisplat_ref.io.names import file_names
from minisplat_ref.metrics import Evaluation, ViewMetrics, evaluate
from minisplat_ref.metrics.lpips import Network
from minisplat_ref.rendering import Renderer, RenderSettings, Request
from minisplat_ref.rendering.backends import get_backend
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.types import Floats, Model, RenderOutput, View


class Trained(NamedTuple):
    """The model of a run, and the settings of its renderer."""

    model: Model
    renderer: Renderer
    background: Floats
    """[3] RGB in [0, 1]."""
    profile: str
    backend: str

    def render(self, view: View, wants: frozenset[str] = frozenset()) -> RenderOutput:
        """Render a view; ``wants`` as in :class:`minisplat_ref.rendering.Request`."""
        request = Request(
            self.background, conventions=PROFILES[self.profile], backend=get_backend(self.backend), wants=wants
        )
        return self.renderer.render(self.model, view, request)[0]


def choose_renderer(settings: Settings, model: Model) -> Renderer:
    """Return the renderer with which a run renders a model: with the sky that it has been given, too."""
    return match_calibrations(configure_recipe(settings), model).renderer


def choose_render_settings(settings: Settings, model: Model, background: Floats) -> RenderSettings:
    """Return the settings with which a run renders a model before a background [3]."""
    conventions, backend = PROFILES[settings.profile], get_backend(settings.backend)
    return RenderSettings(background, conventions, backend, choose_renderer(settings, model))


def load_trained(folder: Path) -> Trained:
    """Read the newest model of a run; of one that has not ended, the checkpoint's, with a warning.

    Raises
    ------
    InputError
        The folder holds no run of this version, no Gaussians yet, or a file of it is damaged.
    """
    settings = load(folder)
    saved = newest_model(folder, settings)
    if saved.unfinished is not None:
        message = f"{folder} has not ended: this is its checkpoint of iteration {saved.unfinished}"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
    renderer, background = choose_renderer(settings, saved.model), load_background(folder)
    return Trained(saved.model, renderer, background, settings.profile, settings.backend)


def score(
    folder: Path, views: Sequence[View], model: Model, settings: RenderSettings, network: Network | None = None
) -> Evaluation:
    """Evaluate test views and write ``renders/NAME.png``: truth, render and error side by side.

    The earlier content of ``renders`` is removed when all views have been measured, and not earlier.

    Parameters
    ----------
    folder : Path
        Of the run, or of another evaluation.
    views : sequence of View
    model : Model
        The trained model.
    settings : RenderSettings
    network : Network, optional
        For LPIPS, see :func:`minisplat_ref.app.runs.settings.load_lpips`.

    Returns
    -------
    Evaluation
    """
    names = [view.name for view in views]
    stems = dict(zip(names, file_names(names), strict=True))
    with (
        replacing_folder(folder / RENDERS) as renders,
        progress_bar("measuring", "views", len(names)) as bar,
    ):

        def save(view: View, image: Floats, _: ViewMetrics) -> None:
            render = to_8_bits(image)
            panels = [view.image, render, error_image(view.image, render)]
            write_image(renders / f"{stems[view.name]}.png", side_by_side(panels))
            bar.update()

        return evaluate(model, views, settings, on_view=save, network=network)


def to_metrics(evaluation: Evaluation) -> dict[str, Any]:
    """Return the measures as ``metrics.json`` holds them; an infinite PSNR, of equal images, becomes null."""
    per_view = [_finite(view._asdict()) for view in evaluation.per_view]
    return {**_finite(evaluation._asdict()), "per_view": per_view}


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }


def summary(evaluation: Evaluation) -> str:
    """Return the measures in a line; of several views, which is the worst."""
    if evaluation.psnr is None or evaluation.ssim is None:
        return "no test views to measure"
    n_views = len(evaluation.per_view)
    lpips = "" if evaluation.lpips is None else f", LPIPS {evaluation.lpips:.4f} by {evaluation.lpips_network}"
    worst = min(evaluation.per_view, key=lambda view: view.psnr)
    and_worst = f"; the worst is {one_line(worst.name)} with {worst.psnr:.2f} dB" if n_views > 1 else ""
    others = ""
    if evaluation.psnr_exposed is not None and evaluation.psnr_corrected is not None:
        others = (
            f" ({evaluation.psnr_exposed:.2f} with the exposures that their tracks show,"
            f" {evaluation.psnr_corrected:.2f} after the best affine map of the colours)"
        )
    return (
        f"PSNR {evaluation.psnr:.2f} dB{others}, SSIM {evaluation.ssim:.4f}{lpips}"
        f" (mean of {n_views} test view{'s'[: n_views > 1]}{and_worst})"
    )
