"""Why held-out photographs are not sharp: cameras that are wrong, or geometry.

The claim is ours. A recipe is trained on folds (:mod:`data_tools.claims.folds`), and each held-out rendering is
compared with its photograph after the best affine map of its colours:

* *fine* is the part of the squared error that remains after a Gaussian mean over ``FINE`` pixels is subtracted;
* *edges* is the sum of the lengths of the rendering's gradients over that of the photograph's;
* *moved* is what it gains, in dB of the squared error, if patches of ``PATCH`` pixels move by up to ``REACH`` pixels.
  The displacement of a patch's left half is judged on its right half, and vice versa, so that noise gains nothing. A
  patch moves where those of both halves agree to a pixel, and each lowers the error by the fraction ``FALL_MIN``, as
  flat halves fit everywhere;
* *warped* is what one affine displacement of the whole image gains, ``d = A (1, x, y)``, fitted to half of the patches
  and judged on the other half. A wrong pose or focal length moves an image about like this, a wrong surface does not.

So *warped* tells the cameras' share of *moved*. ``--degrees`` and ``--focal`` plant errors in the cameras of a scene
whose cameras are right, to see what these figures are then.
"""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter, map_coordinates

from data_tools.claims import kit
from data_tools.claims.adaptive import warm_up
from data_tools.claims.folds import all_photographs, make_fold, read_small, recipe_of
from data_tools.claims.kit.claim import CONTINUES, LONG_SIDE, NAMES, RESUMED_OUT, SEEDS, argument, declare, folds
from data_tools.claims.kit.figures import subplots
from data_tools.claims.pose import Disturbance, disturb_poses
from minisplat_ref.errors import InputError
from minisplat_ref.interface.palette import SERIES
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.metrics import correct_colors, evaluate
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.track_gains import store_gains
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import match_calibrations
from minisplat_ref.types import Bools, Floats, Scene

FINE = 3.0  # pixels, standard deviation
PATCH = 32  # pixels
REACH = 3  # pixels
FALL_MIN = 0.1  # of the squared error of half a patch
NEGLIGIBLE = 1e-9  # squared error, so that none at all is no division by zero
N_ROUNDS = 4  # of the fit of an affine displacement
MEASURES = ("psnr", "fine", "edges", "moved", "warped")


def disturb(scene: Scene, disturbance: Disturbance, focal: float, rng: np.random.Generator) -> Scene:
    """Return the scene with every camera turned in a random direction, and all focal lengths wrong by a factor.

    Parameters
    ----------
    scene : Scene
        Of pinhole cameras. Those of held-out views are disturbed like the others.
    disturbance : Disturbance
    focal : float
        Relative error of the focal lengths.
    rng : numpy.random.Generator
    """
    n = len(scene.train_views)
    views = (*scene.train_views, *scene.test_views)
    moved = disturb_poses(scene._replace(train_views=views), disturbance, rng).train_views
    scaled = tuple(
        view._replace(camera=view.camera._replace(fx=view.camera.fx * (1 + focal), fy=view.camera.fy * (1 + focal)))
        for view in moved
    )
    return scene._replace(train_views=scaled[:n], test_views=scaled[n:])


def compare_sharpness(image: Floats, photograph: Floats, counted: Bools) -> dict[str, float]:
    """Return the measures of a rendering, all but the PSNR.

    Parameters
    ----------
    image, photograph : ndarray of shape (H, W, 3)
        In [0, 1], of the same colours.
    counted : ndarray of shape (H, W) of bool
        Pixels that count.
    """
    e = np.where(counted[..., None], image - photograph, 0.0)
    fine = e - gaussian_filter(e, (FINE, FINE, 0.0))
    lengths = [_edge_length(pixels, counted) for pixels in (image, photograph)]
    return {
        "fine": float((fine[counted] ** 2).sum() / max((e[counted] ** 2).sum(), NEGLIGIBLE)),
        "edges": lengths[0] / max(lengths[1], NEGLIGIBLE),
        "moved": gain_of_moved_patches(image, photograph, counted),
        "warped": gain_of_warp(image, photograph, counted),
    }


def _edge_length(pixels: Floats, counted: Bools) -> float:
    dv, du = np.gradient(pixels.mean(axis=2))
    return float(np.hypot(du, dv)[counted].sum())


def gain_of_moved_patches(image: Floats, photograph: Floats, counted: Bools) -> float:
    """Return the gain, dB, of moving each patch: chosen on one half of its columns, judged on the other half."""
    shifts = [(dv, du) for dv in range(-REACH, REACH + 1) for du in range(-REACH, REACH + 1)]
    errors = np.stack([_half_patches(_squared_error(image, photograph, counted, shift)) for shift in shifts])  # [S,Q,2]
    still = shifts.index((0, 0))
    best = errors.argmin(axis=0)  # [Q, 2]
    is_moved = (errors.min(axis=0) < (1 - FALL_MIN) * errors[still]).all(axis=1)
    is_moved &= np.abs(np.diff(np.array(shifts)[best], axis=1)).max(axis=(1, 2)) <= 1
    best[~is_moved] = still
    patches = np.arange(errors.shape[1])
    after = errors[best[:, 0], patches, 1] + errors[best[:, 1], patches, 0]
    return _decibels(errors[still].sum(), after.sum())


