"""Claim ``mvg/insertion``: what becomes of wrong depths, with and without the test whether views agree.

The paper is MVG-Splatting, arXiv 2407.11840. The true depth maps of a synthetic scene get noise of 0.3 %, and a share
of their pixels gets a wrong depth. *Scattered* errors are drawn for each pixel alone, by up to 30 % nearer or farther.
*Shared* ones are balls that float before the surface and that all views see, as training leaves them. Points are taken
from these maps by the rules of the recipe, and one that is off its surface by more than 1 % of its depth is wrong.
"""

import argparse
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.claim import OUT, declare, number, seeds, synthetic_scene
from data_tools.claims.kit.figures import group, plot_curves, subplots
from data_tools.claims.kit.mesh_distances import OrientedPoints, compare_surfaces
from data_tools.claims.kit.tables import spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.mvg.insertion import Insertions, Photographed, Rules, propose, smooth_map
from minisplat_ref.interface.palette import BLUE, GREY, OCHRE
from minisplat_ref.mechanisms.depth_maps.normals import central_normals
from minisplat_ref.mechanisms.depth_maps.reprojection import DepthView, Tolerances, unproject
from minisplat_ref.mechanisms.oriented.thin_axis import angles_between
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.types import Camera, Floats

SHARES = (0.05, 0.1, 0.2)
WIDTH, HEIGHT = 240, 180
NOISE, ERROR_MAX, WRONG = 0.003, 0.3, 0.01  # relative to the depth
BALL = 0.03  # radius of a floating ball, relative to its distance
N_TRUE, N_EQUAL = 20_000, 1_000  # points of the true surface, and of each arm where completeness is compared
TAU = 0.02  # metres: within which a true point is found
STRIDES, ALIKE, N_SOURCES = (4, 0, 2), (3, 3, 3), 4


class Arm(NamedTuple):
    """How points are taken."""

    is_smoothed: bool
    n_views: int
    """Views that must agree; 0 without the test."""
    strides: tuple[int, int, int] = STRIDES

    @property
    def rules(self) -> Rules:
        """The same as the insertion takes it."""
        return Rules(Tolerances(n_views=self.n_views), N_SOURCES if self.n_views else 0, self.strides)


ARMS = {
    "neither filter nor test": Arm(False, 0),
    "filter": Arm(True, 0),
    "filter, 1 view agrees": Arm(True, 1),
    "filter, 2 views agree": Arm(True, 2),
    "filter, 3 views agree": Arm(True, 3),
    "2 views agree": Arm(False, 2),
}
EQUAL = {
    "filter": ARMS["filter"],
    "filter, 2 views agree": ARMS["filter, 2 views agree"],
    "filter, 2 views agree, all levels alike": Arm(True, 2, ALIKE),
}
RECIPE_ARM = "filter, 2 views agree"


def run(args: argparse.Namespace) -> kit.Report:
    """Measure with every seed."""
    records = [
        record
        for seed in kit.with_progress(range(args.seeds), "seeds")
        for record in measure(args.scene, args.views, seed)
    ]
    settings = {"scene": args.scene, **kit.settings_of(args, "views", "seeds")}
    text = f"{args.scene}, {args.views} views of {WIDTH} x {HEIGHT}, noise {100 * NOISE:g} %; {args.seeds} seeds\n\n"
    result = {**settings, "records": records}
    of_points = [record for record in records if "wrong" in record]
    return kit.Report(result, draw(records), text + tables(records), kit.arms_of(of_points, "arm", ("wrong", "n")))


