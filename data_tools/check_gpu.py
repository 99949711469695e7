"""``python -m data_tools.check_gpu``: everything that the backend cuda promises, on a machine with an NVIDIA GPU.

It runs the oracle and the hard cases, trains with every recipe, compares the bytes of repeated gradients, counts what
both passes ask of the device, times them beside gsplat's where that is installed, and prints one JSON with the card's
name and its driver. Without a GPU it says so in one line and ends with exit code 2. With ``NUMBA_ENABLE_CUDASIM=1`` the
simulator takes the GPU's place, for the test of this file; then it times nothing.
"""

import argparse
import hashlib
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from data_tools.device_work import count_work
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.errors import InputError
from minisplat_ref.methods import RECIPES, get_recipe
from minisplat_ref.metrics import psnr
from minisplat_ref.oracle.comparison.renderers import choose_renderer, choose_scenes
from minisplat_ref.oracle.comparison.staged import as_report, compare_scene
from minisplat_ref.oracle.hard_cases import HARD_CASES
from minisplat_ref.oracle.hard_cases.run import Precision, run_hard_cases, select_cases
from minisplat_ref.rendering import activate, render
from minisplat_ref.rendering.backends import BACKENDS, CUDA, CUDA_ATOMIC, Backend, get_backend
from minisplat_ref.training.loop import train
from minisplat_ref.types import Camera, Floats, Gaussians, Primitives, Scene, TileGrid, View

DESCRIPTION = "Check everything that the backend cuda promises, on a machine with an NVIDIA GPU; print one JSON."
PARTS = ("oracle", "hard_cases", "recipes", "bytes", "work", "speed")
GSPLAT_FACTOR = 3.0  # both passes should take at most this many times gsplat's


