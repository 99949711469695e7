"""Claim ``cus/floats`` (arXiv 2511.17904): floats and error of features from anchors, and of a query for each Gaussian.

The photographs of the *room* get feature maps that a teacher makes of the exact ids of its objects: a random direction
for each label, and texture, a random projection of the classical features. Anchors train with these maps and latents
of several widths. Then every Gaussian of the widest anchors gets a query of its own in place of the networks' query,
of several widths; these train by the same feature loss, on the geometry as it is, for as many iterations.

At held-out views features are compared with the teacher's. A read-out gives a pixel the label whose mean feature, over
the training views, has the largest cosine with its own; labels are compared with the exact ones by intersection over
union. Floats are those that only the features need, with the latents, which colours need, too; the memory, as large for
all, is left out.

A second table has the images: PSNR and floats of everything, beside those of a training by ``adaptive``, which has no
features. Rates of both kinds of queries were chosen on a smaller room, by the results for seed 0.
"""

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import group, set_ticks, subplots, summarise
from data_tools.claims.kit.objects import OBJECTS, mean_iou, object_ids
from data_tools.claims.kit.tables import mean, spread, table
from minisplat_ref.datasets.synthetic import SyntheticScene, make_scene
from minisplat_ref.extensions.cus.memory import feature_error, feature_map, first_keys, read_vjp
from minisplat_ref.extensions.cus.model import ADAPTER, ANCHORS, KEYS, LATENT, MEMORY, QUERY, Anchors, decode
from minisplat_ref.extensions.cus.recipe import CUS, blended_queries, draw_pixels, read_memory
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.interface.palette import BLUE, RED
from minisplat_ref.mechanisms.features.blending import blend_channels, blend_channels_vjp
from minisplat_ref.mechanisms.networks.networks import COMPILED
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, Request, activate
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.training.adam import AdamRule, adam_step, zero_moments
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import Recipe, scale_recipe
from minisplat_ref.types import Floats, Ints, Model, Scene, View

SIZE: dict[str, Any] = {"n_views": 16, "width": 96, "height": 72, "n_points": 2_000}  # of the room
LATENTS = (8, 16, LATENT)  # the last is the recipe's
QUERIES = (1, 3, 15)  # numbers of a Gaussian's own query
DIMENSION = 32  # of the teacher's features
TEXTURE = 0.3  # of the length of a label's direction
FIXED_FLOATS = 5  # of an anchor that are equal for all: an opacity and a rotation
ANCHOR_ARM, OWN = "anchors", "own queries"
SAMPLES = 2_048  # pixels of an iteration
OWN_RATES = {"queries": 0.2, KEYS: 1e-2, ADAPTER: 1e-2}  # the best of several, as those of the recipe are
FEATURES = (
    ("Gaussians", mean("gaussians")),
    ("floats of features", mean("floats")),
    ("error of features", spread("error", 4)),
    ("mean IoU", spread("iou", 3)),
)
IMAGES = (("Gaussians", mean("gaussians")), ("floats in all", mean("all_floats")), ("PSNR dB", spread("psnr", 2)))
RULE = AdamRule(is_visible_only=False, has_bias_correction=True)


class Teacher(NamedTuple):
    """Makes the features of a photograph of its labels."""

    directions: Floats
    """[E, DIMENSION] of length 1, one for each label."""
    texture: Floats
    """[22, DIMENSION] projection of the classical features."""

    def features(self, view: View, labels: Ints) -> Floats:
        """Return the map [H, W, DIMENSION] of a view with labels [H, W], float32."""
        found: Floats = self.directions[labels] + TEXTURE * feature_map(view, "") @ self.texture
        return found.astype(np.float32)


def make_teacher(rng: np.random.Generator) -> Teacher:
    """Return a random teacher of the labels of :data:`~data_tools.claims.kit.objects.OBJECTS` and the rest."""
    directions = rng.normal(size=(1 + len(OBJECTS), DIMENSION))
    texture = rng.normal(size=(22, DIMENSION)) / np.sqrt(22)
    return Teacher(directions / np.linalg.norm(directions, axis=1, keepdims=True), texture)


class Task(NamedTuple):
    """A scene with the maps of its photographs, and what is known of its held-out views."""

    scene: Scene
    folder: str
    targets: list[Floats]
    """[H, W, DIMENSION] of the test views."""
    labels: list[Ints]
    prototypes: Floats
    """[E, DIMENSION] mean feature of each label in the training views."""


