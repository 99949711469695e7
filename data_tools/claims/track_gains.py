"""What the tracks of structure from motion say about the exposures of photographs, before any training.

The claim is ours: that log colour = log gain of the photograph + log colour of the point explains points to which no
gain was fitted, where exposures differ, and that it is refused where they do not. Two tables show it.

*Scenes.* The spread of the gains, their error, and the variation of a point's colour from photograph to photograph at
points that were not fitted, in percent: as photographed, after the gains, and after the gains with one more effect that
is fitted to the same half of the points:

============  ==========================================================================================
response      of each photograph: the log colour of the point above :data:`MIDDLE`, an exponent
vignetting    of the lens: r^2, with r the distance from the principal point over half the diagonal
slope         of each photograph: u and v over the image, a light from one side
curved map    of each photograph: u, v, u^2, v^2 and u v
============  ==========================================================================================

*Alarms.* Synthetic scenes have equal exposures. Their photographs are multiplied by gains of a given standard
deviation, 0 included, and the share of scenes is counted in which gains are said to be needed. Points of synthetic
scenes are as view-dependent as their surfaces, glossy ones included.
"""

import argparse
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.folds import read_small
from data_tools.claims.kit.claim import LONG_SIDE, NAMES, OUT, SEEDS, argument, declare
from data_tools.claims.kit.figures import subplots
from minisplat_ref.datasets.synthetic import SCENE_NAMES, make_scene
from minisplat_ref.interface.palette import BLUE, GREEN, GREY, OCHRE, PURPLE, RED
from minisplat_ref.interface.reporting import describe_machine, markdown_table
from minisplat_ref.reference.pinhole import project_into_image
from minisplat_ref.strategy.track_gains import MAD_TO_SIGMA, SCALE_MIN, estimate_gains, observe_points
from minisplat_ref.types import Floats, Ints, Scene

N_ROUNDS = 40  # of alternating least squares and weights
RIDGE = 1e-6  # of the number of observations: an effect that a photograph does not show is 0
MIDDLE = -1.0  # log colour that a response leaves as it is
PLANTED = (0.0, 0.03, 0.05, 0.1)  # standard deviations of log gains
SYNTHETIC: dict[str, Any] = {"n_views": 20, "width": 160, "height": 120, "n_points": 3000}
COLORS = (GREY, BLUE, OCHRE, GREEN, PURPLE, RED)


class Tracks(NamedTuple):
    """Observations of sparse points in photographs, M of them."""

    view: Ints
    """[M] photograph."""
    point: Ints
    """[M] point."""
    log_color: Floats
    """[M] mean of the channels."""
    place: Floats
    """[M, 2] u and v in the image, from -1 to 1."""
    r2: Floats
    """[M] square of the distance from the principal point, over half the diagonal of the image."""


def collect_tracks(scene: Scene) -> Tracks:
    """Return the observations of the training photographs."""
    observed = observe_points(scene.train_views, scene.points)
    place, r2 = np.zeros((len(observed.view_ids), 2)), np.zeros(len(observed.view_ids))
    for index, view in enumerate(scene.train_views):
        rows, camera = observed.view_ids == index, view.camera
        _, xy, _ = project_into_image(scene.points[observed.point_ids[rows]], camera)
        size = np.array([camera.width, camera.height])
        place[rows] = 2 * xy / size - 1
        r2[rows] = (((xy - [camera.cx, camera.cy]) / (np.hypot(*size) / 2)) ** 2).sum(axis=1)
    return Tracks(observed.view_ids, observed.point_ids, observed.log_colors.mean(axis=1), place, r2)


def columns_of(effect: str, tracks: Tracks, colors: Floats) -> tuple[Floats, bool]:
    """Return the columns [M, K] of an effect besides the gain, and whether all photographs share its coefficients.

    Parameters
    ----------
    effect : str
        A row of the table above; ``gains`` has no further column.
    tracks : Tracks
    colors : ndarray of shape (P,)
        Log colours of the points.
    """
    u, v = tracks.place.T
    columns = {
        "gains": [],
        "response": [colors[tracks.point] - MIDDLE],
        "vignetting": [tracks.r2],
        "slope": [u, v],
        "curved map": [u, v, u * u, v * v, u * v],
    }[effect]
    return np.array(columns).reshape(-1, len(u)).T, effect == "vignetting"


EFFECTS = ("gains", "response", "vignetting", "slope", "curved map")