def make_gaussians(n: int, seed: int = 0) -> Gaussians:
    """Return Gaussians in a ball of radius 1, float32, degree 3; a million of them are some pixels large."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means *= rng.uniform(size=(n, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    log_scales = np.log(0.5 * n ** (-1 / 3)) + rng.normal(0, 0.3, size=(n, 3))
    fields = means, rng.normal(size=(n, 4)), log_scales, rng.normal(size=n), rng.normal(0, 0.5, size=(n, 3))
    sh_rest = rng.normal(0, 0.05, size=(n, 15, 3))
    return Gaussians(*(np.ascontiguousarray(field, np.float32) for field in (*fields, sh_rest)))


def make_camera(width: int, height: int, azimuth: float = 0.0) -> Camera:
    """Return a camera at a distance of 3 that looks at the origin."""
    position = np.array([3 * np.sin(azimuth), -3 * np.cos(azimuth), 0.5])
    return look_at(position, np.zeros(3), 1.2 * width, width, height)


def make_scene(args: argparse.Namespace, backend: Backend) -> Scene:
    """Return a scene whose photographs are renderings of random Gaussians, which start elsewhere."""
    truth, (width, height) = make_gaussians(args.points), args.train_size
    views = []
    for i in range(args.views):
        camera = make_camera(width, height, 2 * np.pi * i / args.views)
        image = np.asarray(render(truth, camera, backend=backend)[0].image)
        views.append(View(f"view{i}", camera, np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), None))
    points = truth.means.astype(float) + np.random.default_rng(1).normal(0, 0.02, truth.means.shape)
    colors = np.full(points.shape, 128, np.uint8)
    return Scene("check_gpu", tuple(views), (), points, colors, np.zeros(3), 3.3)


def run_oracle(backend: str, scene: str) -> dict[str, Any]:
    """Compare every stage of a backend with the float64 reference in float32."""
    renderer = choose_renderer(backend, "float32")
    scenes, _ = choose_scenes(renderer, scene, "reference", None)
    rows = [row for truth in scenes.values() for row in compare_scene(renderer, truth)]
    report = as_report(renderer, rows, {})
    return {"scenes": list(scenes), "n_failed": report.n_failed}


def run_hard(pattern: str | None, backend: Backend) -> dict[str, Any]:
    """Run the hard cases in float32."""
    chosen = HARD_CASES if pattern is None else select_cases(HARD_CASES, pattern)
    report = run_hard_cases(chosen, (Precision("f32", backend, np.float32),))
    failed = [case.name for case in report.cases if not case.passed]
    return {"n_cases": len(chosen), "failed": failed}


def run_recipes(args: argparse.Namespace, backend: Backend) -> dict[str, Any]:
    """Train by every recipe, here and by another backend."""
    scene, results = make_scene(args, backend), {}
    for name in args.recipes:
        result: dict[str, Any] = {}
        for trained_by in (backend, BACKENDS[args.against]):
            notes: list[str] = []
            recipe, start = get_recipe(name, args.iterations), time.perf_counter()
            on_step = lambda report, notes=notes: notes.extend(report.notes)  # noqa: E731
            state = train(scene, recipe, seed=0, backend=trained_by, on_step=on_step)
            seconds, g = time.perf_counter() - start, state.gaussians
            values = [psnr(np.clip(_image(g, view, trained_by), 0, 1), view.image) for view in scene.train_views]
            result[trained_by.name] = {
                "psnr": round(float(np.mean(values)), 3),
                "n_gaussians": len(g.means),
                "seconds": round(seconds, 3),
                "notes": notes,
            }
        results[name] = result
    return results


def _image(gaussians: Gaussians, view: View, backend: Backend) -> Floats:
    return np.asarray(render(gaussians, view.camera, backend=backend)[0].image)


class Passes:
    """Both passes over one view, with arrays that stay on the device."""

    def __init__(self, backend: Backend, n: int, size: tuple[int, int]) -> None:
        self.backend, self.device, self.camera = backend, backend.residence, make_camera(*size)
        self.gaussians = self.device.to_device(make_gaussians(n))
        self._passes = self.device.Passes(backend.is_deterministic)
        self._options = self.device.Options(np.zeros(3, np.float32), 3, GSPLAT_MAIN)
        self._no_alpha = self.device.zeros(size[::-1], np.float32)
        while self._passes.count_pairs(tape := self.forward()) > tape.capacity:
            pass

    def forward(self) -> Any:
        """Return everything that the backward pass reads."""
        return self._passes.render(self.gaussians, self.camera, self._options)

    def backward(self, tape: Any) -> Gaussians:
        """Return the gradient of half the sum of squares of the image."""
        return self._passes.render_vjp(tape, tape.output.image, self._no_alpha).gaussians


def count_passes(passes: Passes) -> dict[str, Any]:
    """Return what both passes ask of the device once their arrays are there."""
    passes.backward(passes.forward())
    with count_work() as forward:
        tape = passes.forward()
    with count_work() as backward:
        passes.backward(tape)
    return {"forward": forward.as_counts(), "backward": backward.as_counts()}


def compare_bytes(passes: Passes, n_runs: int) -> dict[str, Any]:
    """Return how many different gradients a number of runs give, and the largest relative difference of two runs."""
    gradients = [passes.device.to_host(passes.backward(passes.forward())) for _ in range(n_runs)]
    digests = {hashlib.sha256(b"".join(field.tobytes() for field in g)).hexdigest() for g in gradients}
    spread = max(
        float(np.max(np.abs(x - y)) / max(float(np.max(np.abs(x))), 1e-30))
        for other in gradients[1:]
        for x, y in zip(gradients[0], other, strict=True)
    )
    return {"n_runs": n_runs, "n_different": len(digests), "largest_difference": spread}


def median_ms(function: Callable[[], Any], synchronize: Callable[[], None], repeats: int) -> float:
    """Return the median time of a call, in ms, after one call that compiles."""
    times = []
    for _ in range(repeats + 1):
        synchronize()
        start = time.perf_counter()
        function()
        synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return round(statistics.median(times[1:]), 3)


def time_passes(passes: Passes, repeats: int) -> dict[str, float]:
    """Time both passes of one of our backends."""
    tape, synchronize = passes.forward(), passes.device.synchronize
    forward = median_ms(passes.forward, synchronize, repeats)
    return {"forward_ms": forward, "backward_ms": median_ms(lambda: passes.backward(tape), synchronize, repeats)}


def time_stages(backend: Backend, n: int, size: tuple[int, int], repeats: int) -> dict[str, float]:
    """Time the stages of a view one by one, in ms; between two of them the host waits for the device."""
    b, device, camera, g = backend, backend.residence, make_camera(*size), make_gaussians(n)
    primitives: Primitives = device.to_device(activate(g))
    means, sh_dc, sh_rest = map(device.to_device, (g.means, g.sh_dc, g.sh_rest))
    harmonics = means, sh_dc, sh_rest, camera, 3
    p = b.project(*primitives, camera, GSPLAT_MAIN)
    grid = TileGrid(camera.width, camera.height, b.tile_width, b.tile_height)
    blended = p, b.sh_colors(*harmonics, p.radii), np.zeros(3, np.float32), b.bin_gaussians(p, grid, GSPLAT_MAIN)
    output, no_alpha = b.composite(*blended, GSPLAT_MAIN), device.zeros(size[::-1], np.float32)
    stages: dict[str, Callable[[], Any]] = {
        "project": lambda: b.project(*primitives, camera, GSPLAT_MAIN),
        "colours": lambda: b.sh_colors(*harmonics, p.radii),
        "lists": lambda: b.bin_gaussians(p, grid, GSPLAT_MAIN),
        "blend": lambda: b.composite(*blended, GSPLAT_MAIN),
        "blend_vjp": lambda: b.composite_vjp(*blended, GSPLAT_MAIN, output, output.image, no_alpha),
    }
    return {name: median_ms(stage, device.synchronize, repeats) for name, stage in stages.items()}


def time_gsplat(n: int, size: tuple[int, int], repeats: int) -> dict[str, Any]:
    """Time gsplat's kernels on the same view, or say why not."""
    try:
        import gsplat
        import torch
    except ImportError as error:
        return {"not_timed": f"{error.name} is not installed"}
    g, camera = make_gaussians(n), make_camera(*size)
    on_gpu = [torch.tensor(field, device="cuda", requires_grad=True) for field in g]
    means, quats, log_scales, logits, sh_dc, sh_rest = on_gpu
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[:3, :3], viewmat[:3, 3] = camera.cam_from_world_R, camera.cam_from_world_t
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32)
    cameras = torch.tensor(viewmat[None], device="cuda"), torch.tensor(K[None], device="cuda")

    def forward() -> Any:
        colors = torch.cat([sh_dc[:, None], sh_rest], 1)
        activated = means, quats, torch.exp(log_scales), torch.sigmoid(logits), colors
        return gsplat.rasterization(*activated, *cameras, *size, sh_degree=3, packed=False)[0]

    image = forward()
    repeated = dict(synchronize=torch.cuda.synchronize, repeats=repeats)
    backward = median_ms(lambda: image.backward(image.detach(), retain_graph=True), **repeated)
    return {"version": gsplat.__version__, "forward_ms": median_ms(forward, **repeated), "backward_ms": backward}


