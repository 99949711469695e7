"""The renderers that are compared: where each comes from, in which version, and what runs it.

A viewer is a package of npm and a driver. A renderer that cannot be run has the reason, and the command that was tried.
"""

import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_tools.conformance.probes import HEIGHT, WIDTH, Probe, golden_of
from minisplat_ref.constants import GSPLAT_1_5
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.golden.format import STAGE_INPUTS
from minisplat_ref.types import Floats

MODULES = "/node_modules"
THREE = {
    "three": f"{MODULES}/three/build/three.module.js",
    "three/addons/": f"{MODULES}/three/examples/jsm/",
}


class Renderer(NamedTuple):
    """Who is compared."""

    name: str
    what: str
    version: str
    packages: tuple[str, ...] = ()
    """Of npm, with their versions."""
    driver: str = ""
    """Of a viewer, in ``viewers/``."""
    imports: Mapping[str, str] = {}
    """Where the driver finds what it imports."""
    render: Callable[[Probe], Floats] | None = None
    """Returns the picture [H, W, 3] of a probe, for those that are Python."""
    n_more: int = 0
    """Gaussians that nobody sees, which it needs beside those of a probe."""
    reason: str = ""
    """Why it is not run, with what was tried."""


def _gsplat_torch(probe: Probe) -> Floats:
    """Render by gsplat's own functions in torch, with the blending of docs/ORACLE.md.

    Raises
    ------
    InputError
        They are not installed.
    """
    try:
        from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch
    except ImportError as error:
        raise InputError("gsplat's torch functions need torch and gsplat: pip install torch gsplat==1.5.3") from error
    from minisplat_ref.oracle.golden.running import run_stages

    scene = golden_of(probe, GSPLAT_1_5)
    image = run_stages(gsplat_torch(), scene._replace(arrays=inputs_of(scene.arrays)), "float32")["image"]
    return np.asarray(np.rint(255 * np.clip(image, 0, 1)) / 255).reshape(HEIGHT, WIDTH, 3)


def inputs_of(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays that a renderer is given."""
    return {name: arrays[name] for name in (*STAGE_INPUTS["view"], "features", "feature_background")}


RENDERERS = (
    Renderer(
        "spark",
        "Spark, a viewer on three.js",
        "2.2.0",
        ("@sparkjsdev/spark@2.2.0", "three@0.180.0"),
        "spark.js",
        {**THREE, "@sparkjsdev/spark": f"{MODULES}/@sparkjsdev/spark/dist/spark.module.js"},
    ),
    Renderer(
        "playcanvas",
        "PlayCanvas' engine, which SuperSplat shows",
        "2.23.3",
        ("playcanvas@2.23.3",),
        "playcanvas.js",
        {"playcanvas": f"{MODULES}/playcanvas/build/playcanvas.mjs"},
    ),
    Renderer(
        "mkkellogg",
        "GaussianSplats3D, a viewer on three.js",
        "0.4.7",
        ("@mkkellogg/gaussian-splats-3d@0.4.7", "three@0.180.0"),
        "mkkellogg.js",
        {
            **THREE,
            "@mkkellogg/gaussian-splats-3d": (
                f"{MODULES}/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js"
            ),
        },
        n_more=6,
    ),
    Renderer(
        "gsplatjs",
        "gsplat.js, a viewer of its own",
        "1.2.9",
        ("gsplat@1.2.9",),
        "gsplatjs.js",
        {"gsplat": f"{MODULES}/gsplat/dist/index.es.js"},
    ),
    Renderer("gsplat-torch", "gsplat's functions in torch, blended here", "1.5.3", render=_gsplat_torch),
    Renderer(
        "antimatter15", "antimatter15/splat", "ba182b51", reason="no driver yet: it reads .splat and its own camera"
    ),
    Renderer("babylon", "Babylon.js", "9.35.0", reason="no driver yet: npm install @babylonjs/core@9.35.0 works"),
    Renderer("viser", "viser's splats", "1.1.1", reason="no driver yet: its page is fed by a websocket"),
    Renderer("three", "three.js by itself", "0.187.0", reason="has no splats of its own"),
    Renderer(
        "opensplat", "OpenSplat's rasteriser on a CPU", "1.2.0", reason="not tried yet: needs libtorch and a build"
    ),
    Renderer("taichi-splatting", "taichi-splatting", "", reason="not tried yet"),
    Renderer("gsplat", "gsplat's CUDA kernels", "1.5.3", reason="needs a CUDA card"),
    Renderer("inria", "the 3DGS rasteriser", "", reason="needs a CUDA card and a build"),
)


def install(renderer: Renderer, cache: Path) -> None:
    """Fetch a viewer's packages into a folder, unless they are there.

    Raises
    ------
    InputError
        npm failed.
    """
    missing = [package for package in renderer.packages if not _has(package, cache)]
    if not missing:
        return
    cache.mkdir(parents=True, exist_ok=True)
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(cache), *missing]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"{renderer.name} is a package of npm, which is not installed: {error}") from error
    if done.returncode:
        raise InputError(f"{' '.join(command)} failed: {done.stderr.strip().splitlines()[-1:]}")


def _has(package: str, cache: Path) -> bool:
    name, _, version = package.rpartition("@")
    file = cache / "node_modules" / name / "package.json"
    return file.is_file() and f'"version": "{version}"' in file.read_text(encoding="utf-8")