def fit_effect(effect: str, tracks: Tracks, n_views: int, n_points: int) -> tuple[Floats, Floats]:
    """Return the coefficients of each photograph [V, 1 + K], the gain first, and the log colours [P] of the points.

    Alternating weighted least squares, with the Cauchy weights of :mod:`minisplat_ref.strategy.track_gains`. The mean
    of each coefficient that a photograph has of its own is 0.
    """
    weights: Floats = np.ones(len(tracks.view))
    colors = _means(tracks, tracks.log_color, weights, n_points)
    coefficients = np.zeros((n_views, 1))
    for _ in range(N_ROUNDS):
        columns, is_shared = columns_of(effect, tracks, colors)
        rest = tracks.log_color - colors[tracks.point]
        common: Floats = np.zeros(columns.shape[1])
        if is_shared:
            centred = columns - np.stack(
                [_means(tracks, c, weights, n_points)[tracks.point] for c in columns.T], axis=1
            )
            own = rest - _means_of_views(tracks, rest, weights, n_views)[tracks.view]
            common = _solve(centred, own, weights)
        fitted = np.column_stack([np.ones(len(rest)), *([] if is_shared else [columns])])
        rest = rest - columns @ common if is_shared else rest
        own = np.array([_solve(fitted[r], rest[r], weights[r]) for r in (tracks.view == k for k in range(n_views))])
        own -= own.mean(axis=0)
        coefficients = np.column_stack([own, np.tile(common, (n_views, 1))]) if is_shared else own
        explained = _explain(effect, tracks, colors, coefficients)
        colors = _means(tracks, tracks.log_color - explained, weights, n_points)
        e = tracks.log_color - explained - colors[tracks.point]
        weights = 1 / (1 + (e / max(MAD_TO_SIGMA * np.median(np.abs(e)), SCALE_MIN)) ** 2)
    return coefficients, colors


def measure_residual(effect: str, tracks: Tracks, coefficients: Floats, n_points: int) -> float:
    """Return the robust standard deviation of the log colours of a point after an effect, of points seen twice."""
    ones = np.ones(len(tracks.view))
    colors = _means(tracks, tracks.log_color, ones, n_points)
    for _ in range(5):  # the response needs the colours of the points, which need the response
        explained = _explain(effect, tracks, colors, coefficients)
        colors = _means(tracks, tracks.log_color - explained, ones, n_points)
    n = np.bincount(tracks.point, minlength=n_points)[tracks.point]
    e = (tracks.log_color - explained - colors[tracks.point]) * np.sqrt(n / np.maximum(n - 1, 1))
    return float(MAD_TO_SIGMA * np.median(np.abs(e[n > 1])))


def cross_validate(effect: str, tracks: Tracks, n_views: int, n_points: int) -> float:
    """Return the mean residual of each half of the points after an effect that was fitted to the other half."""
    residuals = []
    for parity in (0, 1):
        is_fitted = tracks.point % 2 == parity
        fitted, judged = (Tracks(*(field[rows] for field in tracks)) for rows in (is_fitted, ~is_fitted))
        coefficients, _ = fit_effect(effect, fitted, n_views, n_points)
        residuals.append(measure_residual(effect, judged, coefficients, n_points))
    return float(np.mean(residuals))


def _explain(effect: str, tracks: Tracks, colors: Floats, coefficients: Floats) -> Floats:
    columns, _ = columns_of(effect, tracks, colors)
    own = coefficients[tracks.view]
    return own[:, 0] + (columns * own[:, 1:]).sum(axis=1)


def _means(tracks: Tracks, values: Floats, weights: Floats, n_points: int) -> Floats:
    """Return the weighted mean of values [M] over the photographs of each point [P]; 0 of a point without any."""
    totals = np.bincount(tracks.point, weights, n_points)
    return np.bincount(tracks.point, weights * values, n_points) / np.maximum(totals, np.finfo(float).tiny)


def _means_of_views(tracks: Tracks, values: Floats, weights: Floats, n_views: int) -> Floats:
    totals = np.bincount(tracks.view, weights, n_views)
    return np.bincount(tracks.view, weights * values, n_views) / np.maximum(totals, np.finfo(float).tiny)


def _solve(columns: Floats, values: Floats, weights: Floats) -> Floats:
    """Return the weighted least squares solution [K], with a slight ridge."""
    weighted = weights[:, None] * columns
    ridge = RIDGE * max(len(values), 1) * np.eye(columns.shape[1])
    return np.linalg.solve(columns.T @ weighted + ridge, weighted.T @ values)


