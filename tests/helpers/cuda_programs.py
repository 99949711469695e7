"""Compile every kernel of the package to PTX and machine code without a GPU, and print one JSON of what came out.

``python cuda_programs.py 80`` compiles for sm_80. Stages run with a stand-in for the device, which keeps arrays on the
host and records each launch instead of running it: the types of the arguments are those of real calls.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
from numba.cuda import dispatcher
from numba.cuda.typing.typeof import Purpose, typeof

from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.cuda import (
    adam,
    arrays,
    compositing,
    depth,
    loss,
    projection,
    removal,
    resident,
    spherical_harmonics,
    target,
    tiling,
)
from minisplat_ref.cuda.footprints import TILE
from minisplat_ref.cuda.target import GpuKernel, cuda
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import AdamStep, ProjectionGradient, TileGrid
from scenes import activated, as_dtype, make_camera, make_gaussians


def find_ptxas():
    """The assembler of the package nvidia-cuda-nvcc, or of an installed toolkit; None without."""
    import nvidia

    found = [path for root in nvidia.__path__ for path in Path(root).rglob("bin/ptxas*")]
    return str(found[0]) if found else shutil.which("ptxas")


class Recorder:
    """Takes the place of a compiled kernel."""

    def __init__(self, kernel, launches):
        self.kernel, self.launches = kernel, launches

    def __getitem__(self, grid):
        return lambda *args: self.launches.setdefault(
            (self.kernel.function, tuple(typeof(arg, Purpose.argument) for arg in args)), None
        )


def record_launches():
    """The kernels and the types of their arguments in one training step with statistics, in float32."""
    launches = {}
    host = SimpleNamespace(to_device=lambda x: x, device_array=lambda shape, dtype: np.zeros(shape, dtype))
    kernels = property(lambda kernel: Recorder(kernel, launches))
    with (
        patch.object(target, "free_bytes", lambda: np.inf),
        patch.object(arrays, "cuda", host),
        patch.object(GpuKernel, "compiled", kernels),
    ):
        camera, g = make_camera(), as_dtype(make_gaussians(np.random.default_rng(0), 5), np.float32)
        primitives = activated(g)
        for conventions in (GSPLAT_MAIN, INRIA):
            projection.project(*primitives, camera, conventions)
        p = REFERENCE.project(*primitives, camera, GSPLAT_MAIN)
        p = p._replace(conics=p.conics.astype(np.float64))
        grid = TileGrid(camera.width, camera.height, TILE, TILE)
        tiling.bin_gaussians(p, grid, GSPLAT_MAIN)
        bins = REFERENCE.bin_gaussians(p, grid, GSPLAT_MAIN)
        harmonics = g.means, g.sh_dc, g.sh_rest, camera, 3, p.radii
        colors = spherical_harmonics.sh_colors(*harmonics)
        spherical_harmonics.sh_colors_vjp(*harmonics, colors)
        background = np.zeros(3, np.float32)
        for wanted in (False, True):
            output = compositing.composite(p, colors, background, bins, GSPLAT_MAIN, with_stats=wanted)
        compositing.composite_vjp_atomic(p, colors, background, bins, GSPLAT_MAIN, output, output.image, output.alpha)
        v = compositing.composite_vjp(p, colors, background, bins, GSPLAT_MAIN, output, output.image, output.alpha)
        v_projection = ProjectionGradient(v.means2d, p.depths, v.conics, v.opacities)
        projection.project_vjp(*primitives, camera, GSPLAT_MAIN, p, v_projection)
        removal.removal_changes(p, colors, bins, GSPLAT_MAIN, output)
        ids, normals = output.stats.dominant_ids, np.zeros_like(output.image)
        depth.surface_points_vjp(*primitives[:3], camera, ids, normals, output.alpha)
        loss.photometric_loss(output.image, np.zeros(output.image.shape, np.uint8), 0.2)
        for is_deterministic in (False, True):
            passes = resident.Passes(is_deterministic)
            tape = passes.render(g, camera, resident.Options(background, 3, GSPLAT_MAIN, with_stats=True))
            passes.render_vjp(tape, tape.output.image, tape.output.alpha)
        passes.visible_widths(p.radii, None)
        resident.has_wrong(g)
        adam.adam_update(g.means, g.means, g.means, g.means, None, AdamStep(0.01, 0.9, 0.999, 1e-15))
    return launches


def assemble(ptx, architecture):
    """What ``ptxas`` says: registers, bytes of spills, of the stack and of shared memory."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.ptx"
        path.write_text(ptx)
        command = [find_ptxas(), f"-arch=sm_{architecture}", "-v", "-o", str(path.with_suffix(".cubin")), str(path)]
        said = subprocess.run(command, check=True, capture_output=True, text=True)
    text = said.stdout + said.stderr
    patterns = {
        "registers": r"Used (\d+) registers",
        "spills": r"(\d+) bytes spill stores",
        "stack": r"(\d+) bytes stack frame",
        "shared": r"(\d+) bytes smem",
    }
    return {name: int(m[1]) if (m := re.search(pattern, text)) else 0 for name, pattern in patterns.items()}


def compile_all(architecture):
    """For each kernel, what ``ptxas`` says, and the number of float64 instructions."""
    device = SimpleNamespace(compute_capability=divmod(architecture, 10))  # calls of device functions ask for it
    programs = []
    with patch.object(dispatcher, "get_current_device", lambda: device):
        for function, types in record_launches():
            ptx, _ = cuda.compile_ptx(function, types, device=False, cc=divmod(architecture, 10))
            n_double = len(re.findall(r"\.f64\b", ptx))
            programs.append({"kernel": function.__name__, "doubles": n_double, **assemble(ptx, architecture)})
    return programs


if __name__ == "__main__":
    print(json.dumps(compile_all(int(sys.argv[1]))))