def make_task(made: SyntheticScene, seed: int, folder: Path) -> Task:
    """Write the maps of the training views into a folder, and return the task."""
    teacher = make_teacher(np.random.default_rng(seed))
    sums, counts = np.zeros((1 + len(OBJECTS), DIMENSION)), np.zeros(1 + len(OBJECTS))
    for view, ids in zip(made.scene.train_views, made.train_ids, strict=True):
        labels = object_ids(ids)
        features = teacher.features(view, labels)
        np.save(folder / f"{view.name}.npy", features)
        np.add.at(sums, labels, features)
        counts += np.bincount(labels.ravel(), minlength=len(counts))
    of_test = [object_ids(ids) for ids in made.test_ids]
    targets = [teacher.features(view, labels) for view, labels in zip(made.scene.test_views, of_test, strict=True)]
    return Task(made.scene, str(folder), targets, of_test, sums / np.maximum(counts, 1)[:, None])


def recipe_of(latent: int, iterations: int, folder: str) -> Recipe:
    """Return the recipe with latents of this width and the maps of a folder; anchors stay as many as they are."""
    still = CUS._replace(representation=ANCHORS)
    recipe = configure(still, latent=latent, features=folder, growth_threshold=None)
    return scale_recipe(recipe, iterations)


def quality(task: Task, features_of: Callable[[View], Floats]) -> dict[str, float]:
    """Return error and mean IoU of features at the held-out views."""
    errors, drawn = [], []
    directions = task.prototypes / np.linalg.norm(task.prototypes, axis=1, keepdims=True)
    for view, target in zip(task.scene.test_views, task.targets, strict=True):
        found = features_of(view)
        errors.append(feature_error(found.reshape(-1, DIMENSION), target.reshape(-1, DIMENSION))[0])
        drawn.append(np.argmax(found @ directions.T, axis=2))
    return {"error": float(np.mean(errors)), "iou": mean_iou(drawn, task.labels)}


def features_of_anchors(model: Model, view: View) -> Floats:
    """Return the features [H, W, D] that a view of anchors reads."""
    image, _ = blended_queries(model, view, Request(backend=CPU))
    found, _ = read_memory(image.reshape(-1, image.shape[2]), model.shared)
    return found.reshape(*image.shape[:2], -1)


def feature_floats(model: Model) -> int:
    """Return the floats that anchors have for their features: latents, the network of queries and its mixture."""
    shared = sum(array.size for name, array in model.shared.items() if name.startswith(QUERY))
    return int(model.gaussians.latents.size) + shared


def own_queries(model: Model, task: Task, width: int, iterations: int, seed: int) -> dict[str, Floats]:
    """Return queries of the given width for every Gaussian of anchors, with keys and adapter, trained by features.

    Everything else stays as it is.
    """
    rng = np.random.default_rng(seed)
    n = len(model.gaussians.means) * model.gaussians.n_children
    memory = model.shared[MEMORY]
    parameters: dict[str, Floats] = {
        "queries": (0.1 * rng.normal(size=(n, width))).astype(np.float32),
        KEYS: first_keys(memory.astype(np.float64), width).astype(np.float32),
        ADAPTER: np.eye(memory.shape[1], dtype=np.float32),
    }
    state = zero_moments(parameters)
    views: list[View] = []
    for step in range(1, iterations + 1):
        views = views or [task.scene.train_views[i] for i in rng.permutation(len(task.scene.train_views))]
        view = views.pop()
        pixels = draw_pixels(view, SAMPLES, step)
        rows, columns = pixels.T
        image, tape = _blend(model, view, parameters["queries"])
        found, reading = read_memory(image[rows, columns], {MEMORY: memory, **parameters})
        _, v_found = feature_error(found, feature_map(view, task.folder)[rows, columns])
        v_read, _, v_keys, v_adapter = read_vjp(reading, v_found)
        v_image = np.zeros_like(image)
        v_image[rows, columns] = v_read
        v_queries = np.ascontiguousarray(blend_channels_vjp(tape, v_image)[0])
        gradient = {"queries": v_queries, KEYS: v_keys, ADAPTER: v_adapter}
        decay = 0.01 ** (step / iterations)
        rates = {name: rate * decay for name, rate in OWN_RATES.items()}
        state = adam_step(parameters, gradient, state, rates, RULE, np.zeros(0, np.int64))
    return {MEMORY: memory, **parameters}


