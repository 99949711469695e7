"""The renderers that are compared: where each comes from, in which version, what runs it, and by which rules.

A viewer is a package of npm or a repository, and a driver. Its habits are what its source states; the reference that
follows them is compared with its pictures. A renderer that cannot be run has the reason, and the command tried.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from data_tools.conformance import programs
from data_tools.conformance.habits import SQRT_8, VIEWER, Habits
from data_tools.conformance.probes import Probe
from data_tools.conformance.storing import BYTES, COMPACT, PACKED, SPLAT, SPLAT_AND_HARMONICS
from minisplat_ref.constants import GSPLAT_1_5
from minisplat_ref.types import Floats

MODULES = "/node_modules"
THREE = {
    "three": f"{MODULES}/three/build/three.module.js",
    "three/addons/": f"{MODULES}/three/examples/jsm/",
}
QUARTER = 0.3 / 4  # px^2, a low-pass that is added to four times the covariance
HALF_OF_HALVES = (2.0**15) ** 0.5 / 2  # four times its square is half of what half precision holds, and made infinite
OF_QUADS = VIEWER._replace(alpha_min=0.0)


class Renderer(NamedTuple):
    """A renderer that is compared."""

    name: str
    what: str
    version: str
    habits: Habits | None = None
    """Its rules."""
    packages: tuple[str, ...] = ()
    """Of npm, with their versions."""
    wheels: tuple[str, ...] = ()
    """Of PyPI, with their versions."""
    repository: tuple[str, str] | None = None
    """Of GitHub, and the commit."""
    driver: str = ""
    """Of a viewer, in ``viewers/``."""
    imports: Mapping[str, str] = {}
    """Where the driver finds what it imports."""
    render: Callable[[Probe, Path], Floats] | None = None
    """Returns the picture [H, W, 3] of a probe with the cache folder, for those that are Python."""
    n_more: int = 0
    """Gaussians that nobody sees, which it needs beside those of a probe."""
    reason: str = ""
    """Why it is not run, with what was tried."""

    @property
    def source(self) -> str:
        """Return how it is fetched."""
        ways = [f"npm install {' '.join(self.packages)}"] if self.packages else []
        ways += [f"git clone https://github.com/{self.repository[0]}"] if self.repository else []
        ways += [f"pip install {' '.join(self.wheels)}"] if self.wheels else []
        return ", ".join(f"`{way}`" for way in ways)


RENDERERS = (
    Renderer(
        "spark",
        "Spark, a viewer on three.js",
        "2.2.0",
        Habits(
            VIEWER._replace(is_antialiased=True, alpha_min=0.5 / 255),
            deviations=SQRT_8,
            storage=PACKED,
            beyond=1.4,
            widest=512 / SQRT_8,
            has_distances=True,
            is_last_first=True,
            has_free_slopes=True,
        ),
        packages=("@sparkjsdev/spark@2.2.0", "three@0.180.0"),
        driver="spark.js",
        imports={**THREE, "@sparkjsdev/spark": f"{MODULES}/@sparkjsdev/spark/dist/spark.module.js"},
    ),
    Renderer(
        "playcanvas",
        "PlayCanvas' engine, which SuperSplat shows",
        "2.23.3",
        Habits(
            VIEWER._replace(eps2d=QUARTER),
            deviations=SQRT_8,
            is_lowered=True,
            storage=COMPACT,
            widest=64 / SQRT_8,  # the shorter side of the image
            narrowest=0.1 / 4,
            least_size=1 / SQRT_8,
            has_free_slopes=True,
        ),
        packages=("playcanvas@2.23.3",),
        driver="playcanvas.js",
        imports={"playcanvas": f"{MODULES}/playcanvas/build/playcanvas.mjs"},
    ),
    Renderer(
        "mkkellogg",
        "GaussianSplats3D, a viewer on three.js",
        "0.4.7",
        Habits(
            OF_QUADS,
            deviations=SQRT_8,
            storage=BYTES,
            is_last_first=True,
            beyond=1.2,
            widest=1024 / SQRT_8,
            least_root=0.1**0.5,
            axis_epsilon=0.0,
            degree=2,
            color_max=1.0,
            has_free_slopes=True,
        ),
        packages=("@mkkellogg/gaussian-splats-3d@0.4.7", "three@0.180.0"),
        driver="mkkellogg.js",
        imports={
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
        Habits(
            OF_QUADS._replace(eps2d=QUARTER, uses_principal_point=False),
            deviations=SQRT_8,
            storage=SPLAT,
            beyond=1.2,
            widest=512 / 2**0.5,
            has_free_slopes=True,
            largest_scale=HALF_OF_HALVES,
            is_in_file_order=True,
            axis_epsilon=0.0,
        ),
        packages=("gsplat@1.2.9",),
        driver="gsplatjs.js",
        imports={"gsplat": f"{MODULES}/gsplat/dist/index.es.js"},
    ),
    Renderer(
        "antimatter15",
        "splat, antimatter15's viewer",
        "ba182b51",
        Habits(
            OF_QUADS._replace(eps2d=0.0, uses_principal_point=False),
            deviations=SQRT_8,
            storage=SPLAT,
            beyond=1.2,
            widest=512 / 2**0.5,
            has_free_slopes=True,
            largest_scale=HALF_OF_HALVES,
            fades_at=0.2,
            axis_epsilon=0.0,
        ),
        repository=("antimatter15/splat", "ba182b51"),
        driver="antimatter15.js",
    ),
    Renderer(
        "babylon",
        "Babylon.js",
        "9.35.0",
        Habits(
            OF_QUADS._replace(eps2d=QUARTER),
            deviations=SQRT_8,
            storage=SPLAT_AND_HARMONICS,
            axis_epsilon=1e-4,
            beyond=1.2,
            widest=512 / 2**0.5,
            has_free_slopes=True,
        ),
        packages=("@babylonjs/core@9.35.0",),
        driver="babylon.js",
        imports={"@babylonjs/core/": f"{MODULES}/@babylonjs/core/"},
    ),
    Renderer(
        "gsplat-torch",
        "gsplat's functions in torch, blended here",
        "1.5.3",
        Habits(GSPLAT_1_5),
        wheels=("gsplat==1.5.3", "torch==2.13.0"),
        render=programs.gsplat_torch,
    ),
    Renderer(
        "torch-splatting",
        "torch-splatting",
        "3fa49bd6",
        Habits(
            VIEWER._replace(alpha_min=0.0, alpha_max=0.99, near_plane=0.2, uses_principal_point=False),
            has_raw_directions=True,
            white_tiles=64,
        ),
        wheels=("torch==2.13.0", "einops"),
        repository=programs.TORCH_SPLATTING,
        render=programs.torch_splatting,
    ),
    Renderer(
        "opensplat",
        "OpenSplat's rasteriser on a CPU",
        "15b7e800",
        Habits(GSPLAT_1_5._replace(uses_principal_point=False, clamp_is_symmetric=True), box=(3.0, 2)),
        wheels=("torch==2.13.0",),
        repository=programs.OPENSPLAT,
        render=programs.opensplat,
    ),
    Renderer(
        "litesplat",
        "LiteSplat, in Keras on torch",
        "0.1.1",
        Habits(
            VIEWER._replace(eps2d=0.0, alpha_min=0.0, near_plane=1e-8),
            centres=(0.0, 1.0),  # y up in its image, from 0 at the lowest row
            degree=0,
            has_free_slopes=True,
            has_distances=True,
        ),
        wheels=("litesplat==0.1.1", "torch==2.13.0"),
        render=programs.litesplat,
    ),
    Renderer(
        "viser",
        "viser's splats",
        "1.1.1",
        reason="no driver: its page is fed by a websocket from Python, which was not tried; its shader is that of splat"
        " with a low-pass of 0.3",
    ),
    Renderer("three", "three.js by itself", "0.187.0", reason="has no splats of its own"),
    Renderer(
        "taichi-splatting",
        "taichi-splatting",
        "0.13.0",
        reason=(
            "`pip install taichi==1.7.4 taichi-splatting`, and its import compiles CUDA for its sort: "
            "CUDA_HOME environment variable is not set"
        ),
    ),
    Renderer("gsplat", "gsplat's CUDA kernels", "1.5.3", reason="needs a CUDA card"),
    Renderer("inria", "the 3DGS rasteriser", "", reason="needs a CUDA card and a build"),
)
