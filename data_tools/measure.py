"""The measurements that the README reports: stages against the reference, and whole training runs on real scenes.

``python -m data_tools.measure stages`` times one fixed workload, 50,000 Gaussians at 480 x 270 drawn from a seeded
generator, and prints beside each time how far the result is from the float64 reference.
``python -m data_tools.measure scenes SCENE... --out DIR`` trains every scene through the command line, as a user would,
and prints a table. ``python -m data_tools.measure rate SCENE`` times training iterations while the number of Gaussians
stays the same. Times depend on the machine; compare figures of one run only.
"""

import argparse
import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from minisplat_ref.backends import CPU, CPU_EXACT, REFERENCE, Backend
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.io import load_scene
from minisplat_ref.recipes import get_recipe
from minisplat_ref.render import RenderGradient, render, render_vjp
from minisplat_ref.train import train
from minisplat_ref.types import Camera, Floats, Gaussians

WIDTH, HEIGHT, FOCAL = 480, 270, 400.0
PIXEL_ERROR = 2e-5  # what float32 promises where no hit falls on the other side of a threshold
WARM_UP = 20  # iterations that compile and are not timed


def trained_like(n: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """Return random Gaussians with the sizes and opacities of trained ones, and a camera that sees most of them.

    Centres are uniform in [-1, 1]^2 x [2, 6], scales log-normal with median 0.01, opacities sigmoid(N(0, 2)), colours
    uniform and without view dependence; float64, world and camera frame the same.
    """
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        means=np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 6, n)]),
        quats=rng.normal(size=(n, 4)),
        log_scales=np.log(0.01) + 0.7 * rng.normal(size=(n, 3)),
        opacity_logits=2 * rng.normal(size=n),
        sh_dc=(rng.uniform(size=(n, 3)) - 0.5) / SH_C0,
        sh_rest=np.zeros((n, 0, 3)),
    )
    return gaussians, Camera(np.eye(3), np.zeros(3), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def _milliseconds(function: Callable[[], object], repeats: int) -> float:
    """Return the median of several calls, after one that compiles."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def _relative_error(gradient: RenderGradient, expected: RenderGradient) -> float:
    """Return the largest relative L2 error over the parameters' gradients."""
    pairs = zip(gradient.gaussians, expected.gaussians, strict=True)
    return max(float(np.linalg.norm(a - e) / np.linalg.norm(e)) for a, e in pairs if e.size)


def measure_stages(n: int, repeats: int) -> None:
    """Print one row per backend and precision: times, and errors against the float64 reference."""
    gaussians, camera = trained_like(n)
    gaussians = _cast(_cast(gaussians, np.float32), np.float64)  # all backends get the same numbers
    v_image = np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 3))
    expected, tape = render(gaussians, camera, conventions=GSPLAT_MAIN, backend=REFERENCE)
    expected_gradient = render_vjp(tape, v_image)
    print(f"{n} Gaussians, {WIDTH} x {HEIGHT}; {machine()}\n")
    print(
        "| backend | dtype | forward (ms) | forward + backward (ms) "
        f"| pixels off by more than {PIXEL_ERROR:.0e} | largest error | gradient, rel. L2 error |"
    )
    print("|---|---|---|---|---|---|---|")
    for backend, dtype in ((CPU, np.float32), (CPU_EXACT, np.float32), (CPU, np.float64)):
        cast = _cast(gaussians, dtype)
        _measure_backend(
            backend, cast, camera, v_image.astype(dtype), expected.image, expected_gradient, repeats=repeats
        )


def _cast(gaussians: Gaussians, dtype: type[np.floating]) -> Gaussians:
    return Gaussians._make(field.astype(dtype) for field in gaussians)


def _measure_backend(
    backend: Backend,
    gaussians: Gaussians,
    camera: Camera,
    v_image: Floats,
    expected: Floats,
    expected_gradient: RenderGradient,
    repeats: int,
) -> None:
    def forward() -> object:
        return render(gaussians, camera, backend=backend)

    def both() -> RenderGradient:
        return render_vjp(render(gaussians, camera, backend=backend)[1], v_image)

    image_error = np.abs(render(gaussians, camera, backend=backend)[0].image - expected).max(axis=2)  # [H, W]
    is_off = image_error > PIXEL_ERROR
    gradient_error = _relative_error(both(), expected_gradient)
    times = (_milliseconds(forward, repeats), _milliseconds(both, repeats))
    errors = (f"{is_off.sum()} of {is_off.size}", f"{image_error.max():.1e}", f"{gradient_error:.1e}")
    row = (backend.name, v_image.dtype, *(f"{t:.1f}" for t in times), *errors)
    print("| " + " | ".join(map(str, row)) + " |", flush=True)