def measure(name: str, n_views: int, seed: int, width: int = WIDTH, height: int = HEIGHT) -> list[dict[str, Any]]:
    """Return a record for each kind of error, share and arm."""
    made = make_scene(
        name, n_views=n_views, width=width, height=height, seed=seed, supersampling=1, n_points=100, test_every=0
    )
    truth, records = true_surface(made, np.random.default_rng(seed)), []
    for kind, spoil in (("scattered", scatter), ("shared", float_balls)):
        for share in SHARES:
            rng = np.random.default_rng((seed, round(100 * share)))
            noisy = made.train_depths * (1 + NOISE * rng.standard_normal(made.train_depths.shape))
            depths = spoil(noisy, [view.camera for view in made.scene.train_views], share, rng)
            raw = [
                Photographed(DepthView(depth, view.camera), view.image / 255)
                for depth, view in zip(depths, made.scene.train_views, strict=True)
            ]
            smooth = [smooth_map(view) for view in raw]
            found = {
                arm: propose(smooth if how.is_smoothed else raw, how.rules, np.random.default_rng(seed))
                for arm, how in (ARMS | EQUAL).items()
            }
            n_equal = min(N_EQUAL, *(len(found[arm].points) for arm in EQUAL))
            for arm, points in found.items():
                record = {"kind": kind, "share": share, "arm": arm, "seed": seed, **correctness(points, made)}
                if arm in EQUAL:
                    record |= completeness(points, truth, n_equal, np.random.default_rng(seed))
                records.append(record)
            for arm, views in (("normals of the map", raw), ("normals of the filtered map", smooth)):
                records.append({"kind": kind, "share": share, "arm": arm, "seed": seed, "angle": angle(views, made)})
    return records


def scatter(depths: Floats, cameras: list[Camera], share: float, rng: np.random.Generator) -> Floats:
    """Return depth maps [V, H, W] of which a share of pixels is wrong, each by itself."""
    factors = 1 + rng.uniform(-ERROR_MAX, ERROR_MAX, depths.shape)
    return np.where(rng.random(depths.shape) < share, depths * factors, depths)


def float_balls(depths: Floats, cameras: list[Camera], share: float, rng: np.random.Generator) -> Floats:
    """Return depth maps [V, H, W] with floating balls, as many as cover the share of the surface."""
    spoilt = depths.copy()
    while np.mean((spoilt != depths)[depths > 0]) < share:
        k = int(rng.integers(len(cameras)))
        pixels = np.flatnonzero(depths[k] > 0)
        point = unproject(DepthView(depths[k], cameras[k])).reshape(-1, 3)[rng.choice(pixels)]
        to_camera = cameras[k].center - point
        center = point + rng.uniform(0.1, ERROR_MAX) * to_camera
        radius = BALL * float(np.linalg.norm(to_camera))
        for depth, camera in zip(spoilt, cameras, strict=True):
            ball = _ball_depth(camera, depth.shape, center, radius)
            np.copyto(depth, ball, where=(ball > 0) & (ball < depth))
    return spoilt


def _ball_depth(camera: Camera, shape: tuple[int, ...], center: Floats, radius: float) -> Floats:
    """Return camera z [H, W] of the near side of a ball: the lesser root of |z r - c|^2 = radius^2; 0 beside it."""
    rays = pinhole_rays(np.arange(shape[1]) + 0.5, np.arange(shape[0])[:, None] + 0.5, camera)
    c = camera.cam_from_world_R @ center + camera.cam_from_world_t
    a, b = np.sum(rays * rays, axis=2), rays @ c
    under = b * b - a * (c @ c - radius**2)
    return np.where(under > 0, (b - np.sqrt(np.maximum(under, 0))) / a, 0)


def true_surface(made: SyntheticScene, rng: np.random.Generator) -> OrientedPoints:
    """Return points of the surface that the views see."""
    views = zip(made.train_depths, made.scene.train_views, strict=True)
    points = np.concatenate([unproject(DepthView(depth, view.camera))[depth > 0] for depth, view in views])
    chosen = rng.choice(len(points), min(N_TRUE, len(points)), replace=False)
    return OrientedPoints(points[chosen], made.train_normals[made.train_depths > 0][chosen])