# --- the claim ---


def examine(scene: Scene) -> dict[str, Any]:
    """Return the row of a scene."""
    gains, tracks = estimate_gains(scene), collect_tracks(scene)
    n_views, n_points = len(scene.train_views), len(scene.points)
    return {
        "scene": scene.name,
        "views": n_views,
        "spread": gains.spread,
        "error": gains.error,
        "are_needed": gains.are_needed,
        "none": gains.residual,
        **{effect: cross_validate(effect, tracks, n_views, n_points) for effect in EFFECTS},
    }


def plant(scene: Scene, deviation: float, rng: np.random.Generator) -> Scene:
    """Return the scene with each photograph multiplied by a gain; darkened by it, so that nothing is clipped."""
    log_gains = rng.normal(0.0, deviation, len(scene.train_views))
    log_gains -= log_gains.max()
    views = tuple(
        view._replace(image=np.rint(np.exp(g) * view.image).astype(np.uint8))
        for view, g in zip(scene.train_views, log_gains, strict=True)
    )
    return scene._replace(train_views=views)


def count_alarms(kinds: Sequence[str], seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Return for each synthetic scene, seed and planted deviation what the tracks say."""
    records = []
    for kind in kit.with_progress(kinds, "scenes"):
        scene = make_scene(kind, supersampling=1, **SYNTHETIC).scene
        for seed in seeds:
            for deviation in PLANTED:
                gains = estimate_gains(plant(scene, deviation, np.random.default_rng(seed)))
                records.append(
                    {"kind": kind, "seed": seed, "planted": deviation, "spread": gains.spread, "on": gains.are_needed}
                )
    return records


def run(args: argparse.Namespace) -> kit.Report:
    """Examine scenes, and count alarms."""
    rows = [examine(read_small(source, args.long_side)) for source in args.scenes]
    alarms = count_alarms(args.kinds, args.seeds)
    machine = describe_machine()
    heading = ["scene", "photographs", "spread", "error", "needed", "as photographed", *EFFECTS]
    cells = [
        [r["scene"], str(r["views"]), f"{r['spread']:.1%}", f"{r['error']:.1%}", "yes" if r["are_needed"] else "no"]
        + [f"{r[key]:.2%}" for key in ("none", *EFFECTS)]
        for r in rows
    ]
    counts = [
        [f"{deviation:.0%}", f"{sum(r['on'] for r in own)} of {len(own)}"]
        for deviation in PLANTED
        for own in [[r for r in alarms if r["planted"] == deviation]]
    ]
    text = (
        f"photographs of at most {args.long_side} pixels; {machine}\n\n{markdown_table(heading, cells)}\n\n"
        f"{len(args.kinds)} synthetic scenes, {kit.seeds_of(args)}\n\n"
        + markdown_table(["planted standard deviation", "said to be needed"], counts)
    )
    result = {"machine": machine, "long_side": args.long_side, "scenes": rows, "alarms": alarms}
    return kit.Report(result, draw(rows), text)


def draw(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the variation of a point's colour in each scene, without and with each effect."""
    figure, axes = subplots((6.5, 1.2 + 0.5 * len(rows)))
    for k, (effect, color) in enumerate(zip(("none", *EFFECTS), COLORS, strict=True)):
        places = [row + 0.13 * (k - 2.5) for row in range(len(rows))]
        label = "as photographed" if effect == "none" else effect
        axes.barh(places, [100 * r[effect] for r in rows], height=0.12, color=color, label=label)
    axes.set(yticks=range(len(rows)), xlabel="variation of a point's colour from photograph to photograph (%)")
    axes.set_yticklabels([r["scene"] for r in rows])
    axes.invert_yaxis()
    axes.legend()
    return figure


CLAIMS = (
    declare(
        "track-gains",
        "exposures that the tracks of structure from motion show, and false alarms",
        run,
        argument("scenes", nargs="+", metavar="SCENE", help="folders of scenes, or synthetic ones"),
        OUT,
        LONG_SIDE,
        argument(
            "--kinds",
            type=NAMES,
            default=tuple(SCENE_NAMES),
            metavar="A,B",
            help="synthetic scenes whose alarms are counted (default: all)",
        ),
        SEEDS,
    ),
)
