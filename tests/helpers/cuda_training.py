"""Train on a tiny scene with the backend cuda in Numba's simulator, and write what came out and what was copied.

``NUMBA_ENABLE_CUDASIM=1 python cuda_training.py FILE`` writes a pickle. The scene and the recipes are functions of this
file, so that the tests can train by the CPU too.
"""

import pickle
import sys
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from minisplat_ref.methods import RECIPES, gaussian_splatting, mini_splatting
from minisplat_ref.rendering import Renderer, render
from minisplat_ref.rendering.backends import REFERENCE, get_backend
from minisplat_ref.training.guard import Guard
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import BLEND_STATS, At, During
from minisplat_ref.types import Scene, View
from scenes import as_dtype, make_camera, make_gaussians

N_GAUSSIANS = 6
EVENTS = (
    During(gaussian_splatting.collect_gradients, reads_parameters=False),
    During(partial(mini_splatting.collect_blur, area_fraction=0.01), wants=BLEND_STATS, reads_parameters=False),
    At(2, partial(gaussian_splatting.clone_and_split, threshold=0.0, size_fraction=0.15)),
)


def move(state, iteration):
    """Read a parameter, and change it."""
    state.gaussians.means[0] += state.gaussians.means[1]


def move_seldom(state, iteration):
    """Do it in the second iteration only."""
    if iteration.step == 2:
        iteration.fetch()
        move(state, iteration)


MOVES = During(move, stop=2), During(move_seldom, reads_parameters=False)


def recipe_of(name, iterations, events=()):
    return RECIPES[name]._replace(iterations=iterations, sh_degree=1, sh_milestones=(1,), events=events)


TRAININGS = {
    "events": recipe_of("3dgs-accel", 3, EVENTS),  # only the rows that a view sees
    "dense": recipe_of("3dgs", 1),
    "moved": recipe_of("3dgs-accel", 3, MOVES),
}


def make_scene():
    """Two photographs of six Gaussians, one of them behind the second camera, and their centres to start from."""
    rng = np.random.default_rng(5)
    truth = as_dtype(make_gaussians(rng, N_GAUSSIANS), np.float32)
    truth.means[3] = 0.1, 0.1, 1.5
    views = []
    for i in range(2):
        camera = make_camera(9, 7, fx=9.0, fy=9.0, cx=4.0, cy=3.0)
        camera = camera._replace(cam_from_world_t=np.array([0.0, 0.0, -2.0 * i]))
        image = render(truth, camera, backend=REFERENCE)[0].image
        mask = None if i else np.arange(63).reshape(7, 9) % 5 > 0
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), mask))
    colors = rng.integers(0, 256, (N_GAUSSIANS, 3), np.uint8)
    return Scene("tiny", tuple(views), (), truth.means.astype(float), colors, np.zeros(3), 1.0)


def train_by(recipe, backend):
    """Train from Gaussians that are no spheres: of a sphere's rotation Adam would enlarge rounding alone."""
    scene, rng = make_scene(), np.random.default_rng(1)
    state = initial_state(scene, recipe, seed=0)
    state.gaussians.quats[:] = rng.normal(size=(N_GAUSSIANS, 4))
    state.gaussians.log_scales[:] += rng.normal(size=(N_GAUSSIANS, 3))
    state.gaussians.sh_rest[:] = rng.normal(0, 0.1, size=(N_GAUSSIANS, 3, 3))
    state.view_order = [0, 1, 0]  # the last is first: what view 0 has moved, view 1 does not see
    return numbers_of(train(scene, recipe, seed=0, state=state, backend=backend))


def numbers_of(state):
    """All parameters and moments, by name."""
    bundles = {"p": state.gaussians, "m": state.adam.first, "v": state.adam.second}
    return {f"{key}.{name}": x for key, bundle in bundles.items() for name, x in bundle._asdict().items()} | state.stats


def count_copies(scene, backend):
    """Shapes copied to the device and back, and allocated, in three iterations; nobody looks at the parameters."""
    from minisplat_ref.cuda import arrays

    copied, steps = {"to": [], "from": [], "new": []}, []
    to_device, device_array, fake = arrays.cuda.to_device, arrays.cuda.device_array, type(arrays.empty(1, np.float32))
    to_host = fake.copy_to_host

    def counted_to_device(x, *args, **named):
        copied["to"].append(x.shape)
        return to_device(x, *args, **named)

    def counted_array(shape, dtype):
        copied["new"].append(shape)
        return device_array(shape, dtype)

    def counted_to_host(self, *args, **named):
        copied["from"].append(self.shape)
        return to_host(self, *args, **named)

    def on_step(report):
        steps.append(dict(copied))
        copied.update({"to": [], "from": [], "new": []})

    def no_array(self, *args, **named):
        raise AssertionError("an array was copied behind the counter's back")

    with (
        patch.object(arrays.cuda, "to_device", counted_to_device),
        patch.object(arrays.cuda, "device_array", counted_array),
        patch.object(fake, "copy_to_host", counted_to_host),
        patch.object(fake, "__array__", no_array, create=True),
    ):
        train(scene, recipe_of("3dgs-accel", 3), seed=0, backend=backend, on_step=on_step, guard=Guard(every=2))
    return steps


def look_and_change(scene, backend):
    """A callback that reads and changes a parameter: what is there afterwards."""
    seen = []

    def on_step(report):
        seen.append(report.state.gaussians.means.copy())
        report.state.gaussians.means[0] = 7.0

    state = train(scene, recipe_of("3dgs", 2), seed=0, backend=backend, on_step=on_step)
    return seen, state.gaussians.means


def fall_back(scene, backend):
    """A renderer of another kind: what is said."""
    recipe, notes = recipe_of("3dgs", 1), []
    renderer = Renderer("foreign", *recipe.renderer[1:])
    recipe = recipe._replace(representation=recipe.representation._replace(renderer=renderer))
    train(scene, recipe, seed=0, backend=backend, on_step=lambda report: notes.extend(report.notes))
    return notes


if __name__ == "__main__":
    scene, cuda = make_scene(), get_backend("cuda")
    results = {name: train_by(recipe, cuda) for name, recipe in TRAININGS.items()}
    results["copies"] = count_copies(scene, cuda)
    results["looked"] = look_and_change(scene, cuda)
    results["notes"] = fall_back(scene, cuda)
    Path(sys.argv[1]).write_bytes(pickle.dumps(results))
