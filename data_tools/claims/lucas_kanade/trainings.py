"""Claims ``lucas-kanade/forms`` and ``lucas-kanade/body``: velocities that agree, and what the flow loss does.

The paper is Gaussian Splatting Lucas-Kanade, arXiv 2407.11309.

*forms*: a warp is fitted to the motion of a body that turns and grows, and the three forms of its velocity are
compared, with the backward warp by Newton's method and its derivatives by differences; so is what Runge-Kutta makes of
them.

*body*: that body is filmed by a camera that stands still, or moves slowly. Trainings start from its centres at time 0,
which is favourable, at rest, and keep their number. They have no flow loss, that of the photographs, or that of the
true flow.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import group, subplots
from data_tools.claims.kit.tables import spread, table
from data_tools.claims.lucas_kanade.body import ARC, RADIUS, Body, camera_at, film, make_body
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.lucas_kanade.model import moved
from minisplat_ref.extensions.lucas_kanade.pyramid import optical_flow
from minisplat_ref.extensions.lucas_kanade.recipe import blended_steps, image_steps, next_view, rendered_flow
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.motion.field import basis, choose_centers, powers
from minisplat_ref.mechanisms.motion.velocity import Warp, canonical_velocity, integrate, invert, velocity_of_backward
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.types import Bools, Floats, Model, Scene, View

N_CENTERS, DEGREE = 32, 3  # those of the recipe
TIME = 0.5  # of the forms
DIFFERENCE = 1e-5  # of central differences, in units of length and time
ALPHA_MIN = 0.5  # of a pixel that shows the body
TIMES = np.linspace(0, 1, 5)  # at which centres are compared
CAMERAS = {"still": 0.0, "slow": ARC}
LOSSES = ("no flow loss", "flow of the photographs", "true flow")
COLUMNS = (
    ("held-out PSNR dB", spread("psnr", 2)),
    ("flow error px", spread("flow", 3)),
    ("path error px", spread("path", 2)),
    ("path error, % of radius", spread("path_3d", 1)),
)


# --- forms ---


def run_forms(args: argparse.Namespace) -> str:
    """Return a table of how far the forms are from each other, and from where the warp leads."""
    found = [compare_forms(seed) for seed in range(args.seeds)]
    rows = [[name, f"{max(errors[name] for errors in found):.1e}"] for name in found[0]]
    return markdown_table([f"largest over {args.seeds} seeds, lengths in radii", "error"], rows)


def compare_forms(seed: int) -> dict[str, float]:
    """Return the largest difference of each comparison."""
    rng = np.random.default_rng(seed)
    body = make_body(rng)
    y = body.gaussians.means.astype(np.float64)
    warp = fit(body, rng)
    x, rate, J = warp.at(y, TIME), warp.rate(y, TIME), warp.jacobians(y, TIME)
    u = canonical_velocity(J, rate)
    h = DIFFERENCE
    J_w = np.stack(
        [(invert(warp, x + h * e, TIME) - invert(warp, x - h * e, TIME)) / (2 * h) for e in np.eye(3)], axis=2
    )
    rate_w = (invert(warp, x, TIME + h) - invert(warp, x, TIME - h)) / (2 * h)
    backward = velocity_of_backward(J_w, rate_w)

    def in_world(places: Floats, time: float) -> Floats:
        return warp.rate(invert(warp, places, time), time)

    def error(a: Floats, b: Floats) -> float:
        return float(np.linalg.norm(a - b, axis=1).max())

    errors = {
        "fitted warp and the body": max(error(warp.at(y, t), body.at(t).means) for t in TIMES),
        "(i) and (iii), the latter by differences": error(rate, backward),
        "(i) and J (ii)": error(rate, np.einsum("nij,nj->ni", J, u)),
    }
    for dt in (1e-1, 1e-2, 1e-3):
        errors[f"W(y + u dt, t) and W(y, t + dt), dt = {dt:g}"] = error(
            warp.at(y + u * dt, TIME), warp.at(y, TIME + dt)
        )
    for n in (1, 2, 4, 8):
        path = integrate(in_world, y, 0.0, 1.0, n)
        errors[f"Runge-Kutta from time 0 to 1 in {n} step{'s' * (n > 1)}"] = error(path, warp.at(y, 1.0))
    return errors


def fit(body: Body, rng: np.random.Generator) -> Warp:
    """Return the warp that is nearest to the body's motion at 11 times: linear least squares for its coefficients."""
    y = body.gaussians.means.astype(np.float64)
    centers, width = choose_centers(y, N_CENTERS, rng)
    phi = basis(y, centers, width)  # [N, B]
    times = np.linspace(0, 1, 11)
    tau = np.stack([powers(t, DEGREE) for t in times])  # [T, P]
    # Separable: the values are phi A tau^T, so that A is the product of both pseudo-inverses with what is given.
    given = np.stack([body.at(t).means - y for t in times])  # [T, N, 3]
    shifts = np.einsum("bn,tni,pt->bpi", np.linalg.pinv(phi), given, np.linalg.pinv(tau))
    return Warp(centers, width, shifts)


# --- body ---