def correctness(found: Insertions, made: SyntheticScene) -> dict[str, float]:
    """Return how many points there are, the share in per cent that is wrong, and the median angle of their normals.

    Of no points the last two are not a number.
    """
    rows, columns = np.divmod(found.pixels, made.train_depths.shape[2])
    true = made.train_depths[found.views, rows, columns]
    cameras = [view.camera for view in made.scene.train_views]
    axes = np.array([camera.cam_from_world_R[2] for camera in cameras])[found.views]
    depths = np.sum(axes * found.points, axis=1) + np.array([c.cam_from_world_t[2] for c in cameras])[found.views]
    is_wrong = np.abs(depths - true) > WRONG * true
    angles = angles_between(found.normals, made.train_normals[found.views, rows, columns])
    has_any = len(is_wrong) > 0
    return {
        "n": len(is_wrong),
        "wrong": 100 * float(is_wrong.mean()) if has_any else np.nan,
        "angle": float(np.median(angles)) if has_any else np.nan,
    }


def completeness(found: Insertions, truth: OrientedPoints, n: int, rng: np.random.Generator) -> dict[str, float]:
    """Return how far the true surface is from n of the points in mm, and their F-score in per cent."""
    some = rng.permutation(len(found.points))[:n]
    distances = compare_surfaces(OrientedPoints(found.points[some], found.normals[some]), truth, TAU)
    return {"n_equal": n, "completeness": 1000 * distances.completeness, "f_score": 100 * distances.f_score}


def angle(views: list[Photographed], made: SyntheticScene) -> float:
    """Return the median angle in degrees between the normals of depth maps and the true ones."""
    angles = []
    for view, normals in zip(views, made.train_normals, strict=True):
        n = central_normals(view.seen.depth, view.seen.camera) @ view.seen.camera.cam_from_world_R
        has_both = (np.abs(n).sum(axis=2) > 0) & (np.abs(normals).sum(axis=2) > 0)
        angles.append(angles_between(n, normals)[has_both])
    return float(np.median(np.concatenate(angles)))


def tables(records: list[dict[str, Any]]) -> str:
    """Return the tables: wrong points, normals, completeness at an equal count."""
    kinds = [(kind, share) for kind in ("scattered", "shared") for share in SHARES]

    def by_kind(title: str, arms: Iterable[str], key: str, digits: int) -> str:
        def at(*kind: Any) -> Callable[[dict[str, Any]], float | None]:
            return lambda record: record.get(key) if (record["kind"], record["share"]) == kind else None

        columns = [(f"{kind}, {100 * share:g} %", spread(at(kind, share), digits)) for kind, share in kinds]
        own = [record for arm in arms for record in records if record["arm"] == arm]
        return f"{title}\n\n{table(own, {'arm': 'points'}, columns)}\n"

    normals = ("normals of the map", "normals of the filtered map", RECIPE_ARM)
    return "\n".join(
        [
            by_kind("Wrong points (%)", ARMS, "wrong", 1),
            by_kind("Points", ARMS, "n", 0),
            by_kind("Normals, median angle (degrees)", normals, "angle", 1),
            by_kind("Points compared at an equal count", EQUAL, "n_equal", 0),
            by_kind("Mean distance of the surface to these (mm)", EQUAL, "completeness", 1),
            by_kind(f"F-score of these within {1000 * TAU:g} mm (%)", EQUAL, "f_score", 1),
        ]
    )


def draw(records: list[dict[str, Any]]) -> Figure:
    """Draw the share of wrong points over the share of wrong pixels."""
    figure, panels = subplots((9, 3.2), 1, 2, sharey=True)
    colors = {"filter": GREY, RECIPE_ARM: BLUE, "2 views agree": OCHRE}
    in_percent = [{**record, "percent": 100 * record["share"]} for record in records if "wrong" in record]
    for axes, (kind, own) in zip(panels, group(in_percent, "kind").items(), strict=True):
        plot_curves(axes, own, "percent", "wrong", colors)
        axes.set(title=f"{kind} errors", xlabel="wrong pixels (%)")
    panels[0].set_ylabel("wrong points (%)")
    panels[0].legend(frameon=False)
    return figure


CLAIMS = (
    declare(
        "insertion",
        "wrong insertions, normals and completeness from faulty depth maps",
        run,
        *(synthetic_scene(), OUT, number("--views", 12, "of 240 x 180 pixels", minimum=3), seeds(3)),
    ),
)