def check(args: argparse.Namespace) -> dict[str, Any]:
    """Run everything and return the findings."""
    deterministic, atomic = get_backend(CUDA), get_backend(CUDA_ATOMIC)
    found: dict[str, Any] = {"card": deterministic.residence.describe_device()}
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "oracle": lambda: run_oracle(CUDA, args.scene),
        "hard_cases": lambda: run_hard(args.cases, deterministic),
        "recipes": lambda: run_recipes(args, deterministic),
        "bytes": lambda: {b.name: compare_bytes(Passes(b, *view), args.runs) for b in (deterministic, atomic)},
        "work": lambda: {b.name: count_passes(Passes(b, *view)) for b in (deterministic, atomic)},
        "speed": lambda: run_speed(args, (deterministic, atomic)),
    }
    view = args.gaussians, args.size
    found |= {name: parts[name]() for name in PARTS if name in args.only}
    found["failed"] = failures(found)
    return found


def run_speed(args: argparse.Namespace, backends: tuple[Backend, ...]) -> dict[str, Any]:
    """Time both passes of our backends, and of gsplat."""
    if backends[0].residence.is_simulated:
        return {"not_timed": "the simulator's times say nothing"}
    view = args.gaussians, args.size
    ours = {backend.name: time_passes(Passes(backend, *view), args.repeats) for backend in backends}
    stages = time_stages(backends[0], *view, args.repeats)
    others = {"stages_ms": stages, "gsplat": time_gsplat(*view, args.repeats)}
    return {"n_gaussians": view[0], "size": list(view[1]), **ours, **others}


