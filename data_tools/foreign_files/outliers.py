"""One Gaussian beyond what a format holds: which it is, and the file without it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.foreign_files.building import done, refused
from data_tools.foreign_files.dialects import N, gaussians
from minisplat_ref.io import load_ply, save_ply


def _far(folder: Path, rows: tuple[int, ...], distance: float, suffix: str) -> None:
    """Far Gaussians are named, and left out on request; the others are as without them."""
    far = gaussians()
    far.means[list(rows), 1] = distance
    save_ply(folder / "far.ply", far)
    out = folder / f"far{suffix}"
    if suffix == ".spz":
        line = refused("convert", folder / "far.ply", out, names=out)
        assert "--drop-outliers" in line and str(rows[0]) in line, line
    said = done("convert", folder / "far.ply", out, "--drop-outliers")
    assert f"{len(rows)} outliers are left out, row" in said.err and ", ".join(map(str, rows)) in said.err, said.err
    done("convert", out, folder / "back.ply")
    kept = np.delete(gaussians().means, rows, axis=0)
    found = load_ply(folder / "back.ply").means
    distances = np.linalg.norm(found[:, None] - kept[None], axis=2)  # formats may have another order
    assert len(found) == N - len(rows) and distances.min(axis=0).max() < 0.01


def _large(folder: Path, log_scale: float) -> None:
    """A Gaussian whose size is beyond float32."""
    large = gaussians()
    large.log_scales[7, 2] = log_scale
    save_ply(folder / "large.ply", large)
    line = refused("convert", folder / "large.ply", folder / "a.splat", names=folder / "a.splat")
    assert "row 7" in line and "--drop-outliers" in line, line
    done("convert", folder / "large.ply", folder / "a.splat", "--drop-outliers")


def _none(folder: Path) -> None:
    """Where nothing is far, nothing is left out, and nothing is said."""
    save_ply(folder / "usual.ply", gaussians())
    said = done("convert", folder / "usual.ply", folder / "a.ply", "--drop-outliers")
    assert "left out" not in said.err
    np.testing.assert_array_equal(load_ply(folder / "a.ply").means, gaussians().means)


CASES: dict[str, Callable[[Path], None]] = {
    **{
        f"{len(rows)} at {distance:g}, {suffix}": partial(_far, rows=rows, distance=distance, suffix=suffix)
        for rows, distance, suffix in (
            ((4,), 3e6, ".spz"),
            ((0, 9), -1e7, ".spz"),
            ((59,), 1e5, ".sog"),
            ((1, 2, 3), 1e6, ".compressed.ply"),
        )
    },
    **{f"a size of e^{log_scale:g}": partial(_large, log_scale=log_scale) for log_scale in (89.0, 100.0, 300.0)},
    "nothing far": _none,
}
