"""The memory and time of ``convert``: millions of Gaussians of degree 3 from a PLY to every format that is written.

Each conversion is the command itself in a separate process, whose peak is the one that the system reports when it ends.
The Gaussians are made so that compressors find in them what they find in a trained scene: surfaces, on which
neighbours are similar, flat Gaussians, few harmonics of any size. They are written a piece at a time, so that this
process stays small: a child begins with its parent's peak.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.cases import Case, Figure
from minisplat_ref.types import Floats

N = 5_000_000
SUFFIXES = (".ply", ".glb", ".splat", ".compressed.ply", ".spz", ".sog", ".msz", ".omg", ".html")
WITHIN = 2.5e9  # bytes
SECONDS = 120.0  # of processors; other work on the machine lengthens the time on the clock
GIVE_UP = 900.0  # seconds
N_REST = 45
N_SURFACES = 400
AT_ONCE = 1 << 18  # rows
MEGA = 1e6
PROPERTIES = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(N_REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


class Spent(NamedTuple):
    """What one command took."""

    seconds: float
    """On the clock."""
    processor_seconds: float
    """Of all cores, which other work on the machine does not lengthen as much."""
    peak: int
    """Bytes of memory."""
    code: int
    """Of its exit; 124 where it was ended for taking too long."""
    message: str
    """The last line on stderr."""


def conversion_cases(n: int, suffixes: Iterable[str]) -> Iterable[Case]:
    """Yield a case for each format; one fails that takes more memory or time than is allowed.

    Parameters
    ----------
    n : int
        Number of Gaussians.
    suffixes : iterable of str
        Of the formats.
    """
    with tempfile.TemporaryDirectory() as name:
        source = Path(name) / "scene.ply"
        write_scene(source, n)
        for suffix in suffixes:
            out = source.with_name(f"out{suffix}")
            spent = run([sys.executable, "-m", "minisplat_ref", "convert", str(source), str(out)])
            size = out.stat().st_size if out.exists() else 0
            out.unlink(missing_ok=True)
            reasons = [f"exit code {spent.code}: {spent.message}"] if spent.code else []
            reasons += [f"more than {WITHIN / MEGA:,.0f} MB"] if spent.peak > WITHIN else []
            reasons += [f"more than {SECONDS:.0f} s"] if spent.processor_seconds > SECONDS else []
            figures: dict[str, Figure] = {
                "seconds": round(spent.seconds, 1),
                "CPU seconds": round(spent.processor_seconds, 1),
                "peak MB": round(spent.peak / MEGA),
                "file MB": round(size / MEGA),
            }
            yield Case(suffix, not reasons, figures, "; ".join(reasons))


def run(command: list[str]) -> Spent:
    """Run a command, and return its time and its peak of memory.

    Raises
    ------
    InputError
        The system does not say how much memory a process used.
    """
    if not hasattr(os, "wait4"):
        raise InputError("this system does not say how much memory a process used")
    begin = time.monotonic()
    with tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors)
        code = None
        while code is None:
            pid, status, usage = os.wait4(child.pid, os.WNOHANG)
            if pid:
                code = os.waitstatus_to_exitcode(status)
            elif time.monotonic() - begin > GIVE_UP:
                child.kill()
                _, _, usage = os.wait4(child.pid, 0)
                code = 124
            else:
                time.sleep(0.05)
        child.returncode = code  # it has been waited for
        errors.seek(0)
        lines = errors.read().decode(errors="replace").strip().splitlines()
    unit = 1 if sys.platform == "darwin" else 1024
    processor_seconds = usage.ru_utime + usage.ru_stime
    return Spent(time.monotonic() - begin, processor_seconds, usage.ru_maxrss * unit, code, lines[-1] if lines else "")


def write_scene(path: Path, n: int) -> None:
    """Write Gaussians on smooth surfaces as a binary PLY, without normals."""
    rng = np.random.default_rng(0)
    surfaces = rng.normal(0.0, 4.0, (N_SURFACES, 3)), rng.normal(0.0, 1.0, (N_SURFACES, 2, 3))
    tints = rng.normal(0.0, 1.0, (N_SURFACES, 3))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    lines += [*(f"property float {name}" for name in PROPERTIES), "end_header\n"]
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode())
        for start in range(0, n, AT_ONCE):
            file.write(_rows(rng, min(AT_ONCE, n - start), surfaces, tints).tobytes())


def _rows(rng: np.random.Generator, n: int, surfaces: tuple[Floats, Floats], tints: Floats) -> Floats:
    """Return rows [n, 59] of properties, float32."""
    centers, sides = surfaces
    on = rng.integers(N_SURFACES, size=n)
    places = rng.uniform(-1.0, 1.0, (n, 2))
    means = centers[on] + np.einsum("ni,nij->nj", places, sides[on]) + 0.01 * rng.normal(size=(n, 3))
    shade = np.sin(3.0 * places.sum(axis=1, keepdims=True))
    sh_dc = tints[on] + 0.5 * shade + 0.1 * rng.normal(size=(n, 3))
    sh_rest = 0.05 * rng.standard_t(3.0, (n, N_REST)) + 0.05 * shade
    log_scales = rng.normal(-5.0, 0.7, (n, 1)) + rng.normal([0.0, -0.3, -2.0], 0.4, (n, 3))
    opacities = rng.normal(0.0, 2.5, (n, 1))
    quats = rng.normal(size=(n, 4))
    return np.concatenate([means, sh_dc, sh_rest, opacities, log_scales, quats], axis=1).astype("<f4")