def failures(found: dict[str, Any]) -> list[str]:
    """Return what does not hold of what is promised."""
    n_failed = found.get("oracle", {}).get("n_failed", 0)
    failed = [f"oracle: {n_failed} scenes"] if n_failed else []
    failed += [f"hard case {name}" for name in found.get("hard_cases", {}).get("failed", [])]
    if found.get("bytes", {}).get(CUDA, {}).get("n_different", 1) > 1:
        failed.append(f"{CUDA}: runs differ in their bytes")
    speed = found.get("speed", {})
    gsplat, ours = speed.get("gsplat", {}), speed.get(CUDA, {})
    for name in ("forward_ms", "backward_ms"):
        if name in gsplat and ours[name] > GSPLAT_FACTOR * gsplat[name]:
            failed.append(
                f"{name} is {ours[name]} of {CUDA}, more than {GSPLAT_FACTOR:g} times gsplat's {gsplat[name]}"
            )
    return failed


def size_of(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT."""
    width, _, height = text.partition("x")
    return int(width), int(height)


def main(arguments: list[str] | None = None) -> int:
    """Run the checks and print one JSON; 0 if everything holds, 1 if not, 2 if there is no GPU."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.check_gpu", description=DESCRIPTION)
    parser.add_argument(
        "--only", nargs="+", default=PARTS, choices=PARTS, metavar="PART", help=f"parts: {', '.join(PARTS)}"
    )
    parser.add_argument("--scene", default="all", help="scene of the oracle (default all)")
    parser.add_argument("--cases", help="hard cases whose name holds this (default all)")
    parser.add_argument(
        "--recipes",
        nargs="+",
        default=list(RECIPES),
        choices=list(RECIPES),
        metavar="NAME",
        help="that train (default all)",
    )
    parser.add_argument("--iterations", type=int, default=200, help="of every recipe (default 200)")
    parser.add_argument("--against", default="cpu", choices=list(BACKENDS), help="what trains beside it (default cpu)")
    parser.add_argument("--points", type=int, default=5_000, help="of the scene that is trained (default 5000)")
    parser.add_argument("--views", type=int, default=12, help="of that scene (default 12)")
    parser.add_argument("--train-size", type=size_of, default=(320, 240), help="of its views (default 320x240)")
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of the speed table (default 1000000)")
    parser.add_argument("--size", type=size_of, default=(1920, 1080), help="of its view (default 1920x1080)")
    parser.add_argument("--runs", type=int, default=10, help="whose bytes are compared (default 10)")
    parser.add_argument("--repeats", type=int, default=20, help="of which the median time is taken (default 20)")
    args = parser.parse_args(arguments)
    try:
        found = check(args)
    except InputError as error:
        print(f"check_gpu: {error}", file=sys.stderr)
        return 2
    print(json.dumps(found, indent=2))
    return 1 if found["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
