"""The work of ``fans/refit``: what a trained scene loses as a mesh, and what refitting gives back."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from data_tools.claims import kit
from data_tools.claims.fans.shape_search import best_shape, render_clipped
from minisplat_ref.extensions.fans.commands import fine_tune, measure
from minisplat_ref.extensions.fans.mesh_files import write_mesh
from minisplat_ref.extensions.fans.model import (
    FRONT_REACH,
    Fans,
    FanShape,
    convert_gaussians,
    mesh_of,
    render_fans,
    visible_mesh,
)
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import Request
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.types import Gaussians, Model, Scene, View, some_of

REACHES, RIMS = (2.0, 2.5, 3.0, 3.5), (0.0, 0.1, 0.2)
SIDES = (3, 4, 6, 8, 12, 16)
LAYERS = (4, 8, 16, 32, 64)
VIEWS_MAX = 4  # training views that shapes are compared and fitted on
FLAT, SOLID = "flat fans", "solid fans"
FORMS = {FLAT: FanShape(reach=FRONT_REACH), SOLID: FanShape(reach=FRONT_REACH, is_flat=False)}


class Judge(NamedTuple):
    """A scene, and the views on which shapes are compared."""

    scene: Scene
    views: list[View]


def judge_of(scene: Scene) -> Judge:
    """Return the scene with a few of its training views, spread evenly."""
    return Judge(scene, [view.load() for view in some_of(scene.train_views, VIEWS_MAX)])


def shape_rows(gaussians: Gaussians, judge: Judge, shape: FanShape) -> list[dict[str, Any]]:
    """Return the PSNR of fans against splats of degree 0, over reach and rim, and at the best of these over sides."""
    background = judge.scene.background
    targets = [render_clipped(gaussians, view, background=background, sh_degree=0) for view in judge.views]

    def row(shape: FanShape) -> dict[str, Any]:
        fans = convert_gaussians(gaussians, shape)
        psnrs = [
            kit.psnr_of(render_clipped(fans, v, background=background), target)
            for v, target in zip(judge.views, targets, strict=True)
        ]
        return {**shape._asdict(), "psnr": float(np.mean(psnrs))}

    rows = [row(shape._replace(reach=reach, rim=rim)) for reach in REACHES for rim in RIMS]
    best = max(rows, key=lambda row: row["psnr"])
    at_best = shape._replace(reach=best["reach"], rim=best["rim"])
    sides = [n for n in SIDES if n != shape.n_sides and (shape.is_flat or n % 4 == 0)]
    return [*rows, *(row(at_best._replace(n_sides=n)) for n in sides)]


def refit_rows(
    gaussians: Gaussians, judge: Judge, iterations: int, seed: int, told: Callable[[str], None]
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a row for each form of a scene, and the populations by its name.

    Parameters
    ----------
    gaussians : Gaussians
    judge : Judge
    iterations : int
        Of the vertices' refit, and of the splats that are trained on beside it.
    seed : int
    told : callable
        Called with the name of what comes next.
    """
    scene = judge.scene
    without_view = gaussians._replace(sh_rest=gaussians.sh_rest[:, :0])
    forms: dict[str, Any] = {"splats": gaussians, "splats, degree 0": without_view}
    told("splats, trained on")
    recipe = kit.drop_events(scale_recipe(GS_ACCEL, iterations))
    forms["splats, trained on"] = kit.fine_tune(gaussians, scene, recipe, seed)
    forms["splats, degree 0, trained on"] = kit.fine_tune(without_view, scene, recipe, seed)
    photographs = [view.image / 255 for view in judge.views]
    shapes: dict[str, FanShape] = {}
    for name, shape in FORMS.items():
        told(name)
        forms[name] = convert_gaussians(gaussians, shape)
        fitted = best_shape(gaussians, shape, judge.views, photographs, scene.background)
        shapes[f"{name}, reach and rim"] = fitted
        forms[f"{name}, reach and rim"] = convert_gaussians(gaussians, fitted)
        forms[f"{name}, vertices"] = fine_tune(forms[f"{name}, reach and rim"], scene, iterations, seed)
    rows = []
    for name, population in forms.items():
        test, training = (measure(population, scene, views) for views in (scene.test_views, scene.train_views))
        shape_found = shapes.get(name)
        fit = {} if shape_found is None else {"reach": shape_found.reach, "rim": shape_found.rim}
        size = {} if isinstance(population, Gaussians) else _size(population)
        rows.append({"form": name, "psnr": test.psnr, "ssim": test.ssim, "training_psnr": training.psnr, **fit, **size})
    return rows, forms


def layer_rows(fans: Fans, judge: Judge) -> list[dict[str, Any]]:
    """Return the error of images of a few layers against that of all, and the number of layers of a pixel."""
    request = Request(judge.scene.background.astype(np.float32))
    whole = [render_fans(Model(fans), view, request) for view in judge.views]
    layers = np.concatenate([tape.peeled.n_layers.ravel() for _, tape in whole])
    rows: list[dict[str, Any]] = [{"layers": "all", "mean": float(layers.mean()), "most": int(layers.max())}]
    for n in LAYERS:
        images = [render_fans(Model(fans), view, request, max_layers=n)[0].image for view in judge.views]
        squares = [np.mean((image - output.image) ** 2) for image, (output, _) in zip(images, whole, strict=True)]
        rows.append({"layers": n, "rms_levels": 255 * float(np.sqrt(np.mean(squares)))})
    return rows


def _size(fans: Fans) -> dict[str, int]:
    """Return the triangles and vertices of a mesh, and its bytes as a PLY."""
    mesh = visible_mesh(mesh_of(fans), 1 / 255)
    with TemporaryDirectory() as folder:
        path = Path(folder, "mesh.ply")
        write_mesh(path, mesh)
        return {"triangles": len(mesh.faces), "vertices": len(mesh.vertices), "bytes": path.stat().st_size}
