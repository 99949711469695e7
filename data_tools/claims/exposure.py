"""Exposures: multiply photographs by known gains, which the training has to recover.

The claim is ours. Every photograph of a synthetic scene is mapped by ``T_v``, a gain per channel and an offset. The
scene is trained three times: on the original photographs, on the disturbed ones, and on these with exposures. The
resulting maps E_v are determined up to one map that all share: the scene may have the colours ``K [c; 1]`` as long as
``E_v K = T_v``. K is fitted by least squares before anything is compared, and held-out renderings are mapped back by
its inverse. Without exposures every E_v is the identity, and K the best single map.

Maps are compared by their effect on the colours in the photographs: those are mostly near gray and hardly determine the
nine entries of A_v individually.
"""

import argparse
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit import recovery
from data_tools.claims.kit.claim import CALIBRATION, declare
from data_tools.claims.kit.figures import subplots
from data_tools.claims.kit.recovery import ARMS, COLORS
from data_tools.claims.kit.tables import mean
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import SPLATTING, RenderSettings
from minisplat_ref.training.calibration import EXPOSURES, expose, identity_exposures, with_exposures
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe
from minisplat_ref.types import Floats, Gaussians, Model, Scene

COLUMNS = (("maps off by (levels of 255)", mean("levels", 2)), ("held-out PSNR (dB)", mean("psnr", 2)))
GAINS = (0.7, 1.4)  # per channel, uniform in the logarithm
OFFSETS = (0.0, 0.09)
DARKER = 1 / 1.5  # factor of all photographs, so that none saturates: part of the common map


def run(args: argparse.Namespace) -> kit.Report:
    """Disturb, train and measure."""
    scene, recipe = recovery.scene_and_recipe(args)
    arms = measure(scene, recipe, args.seed)
    return recovery.report(args, scene, arms, COLUMNS, draw(arms))


def measure(scene: Scene, recipe: Recipe, seed: int, arms: tuple[str, ...] = ARMS) -> dict[str, dict[str, Any]]:
    """Train the arms, and return for each the errors of its maps, and the PSNR of held-out views."""
    n_views = len(scene.train_views)
    identities = identity_exposures(n_views)[EXPOSURES]
    disturbed, maps = disturb_exposures(scene, np.random.default_rng(seed))
    colors = np.concatenate([view.image.reshape(-1, 3) for view in scene.train_views]) / 255
    result = {}
    for arm in kit.with_progress(arms, "trainings"):
        photographed, truth = (scene, identities) if arm == "undisturbed" else (disturbed, maps)
        state = train(photographed, configure(recipe, exposure="learned" if arm == "calibrated" else "none"), seed=seed)
        exposures = state.shared.get(EXPOSURES, identities)
        K = common_map(exposures, truth)
        recovered = compose(exposures, K)
        result[arm] = {
            "levels": (255 * color_errors(recovered, truth, colors)).tolist(),
            "mean_color": {name: map_mean(maps, colors) for name, maps in (("true", truth), ("found", recovered))},
            "psnr": measure_held_out_psnr(state.gaussians, scene, K),
        }
    return result


def disturb_exposures(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Floats]:
    """Return the scene with every training photograph mapped by a random T_v, and these maps [V, 3, 4]."""
    maps = np.zeros((len(scene.train_views), 3, 4))
    low, high = np.log(GAINS)
    for T in maps:
        T[:, :3] = DARKER * np.diag(np.exp(rng.uniform(low, high, 3)))
        T[:, 3] = DARKER * rng.uniform(*OFFSETS, 3)
    views = tuple(
        view._replace(image=np.round(255 * expose(view.image / 255, T)).astype(np.uint8))
        for view, T in zip(scene.train_views, maps, strict=True)
    )
    return scene._replace(train_views=views), maps


def common_map(exposures: Floats, truth: Floats) -> Floats:
    """Return the K [3, 4] that minimises ``sum_v |E_v K - T_v|^2``.

    ``E_v K`` is A_v K + [0 | b_v]. If the colours of all photographs have the same weights in every view, the squared
    error of the mapped colours has the same minimum.

    Parameters
    ----------
    exposures, truth : ndarray of shape (V, 3, 4)
        E_v and T_v.
    """
    A, b = exposures[..., :3], exposures[..., 3:]
    rest = truth - np.concatenate([np.zeros_like(A), b], axis=2)  # [V, 3, 4]
    return np.linalg.lstsq(A.reshape(-1, 3), rest.reshape(-1, 4))[0]


def compose(exposures: Floats, K: Floats) -> Floats:
    """Return the maps ``E_v K`` [V, 3, 4]: first K, then E_v."""
    maps = exposures[..., :3] @ K
    maps[..., 3] += exposures[..., 3]
    return maps


def color_errors(maps: Floats, truth: Floats, colors: Floats) -> Floats:
    """Return the root mean square difference [V] of two sets of maps [V, 3, 4] on colours [P, 3] in [0, 1]."""
    homogeneous = np.column_stack([colors, np.ones(len(colors))])  # [P, 4]
    moments = homogeneous.T @ homogeneous / len(colors)  # [4, 4]
    differences = maps - truth  # [V, 3, 4]
    return np.sqrt(np.einsum("vij,jk,vik->v", differences, moments, differences) / 3)


def map_mean(maps: Floats, colors: Floats) -> list[list[float]]:
    """Return the mean of colours [P, 3] under each of the maps, [V, 3]."""
    return (maps @ np.append(colors.mean(axis=0), 1)).tolist()


def inverse(K: Floats) -> Floats:
    """Return the map [3, 4] that undoes K: ``c = M^-1 (c' - m)``."""
    M = np.linalg.inv(K[:, :3])
    return np.column_stack([M, -M @ K[:, 3]])


def measure_held_out_psnr(gaussians: Gaussians, scene: Scene, K: Floats) -> float:
    """Return the mean PSNR of the test views, whose renderings are mapped by the inverse of K.

    The renderer with exposures does this: its only exposure is the inverse, and every view uses it.
    """
    views = [view._replace(view_id=0) for view in scene.test_views]
    model = Model(gaussians, {EXPOSURES: inverse(K)[None]})
    psnr = evaluate(model, views, RenderSettings(scene.background, renderer=with_exposures(SPLATTING))).psnr
    assert psnr is not None, "there are test views"
    return psnr


def draw(result: dict[str, dict[str, Any]]) -> Figure:
    """Draw how the maps change the mean colour, each photograph's error, and the PSNR of the three trainings."""
    figure, (maps, errors, quality) = subplots((10, 3), 1, 3)
    maps.axline((0.5, 0.5), slope=1, color="black", linewidth=0.5)
    for arm in ARMS[1:]:
        means = result[arm]["mean_color"]
        maps.plot(np.ravel(means["true"]), np.ravel(means["found"]), ".", color=COLORS[arm])
    true = np.ravel(result["calibrated"]["mean_color"]["true"])
    limits = (true.min() - 0.02, true.max() + 0.02)
    maps.set(title="mean colour, each channel", xlabel="as disturbed", ylabel="as recovered", xlim=limits, ylim=limits)
    recovery.draw_errors(errors, result, "levels")
    errors.set(title="maps against the truth", ylabel="levels of 255")
    errors.legend()
    recovery.draw_quality(quality, result)
    return figure


CLAIMS = (declare("exposure", "exposure per photograph: disturbed by known maps, and recovered", run, *CALIBRATION),)