def _squared_error(image: Floats, photograph: Floats, counted: Bools, shift: tuple[int, int]) -> Floats:
    """Return the squared error [H, W] of the image moved by (dv, du); 0 where pixels do not count or fall outside."""
    inner = np.zeros(counted.shape, bool)
    inner[REACH:-REACH, REACH:-REACH] = True  # the same pixels for every shift
    e = np.roll(image, shift, (0, 1)) - photograph
    return np.where(counted & inner, (e**2).sum(axis=2), 0.0)


def _half_patches(values: Floats) -> Floats:
    """Return the sums over left and right halves of whole patches, [Q, 2]."""
    rows, columns = (side // PATCH for side in values.shape)
    tiles = values[: rows * PATCH, : columns * PATCH].reshape(rows, PATCH, columns, 2, PATCH // 2)
    return tiles.sum(axis=(1, 4)).reshape(-1, 2)


def gain_of_warp(image: Floats, photograph: Floats, counted: Bools) -> float:
    """Return the gain, dB, of one affine displacement, fitted to the patches of one colour of a chessboard.

    Gauss-Newton: with the slopes s of the warped image along u and v, and its residual r, ``r = -s . A (1, x, y)``.
    It is judged on the other colour, and both errors are added.
    """
    height, width = counted.shape
    v, u = np.indices((height, width))
    basis = np.stack([np.ones((height, width)), 2 * u / width - 1, 2 * v / height - 1])  # [3, H, W]
    is_black = (v // PATCH + u // PATCH) % 2 == 0
    before = after = 0.0
    for fitted, judged in ((is_black, ~is_black), (~is_black, is_black)):
        A = np.zeros((2, 3))  # pixels, of (u, v)
        for _ in range(N_ROUNDS):
            warped, inside = warp(image, A, basis)
            rows = fitted & counted & inside
            slopes = np.stack([np.gradient(warped, axis=axis)[rows] for axis in (1, 0)])  # [2, M, 3]
            fields = (slopes[:, None] * basis[None, :, rows][..., None]).reshape(6, -1)
            residual = (photograph - warped)[rows].ravel()
            step = np.linalg.lstsq(fields @ fields.T, fields @ residual, rcond=1e-6)[0]
            A += step.reshape(2, 3)
        warped, inside = warp(image, A, basis)
        rows = judged & counted & inside
        before += float(((image - photograph)[rows] ** 2).sum())
        after += float(((warped - photograph)[rows] ** 2).sum())
    return _decibels(before, after)


def warp(image: Floats, A: Floats, basis: Floats) -> tuple[Floats, Bools]:
    """Return the image [H, W, 3] read at ``(u, v) + A (1, x, y)``, and which of its pixels are read inside of it.

    Parameters
    ----------
    image : ndarray of shape (H, W, 3)
    A : ndarray of shape (2, 3)
        Pixels.
    basis : ndarray of shape (3, H, W)
        1, x and y, the last two in [-1, 1].
    """
    height, width = image.shape[:2]
    v, u = np.indices((height, width)).astype(float)
    du, dv = np.tensordot(A, basis, axes=1)
    at = np.stack([v + dv, u + du])
    inside = (at[0] >= 0) & (at[0] <= height - 1) & (at[1] >= 0) & (at[1] <= width - 1)
    channels = [map_coordinates(image[..., k], at, order=3, mode="nearest") for k in range(3)]
    return np.stack(channels, axis=2), inside


def _decibels(before: float, after: float) -> float:
    return float(10 * np.log10((before + NEGLIGIBLE) / (after + NEGLIGIBLE)))


def measure(scene: Scene, recipe_text: str, seed: int) -> dict[str, Any]:
    """Train, and return the measures of each held-out and each training view."""
    recipe, scene = recipe_of(recipe_text), store_gains(scene)
    model = train(scene, recipe, seed=seed).model
    settings = RenderSettings(scene.background, renderer=match_calibrations(recipe, model).renderer)
    result: dict[str, Any] = {"n_gaussians": len(model.gaussians.means)}
    for name, views in (("held_out", scene.test_views), ("trained", scene.train_views)):
        records: list[dict[str, float]] = []

        def on_view(view: Any, image: Floats, metrics: Any, records: list[dict[str, float]] = records) -> None:
            counted = np.ones(image.shape[:2], bool) if view.mask is None else view.mask
            photograph = view.image / np.float32(255.0)
            corrected = np.clip(correct_colors(image, view.image, view.mask), 0, 1)
            records.append({"psnr": metrics.psnr_corrected, **compare_sharpness(corrected, photograph, counted)})

        evaluate(model, views, settings, on_view=on_view)
        result[name] = {key: float(np.mean([record[key] for record in records])) for key in MEASURES}
    return result


def run(args: argparse.Namespace) -> kit.Report:
    """Train and measure.

    Raises
    ------
    InputError
        A scene, a recipe or the output folder cannot be used, or a planted error is out of range.
    """
    if not (0 <= args.degrees < 90 and -0.5 < args.focal < 0.5):
        raise InputError(f"--degrees is {args.degrees} and --focal {args.focal}: give 0 to 90, and -0.5 to 0.5")
    for text in args.recipes:
        recipe_of(text)
    scenes = {scene.name: scene for scene in (read_small(source, args.long_side) for source in args.scenes)}
    jobs = kit.jobs_of(scene=scenes, fold=range(args.folds), seed=args.seeds, recipe=args.recipes)
    settings = {"folds": args.folds, "long_side": args.long_side, "degrees": args.degrees, "focal": args.focal}

    def measure_fold(scene: str, fold: int, seed: int, recipe: str) -> dict[str, Any]:
        held_out = make_fold(scenes[scene], all_photographs(scenes[scene], False), args.folds, fold).scene
        rng = np.random.default_rng(seed)
        return measure(disturb(held_out, Disturbance(args.degrees, 0.0), args.focal, rng), recipe, seed)

    def prepare(missing: Any) -> None:
        warm_up(next(iter(scenes.values())), [recipe_of(text) for text in args.recipes] if missing else ())

    records = kit.resume(args.out, settings, jobs, measure_fold, prepare)
    rows = [summarise(records, scene, recipe) for scene in scenes for recipe in args.recipes]
    planted = f"planted errors of the cameras: {args.degrees:g} degrees, focal length {args.focal:+.1%}"
    text = f"{args.folds} folds, long side at most {args.long_side} pixels, {kit.seeds_of(args)}; {planted};"
    text += f" {describe_machine()}\n\n{to_table(rows)}"
    return kit.Report({**settings, "summary": rows, "runs": records}, draw(rows), text)


def summarise(records: Sequence[Mapping[str, Any]], scene: str, recipe: str) -> dict[str, Any]:
    """Return the row of a recipe on a scene: means over folds and seeds."""
    own = [r for r in records if (r["scene"], r["recipe"]) == (scene, recipe)]
    row: dict[str, Any] = {
        "scene": scene,
        "recipe": recipe,
        "n_gaussians": float(np.mean([r["n_gaussians"] for r in own])),
    }
    for views in ("held_out", "trained"):
        row[views] = {key: float(np.mean([r[views][key] for r in own])) for key in MEASURES}
    return row


def to_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows in Markdown, those of training views in parentheses."""

    def cell(row: Mapping[str, Any], key: str, form: str) -> str:
        return f"{row['held_out'][key]:{form}} ({row['trained'][key]:{form}})"

    heading = ["scene", "recipe", "PSNR (dB)", "fine", "edges", "moved (dB)", "warped (dB)", "Gaussians"]
    forms = (".2f", ".0%", ".2f", "+.2f", "+.2f")
    return markdown_table(
        heading,
        [
            [row["scene"], row["recipe"]]
            + [cell(row, key, form) for key, form in zip(MEASURES, forms, strict=True)]
            + [f"{row['n_gaussians']:,.0f}"]
            for row in rows
        ],
    )


def draw(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw what moved patches and a warp gain, for each scene and recipe."""
    figure, axes = subplots((7.0, 1.2 + 0.4 * len(rows)))
    y = np.arange(len(rows))
    for k, (key, label) in enumerate((("moved", "each patch moved"), ("warped", "the image warped"))):
        axes.barh(y + 0.4 * (k - 0.5), [row["held_out"][key] for row in rows], 0.38, color=SERIES[k], label=label)
    axes.set(yticks=y, xlabel="gain of the squared error of held-out photographs (dB)")
    axes.set_yticklabels([f"{row['scene']}, {row['recipe']}" for row in rows])
    axes.invert_yaxis()
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "sharpness",
        "why held-out photographs are not sharp: wrong cameras, or geometry",
        run,
        argument("scenes", nargs="+", metavar="SCENE", help="folders of scenes, or synthetic ones"),
        RESUMED_OUT,
        folds(3),
        argument("--recipes", type=NAMES, default=("adaptive",), metavar="R,Q", help="R+NAME=VALUE changes a setting"),
        argument("--degrees", type=float, default=0.0, metavar="A", help="by which each camera is turned (default 0)"),
        argument(
            "--focal", type=float, default=0.0, metavar="F", help="relative error of the focal lengths (default 0)"
        ),
        LONG_SIDE,
        SEEDS,
        description="Train on folds, and measure what displacements of held-out renderings gain. " + CONTINUES,
    ),
)
