"""Gaussians of relatives of 3DGS, which plain 3DGS draws wrongly, and values that are not those of a PLY."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.foreign_files.building import done
from data_tools.foreign_files.dialects import N, gaussians
from minisplat_ref.errors import InputWarning
from minisplat_ref.extensions.antialiasing.model import FilteredGaussians, smooth
from minisplat_ref.io import load_ply, read_image, save_ply
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.types import Gaussians


def _with_columns(folder: Path, names: Sequence[str]) -> Path:
    save_ply(folder / "usual.ply", gaussians())
    rng = np.random.default_rng(1)
    further = {name: rng.uniform(0.01, 0.1, N).astype(np.float32) for name in names}
    write_vertices(folder / "theirs.ply", read_vertices(folder / "usual.ply") | further)
    return folder / "theirs.ply"


def warnings_of(path: Path) -> list[str]:
    """Return the warnings of reading a file in Python."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_ply(path)
    return [str(warning.message) for warning in caught if warning.category is InputWarning]


def _columns(folder: Path, names: Sequence[str], says: str) -> None:
    """Their columns are named with what draws them, by the library, and by every command that draws the file."""
    path = _with_columns(folder, names)
    (warning,) = warnings_of(path)
    assert names[0] in warning and says in warning, warning
    for arguments in (
        ("info", path),
        ("render", path, "--frames", 1, "--size", "32x24", "--out", folder / "views"),
        ("convert", path, folder / "other.splat"),
    ):
        said = done(*arguments)
        assert any(says in line for line in said.warnings), said.err


def _unknown(folder: Path, names: Sequence[str]) -> None:
    """Columns that nobody knows are listed."""
    (warning,) = warnings_of(_with_columns(folder, names))
    assert f"{', '.join(names)} (unknown here)" in warning, warning


def _filtered(folder: Path) -> None:
    """Mip-Splatting's own file is drawn as it draws it, by the extension that has its filter."""
    path = _with_columns(folder, ("filter_3D",))
    sigmas = read_vertices(path)["filter_3D"]
    np.testing.assert_array_equal(load_ply(path, FilteredGaussians).filter_sigmas, sigmas)
    usual = gaussians()
    scales, opacities = smooth(usual.log_scales, usual.opacity_logits, sigmas)
    save_ply(folder / "fused.ply", usual._replace(log_scales=scales, opacity_logits=opacities))
    done("convert", path, folder / "ours.ply", "--extension", "antialiasing")
    done("antialiasing", "fuse", folder / "ours.ply", folder / "ours_fused.ply")
    for value, other in zip(load_ply(folder / "ours_fused.ply"), load_ply(folder / "fused.ply"), strict=True):
        np.testing.assert_allclose(value, other, atol=1e-5)
    frame = ("--frames", 1, "--size", "48x36")
    done("render", path, "--extension", "antialiasing", *frame, "--out", folder / "a")
    done("render", path, *frame, "--out", folder / "b")
    images = [read_image(next((folder / name).glob("*.png"))).astype(int) for name in "ab"]
    assert np.abs(images[0] - images[1]).max() > 10


def _ranges(folder: Path, change: Callable[[Gaussians], Gaussians], says: Sequence[str]) -> None:
    """Values after their activation are said; those of 3DGS are not."""
    save_ply(folder / "usual.ply", gaussians())
    assert warnings_of(folder / "usual.ply") == []
    save_ply(folder / "theirs.ply", change(gaussians()))
    found = warnings_of(folder / "theirs.ply")
    assert len(found) == bool(says) and all(part in found[0] for part in says), found
    if says:
        assert any(says[0] in line for line in done("info", folder / "theirs.ply").warnings)


def _activated(usual: Gaussians) -> Gaussians:
    return usual._replace(
        opacity_logits=1 / (1 + np.exp(-usual.opacity_logits)),
        log_scales=np.exp(usual.log_scales),
        sh_dc=0.5 + 0.28 * usual.sh_dc,
    )


def _opacities(usual: Gaussians) -> Gaussians:
    return usual._replace(opacity_logits=np.linspace(0, 1, N, dtype=np.float32))


def _sizes(usual: Gaussians, factor: float = 1.0) -> Gaussians:
    return usual._replace(
        means=np.float32(factor) * usual.means, log_scales=(factor * np.exp(usual.log_scales)).astype(np.float32)
    )


def _colors(usual: Gaussians, white: float) -> Gaussians:
    return usual._replace(sh_dc=(white * np.random.default_rng(2).uniform(0, 1, (N, 3))).astype(np.float32))


def _large_scene(usual: Gaussians) -> Gaussians:
    """Millimetres, where all sizes are above 1."""
    return usual._replace(means=1000 * usual.means, log_scales=usual.log_scales + np.float32(np.log(1000.0)))


def _opaque(usual: Gaussians) -> Gaussians:
    return usual._replace(opacity_logits=usual.opacity_logits + 20)


OPACITIES, SIZES, COLORS = "all opacities are between 0 and 1", "all scales are positive", "all f_dc are between 0"

CASES: dict[str, Callable[[Path], None]] = {
    **{
        f"columns of {what}": partial(_columns, names=names, says=says)
        for what, names, says in (
            ("Mip-Splatting", ("filter_3D",), "Mip-Splatting"),
            ("4DGS", ("t", "scale_t"), "4D Gaussian Splatting"),
            ("4DGS with rotors", ("t", "scale_t_0", "rot_r_0", "rot_r_1", "rot_r_2", "rot_r_3"), "4D Gaussian"),
            ("SpacetimeGaussians", tuple(f"motion_{i}" for i in range(9)), "SpacetimeGaussians"),
            ("SpacetimeGaussians, in full", ("trbf_center", "trbf_scale", "motion_0", "omega_0"), "SpacetimeGaussians"),
            ("Deformable Beta Splatting", ("beta", "sb_params_0", "sb_params_1"), "Beta"),
            ("Scaffold-GS", ("f_offset_0", "f_anchor_feat_0"), "Scaffold-GS"),
            ("relighting", ("base_color_0", "roughness"), "lights materials"),
            ("Gaussian Grouping", tuple(f"obj_dc_{i}" for i in range(16)), "labels"),
            ("an editor", ("red", "green", "blue"), "programs that show points"),
        )
    },
    **{f"unknown: {names[0]}": partial(_unknown, names=names) for names in (("glow",), ("p_0", "p_1"), ("U", "V"))},
    "Mip-Splatting, drawn": _filtered,
    "all activated": partial(_ranges, change=_activated, says=(OPACITIES, SIZES, COLORS)),
    "opacities from 0 to 1": partial(_ranges, change=_opacities, says=(OPACITIES,)),
    **{
        f"sizes x {factor:g}": partial(_ranges, change=partial(_sizes, factor=factor), says=(SIZES,))
        for factor in (0.1, 1.0, 100.0)
    },
    **{
        f"colours to {white}": partial(_ranges, change=partial(_colors, white=white), says=(COLORS,))
        for white in (1, 255)
    },
    "a scene in millimetres": partial(_ranges, change=_large_scene, says=()),
    "an opaque scene": partial(_ranges, change=_opaque, says=()),
}