def counts(model: Model) -> dict[str, int]:
    """Return how many Gaussians and how many floats a model has."""
    g = model.gaussians
    n_children = g.n_children if isinstance(g, Anchors) else 1
    fixed = FIXED_FLOATS if isinstance(g, Anchors) else 0
    floats = len(g.means) * (kit.count_floats(g) - fixed) + sum(array.size for array in model.shared.values())
    return {"gaussians": len(g.means) * n_children, "all_floats": floats}


def psnr_of(model: Model, scene: Scene, recipe: Recipe) -> float | None:
    """Return the mean PSNR of the held-out views, dB."""
    return evaluate(model, scene.test_views, RenderSettings(scene.background, renderer=recipe.renderer)).psnr


def _blend(model: Model, view: View, queries: Floats) -> tuple[Floats, Any]:
    decoded = decode(model, view, COMPILED)
    return blend_channels(activate(decoded.gaussians), queries, view.camera, Request(backend=CPU))


def measure(made: SyntheticScene, iterations: int, seed: int) -> list[dict[str, Any]]:
    """Train all arms, and return their records."""
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        task = make_task(made, seed, Path(folder))
        for latent in LATENTS:
            recipe = recipe_of(latent, iterations, task.folder)
            model = kit.train_with_progress(task.scene, recipe, seed).model
            records.append(
                {
                    "arm": f"{ANCHOR_ARM}, latent {latent}",
                    "psnr": psnr_of(model, task.scene, recipe),
                    **counts(model),
                    "floats": feature_floats(model),
                    **quality(task, lambda view, model=model: features_of_anchors(model, view)),  # type: ignore[misc]
                }
            )
        for width in QUERIES:
            found = own_queries(model, task, width, iterations, seed)

            def features_of(view: View, found: dict[str, Floats] = found) -> Floats:
                image, _ = _blend(model, view, found["queries"])
                features, _ = read_memory(image.reshape(-1, image.shape[2]), found)
                return features.reshape(*image.shape[:2], -1)

            records.append({"arm": f"{OWN}, {width}", "floats": found["queries"].size, **quality(task, features_of)})
        recipe = find_recipe("adaptive", iterations)
        model = kit.train_with_progress(task.scene, recipe, seed).model
        records.append({"arm": "adaptive", "psnr": psnr_of(model, task.scene, recipe), **counts(model)})
    return records


def run(args: argparse.Namespace) -> kit.Report:
    """Train all arms with every seed."""
    made = make_scene("room", **SIZE)
    settings = {**kit.describe_scene(made.scene), **kit.settings_of(args, "iterations")}
    jobs = kit.jobs_of(seed=range(args.seeds))
    records = kit.resume(args.out, settings, jobs, partial(measure, made, args.iterations))
    text = f"{kit.title(settings)}; features of {DIMENSION} channels, {args.iterations} iterations"
    return report(records, {**settings, "seeds": args.seeds}, text)


def report(records: list[dict[str, Any]], settings: dict[str, Any], heading: str) -> kit.Report:
    """Return tables and figure of the records of all arms."""
    of_features = [record for record in records if "error" in record]
    of_images = [record for record in records if "psnr" in record]
    tables = [table(own, {"arm": "arm"}, to) for own, to in ((of_features, FEATURES), (of_images, IMAGES))]
    result = {**settings, "records": records, "summary": summarise(of_features, "arm", ("floats", "error", "iou"))}
    arms = kit.arms_of(of_features, "arm", ("error", "iou"))
    return kit.Report(result, draw(of_features), "\n\n".join([heading, *tables]), arms=arms)


def draw(records: list[dict[str, Any]]) -> Figure:
    """Plot the error of features and the mean IoU over the floats."""
    figure, panels = subplots((9, 3.6), 1, 2)
    arms = group(records, "arm")
    for axes, (key, label) in zip(panels, {"error": "error of features", "iou": "mean IoU"}.items(), strict=True):
        for start, color in ((ANCHOR_ARM, BLUE), (OWN, RED)):
            shown = [own for name, own in arms.items() if name.startswith(start)]
            points = [[np.mean([record[of] for record in own]) for own in shown] for of in ("floats", key)]
            axes.plot(*points, "o-", color=color, label=start)
        axes.set(xlabel="floats of the features", ylabel=label, xscale="log")
        ticks = sorted({int(line) for arm in axes.lines for line in arm.get_xdata()})
        set_ticks(axes, ticks[1::2], [f"{tick / 1e3:.0f}k" for tick in ticks[1::2]])
        axes.legend()
    return figure