def measure_scenes(scenes: list[Path], out: Path, recipe: str, iterations: int) -> None:
    """Train each scene through the command line into ``out/NAME`` and print a table of their ``metrics.json``."""
    rows = []
    for scene in scenes:
        folder = out / scene.name
        command = [sys.executable, "-m", "minisplat_ref", "train", str(scene), "--out", str(folder)]
        subprocess.run([*command, "--recipe", recipe, "--iterations", str(iterations)], check=True)
        metrics = json.loads((folder / "metrics.json").read_text())
        rate = metrics["iterations"] / metrics["train_seconds"]
        rows.append(
            f"| {scene.name} | {metrics['psnr']:.2f} | {metrics['ssim']:.3f} | {metrics['n_gaussians']:,} "
            f"| {metrics['train_seconds']:.0f} | {rate:.1f} | {metrics['peak_rss_mb']:.0f} |"
        )
    print(f"\n{recipe}, {iterations} iterations, seed 0, full size; {machine()}\n")
    print("| scene | PSNR (dB) | SSIM | Gaussians | seconds | iterations/s | peak memory (MB) |")
    print("|---|---|---|---|---|---|---|", *rows, sep="\n")


def measure_rate(scene_folder: Path, n: int, iterations: int) -> None:
    """Print how many training iterations a second there are while the number of Gaussians stays at ``n``."""
    scene = load_scene(scene_folder)
    chosen = np.random.default_rng(0).choice(len(scene.points), n, replace=False)
    scene = scene._replace(points=scene.points[chosen], point_colors=scene.point_colors[chosen])
    recipe = get_recipe("3dgs-accel")._replace(iterations=WARM_UP + iterations, events=())
    times: list[float] = []
    train(scene, recipe, seed=0, on_step=lambda _: times.append(time.perf_counter()))
    seconds = np.diff(times[WARM_UP - 1 :])
    camera = scene.train_views[0].camera
    print(f"{scene.name}, {camera.width} x {camera.height}, {n} Gaussians, {iterations} iterations; {machine()}")
    print(f"{iterations / seconds.sum():.1f} iterations/s, median {1e3 * np.median(seconds):.1f} ms")


def machine() -> str:
    """Return what the figures depend on: processor, threads, versions."""
    import numba

    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    processor = models[0] if models else platform.processor()
    return (
        f"{processor}, {numba.get_num_threads()} threads, Python {platform.python_version()}, Numba {numba.__version__}"
    )


def main() -> None:
    """Run one of the measurements."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.measure", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    stages = commands.add_parser("stages", help="render and its gradient: milliseconds beside errors")
    stages.add_argument("--gaussians", type=int, default=50_000)
    stages.add_argument("--repeats", type=int, default=20)
    scenes = commands.add_parser("scenes", help="train scenes and print PSNR, SSIM, count, time and memory")
    scenes.add_argument("scene", type=Path, nargs="+")
    scenes.add_argument("--out", type=Path, required=True, help="new folder for the runs")
    scenes.add_argument("--recipe", default="3dgs-accel")
    scenes.add_argument("--iterations", type=int, default=3_000)
    rate = commands.add_parser("rate", help="training iterations per second at a constant number of Gaussians")
    rate.add_argument("scene", type=Path)
    rate.add_argument("--gaussians", type=int, default=10_000)
    rate.add_argument("--iterations", type=int, default=300)
    arguments = parser.parse_args()
    if arguments.command == "stages":
        measure_stages(arguments.gaussians, arguments.repeats)
    elif arguments.command == "rate":
        measure_rate(arguments.scene, arguments.gaussians, arguments.iterations)
    else:
        measure_scenes(arguments.scene, arguments.out, arguments.recipe, arguments.iterations)


if __name__ == "__main__":
    main()