def run_body(args: argparse.Namespace) -> kit.Report:
    """Train the arms, and draw how far centres are from their paths."""
    scene = film(make_body(np.random.default_rng(0)), 0.0)
    settings = {**kit.settings_of(args, "iterations"), **kit.describe_scene(scene)}
    jobs = kit.jobs_of(seed=args.seeds, camera=CAMERAS, loss=LOSSES)
    jobs = [{"arm": f"{job['camera']}, {job['loss']}", **job} for job in jobs]

    def measure(arm: str, seed: int, camera: str, loss: str) -> dict[str, Any]:
        return outcome(CAMERAS[camera], loss, args.iterations, seed)

    found = kit.resume(args.out, settings, jobs, measure)
    records = [next(record for record in found if job.items() <= record.items()) for job in jobs]
    flow = spread("photographed_flow", 3)
    of_photographs = ", ".join(f"{camera} {flow(own)}" for camera, own in group(records, "camera").items())
    text = f"{kit.title(settings)}; {kit.seeds_of(args)}\n\n{table(records, {'arm': 'camera, arm'}, COLUMNS)}\n\n"
    text += f"error of the photographs' flow, px: {of_photographs}"
    result = {**settings, "seeds": list(args.seeds), "records": records}
    arms = kit.arms_of(records, "arm", ("psnr", "flow", "path", "path_3d"))
    return kit.Report(result, draw(records), text, arms)


def outcome(arc: float, loss: str, iterations: int, seed: int) -> dict[str, Any]:
    """Return the errors of a training, for a camera that moves by an angle."""
    body = make_body(np.random.default_rng(seed))
    scene = film(body, arc)
    model = trained(scene, body, loss, iterations, seed)
    settings = RenderSettings(scene.background, renderer=find_recipe("lucas-kanade").renderer, backend=CPU)
    paths, paths_3d = path_errors(model, body, arc)
    return {
        "psnr": evaluate(model, scene.test_views, settings).psnr,
        "flow": flow_error(model, scene, body),
        "path": float(np.mean(paths)),
        "path_3d": 100 * float(np.mean(paths_3d)),
        "paths": paths.tolist(),
        "photographed_flow": photographed_flow_error(scene, body),
    }


def trained(scene: Scene, body: Body, loss: str, iterations: int, seed: int) -> Model:
    """Return the model of a training with one flow loss, or none."""
    recipe = find_recipe("lucas-kanade", iterations)._replace(events=(), sh_degree=0)
    if loss == LOSSES[0]:
        return kit.train_with_progress(scene, configure(recipe, flow=0.0), seed, backend=CPU).model
    if loss == LOSSES[1]:
        return kit.train_with_progress(scene, recipe, seed, backend=CPU).model
    with TemporaryDirectory() as folder:
        for view in scene.train_views:
            other = next_view(scene, view)
            if other is not None:
                motion, is_body = true_flow(body, view, other)
                np.save(Path(folder) / f"{view.name}.npy", np.where(is_body[..., None], motion, np.nan))
        return kit.train_with_progress(scene, configure(recipe, flows=folder), seed, backend=CPU).model


def true_flow(body: Body, view: View, other: View) -> tuple[Floats, Bools]:
    """Return the flow of the body [H, W, 2], pixels, and where it is seen."""
    cameras = (view.camera, other.camera)
    splats, _, _ = blended_steps(body.at(view.time), body.at(other.time).means, cameras, Request(backend=CPU))
    return _mean_flow(splats.output.image[..., :2], splats.output.alpha)


def _mean_flow(flow: Floats, alpha: Floats) -> tuple[Floats, Bools]:
    return flow / np.maximum(alpha, np.finfo(flow.dtype).tiny)[..., None], alpha > ALPHA_MIN


def flow_error(model: Model, scene: Scene, body: Body) -> float:
    """Return the mean end-point error over the pixels of the body and over all pairs of successive photographs."""
    errors = []
    for view in scene.train_views:
        other = next_view(scene, view)
        if other is None:
            continue
        motion, is_body = true_flow(body, view, other)
        flow, alpha, _ = rendered_flow(model, view, other, Request(backend=CPU))
        found, _ = _mean_flow(flow, alpha)
        errors.append(np.linalg.norm(found - motion, axis=2)[is_body & (alpha > ALPHA_MIN)])
    return float(np.mean(np.concatenate(errors)))


def photographed_flow_error(scene: Scene, body: Body) -> float:
    """Return the same of the flow that is found in the photographs, where it is known."""
    errors = []
    for view in scene.train_views[::4]:
        other = next_view(scene, view)
        if other is not None:
            motion, is_body = true_flow(body, view, other)
            found = optical_flow(view.image, other.image)
            errors.append(np.linalg.norm(found.motion - motion, axis=2)[is_body & found.is_known])
    return float(np.mean(np.concatenate(errors)))


def path_errors(model: Model, body: Body, arc: float) -> tuple[Floats, Floats]:
    """Return the RMS distance of the centres from the true ones at each of TIMES, in pixels, and in radii.

    A camera that stands still does not see the motion along its rays, which only the latter counts.
    """
    in_image, in_space = [], []
    for time in TIMES:
        found, true = moved(model, time).gaussians.means, body.at(time).means  # row n is Gaussian n of the body
        camera = camera_at(arc * (time - 0.5))
        steps, _ = image_steps(true, found, (camera, camera))
        in_image.append(_rms(steps))
        in_space.append(_rms(found - true) / RADIUS)
    return np.array(in_image), np.array(in_space)


def _rms(steps: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(steps.astype(np.float64) ** 2, axis=1))))


def draw(records: list[dict[str, Any]]) -> Figure:
    """Draw the errors of the paths over time, means over the seeds."""
    figure, panels = subplots((7, 3), 1, len(CAMERAS), sharey=True)
    for ax, camera in zip(panels, CAMERAS, strict=True):
        for loss in LOSSES:
            paths = [record["paths"] for record in records if record["arm"] == f"{camera}, {loss}"]
            ax.plot(TIMES, np.mean(paths, axis=0), marker="o", label=loss)
        ax.set(title=f"{camera} camera", xlabel="time")
    ax.set_ylim(bottom=0)  # last, as it ends the scaling of both panels
    ax.legend()
    figure.axes[0].set_ylabel("error of the centres, pixels")
    return figure
