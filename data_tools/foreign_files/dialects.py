"""Gaussians as other programs write them: PLY files with names of their own, infinities, and SPZ of all versions."""

import gzip
import struct
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import zstandard
from numpy.typing import NDArray

from data_tools.foreign_files.building import command, done, refused
from minisplat_ref.errors import InputWarning
from minisplat_ref.io import load_ply, load_points, read_image, save_ply
from minisplat_ref.io.formats import spz
from minisplat_ref.io.ply_file import read_vertices, write_vertices
from minisplat_ref.types import Gaussians

N = 60


def gaussians(degree: int = 1) -> Gaussians:
    """Return Gaussians in a ball in front of an orbit's cameras."""
    rng = np.random.default_rng(3)
    n_rest = (degree + 1) ** 2 - 1
    return Gaussians(
        means=rng.normal(size=(N, 3)).astype(np.float32),
        quats=rng.normal(size=(N, 4)).astype(np.float32),
        log_scales=rng.uniform(-3, -1, (N, 3)).astype(np.float32),
        opacity_logits=rng.normal(size=N).astype(np.float32),
        sh_dc=rng.uniform(-1, 1, (N, 3)).astype(np.float32),
        sh_rest=rng.uniform(-0.2, 0.2, (N, n_rest, 3)).astype(np.float32),
    )


def _columns(folder: Path, degree: int = 1) -> dict[str, NDArray]:
    save_ply(folder / "usual.ply", gaussians(degree))
    return read_vertices(folder / "usual.ply")


def _assert_same(path: Path, expected: Gaussians) -> None:
    """Compare with the Gaussians, and have every command take the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # the case looks at them itself
        found = load_ply(path)
    for field, value, other in zip(expected._fields, found, expected, strict=True):
        np.testing.assert_allclose(value, other, atol=1e-6, err_msg=field)
    out = done("info", path).out
    assert f"Gaussians {N}" in " ".join(out.split()), out
    assert "further properties" not in out
    done("render", path, "--frames", 1, "--size", "32x24", "--out", path.with_suffix(""))
    said = done("convert", path, path.with_suffix(".msz"))
    assert "left out" not in said.err


def _renamed(folder: Path, names: Mapping[str, str]) -> None:
    """Properties under other names are those of 3DGS."""
    columns = {}
    for name, column in _columns(folder).items():
        stem, _, end = name.rpartition("_")
        if f"{stem}_" in names:
            name = names[f"{stem}_"].format(end)
        columns[names.get(name, name)] = column
    write_vertices(folder / "other.ply", columns)
    _assert_same(folder / "other.ply", gaussians())


def _in_another_order(folder: Path) -> None:
    columns = _columns(folder)
    order = np.random.default_rng(0).permutation(len(columns))
    names = list(columns)
    write_vertices(folder / "other.ply", {names[i]: columns[names[i]] for i in order})
    _assert_same(folder / "other.ply", gaussians())


def _colored(folder: Path, kind: str) -> None:
    """Colours as red, green, blue, as bytes, longer integers or floats."""
    columns = _columns(folder, 0)
    dc = np.stack([columns.pop(f"f_dc_{c}") for c in range(3)], axis=1)
    levels = np.rint(255 * (0.5 + 0.28209479177387814 * dc))
    values = (levels / 255 if kind == "f4" else levels).astype(kind)
    write_vertices(folder / "other.ply", columns | dict(zip(("red", "green", "blue"), values.T, strict=True)))
    said = command("info", folder / "other.ply")
    assert said.code == 0 and any("red, green, blue" in warning for warning in said.warnings), said.err
    shown = (levels / 255 - 0.5) / 0.28209479177387814
    _assert_same(folder / "other.ply", gaussians(0)._replace(sh_dc=shown.astype(np.float32)))


def _wrong_colors(folder: Path) -> None:
    columns = _columns(folder, 0)
    for c, color in enumerate(("red", "green", "blue")):
        del columns[f"f_dc_{c}"]
        columns[color] = np.linspace(0, 65535, N).astype(np.uint16)
    write_vertices(folder / "other.ply", columns)
    line = refused("info", folder / "other.ply", names="other.ply")
    assert "red goes from 0 to 65535" in line and "uchar" in line


def _flat(folder: Path) -> None:
    """Two scales, of 2DGS."""
    columns = _columns(folder)
    del columns["scale_2"]
    write_vertices(folder / "flat.ply", columns)
    assert any("two scales" in warning for warning in done("info", folder / "flat.ply").warnings)
    expected = gaussians()
    expected.log_scales[:, 2] = expected.log_scales[:, :2].min(axis=1) - np.log(1000)
    _assert_same(folder / "flat.ply", expected)


def _infinite(folder: Path, name: str, value: float, taken: float) -> None:
    """Infinities with a meaning are taken as numbers, and counted."""
    columns = _columns(folder)
    columns[name] = columns[name].copy()
    columns[name][[2, 7, 11]] = value
    write_vertices(folder / "infinite.ply", columns)
    (warning,) = done("info", folder / "infinite.ply").warnings
    assert f"3 of {N}" in warning and "infinit" in warning
    expected = gaussians()
    field = expected.opacity_logits if name == "opacity" else expected.log_scales[:, int(name[-1])]
    field[[2, 7, 11]] = taken
    _assert_same(folder / "infinite.ply", expected)
    image = read_image(next((folder / "infinite").glob("*.png")))
    assert image.max() > 0


def _meaningless(folder: Path, name: str, value: float) -> None:
    columns = _columns(folder)
    columns[name] = columns[name].copy()
    columns[name][5] = value
    write_vertices(folder / "bad.ply", columns)
    line = refused("info", folder / "bad.ply", names=folder / "bad.ply")
    assert f"property {name} is" in line and "row 5" in line


def _without_colors(folder: Path) -> None:
    columns = {name: column for name, column in _columns(folder, 0).items() if not name.startswith("f_dc")}
    write_vertices(folder / "bare.ply", columns)
    line = refused("info", folder / "bare.ply", names=folder / "bare.ply")
    assert "point cloud" not in line and "no property f_dc_0" in line and "red, green, blue" in line


def _cloud(folder: Path) -> None:
    """A point cloud is still called one."""
    points = dict(zip(("x", "y", "z"), gaussians().means.T, strict=True))
    write_vertices(folder / "cloud.ply", points)
    assert "it is a point cloud" in refused("info", folder / "cloud.ply", names="cloud.ply")
    assert len(load_points(folder / "cloud.ply").points) == N


def _one_far(folder: Path, distance: float) -> None:
    """One far Gaussian takes a bit or two of the others' centres, and no more."""
    far = gaussians()
    far.means[4] = [distance, 0, 0]
    save_ply(folder / "far.ply", far)
    done("convert", folder / "far.ply", folder / "far.spz")
    back = spz.decode((folder / "far.spz").read_bytes(), "far.spz")
    np.testing.assert_allclose(back.means, far.means, atol=distance / 2**23)


def _too_far(folder: Path) -> None:
    far = gaussians()
    far.means[4] = [3e6, 0, 0]
    save_ply(folder / "far.ply", far)
    line = refused("convert", folder / "far.ply", folder / "far.spz", names="far.spz")
    assert "row 4 is 3e+06 away" in line and "remove what is far" in line


def as_version_4(content: bytes, *, records: bytes = b"", sized: bool = True) -> bytes:
    """Return a file of version 3 as one of version 4."""
    raw = gzip.decompress(content)
    _, _, n, degree, bits, flags, _ = spz.HEADER.unpack_from(raw)
    begin, parts = spz.HEADER.size, []
    for size in (9, 1, 3, 3, 4, (0, 9, 24, 45, 72)[degree]):
        parts.append(raw[begin : begin + n * size])
        begin += n * size
    frames = [zstandard.ZstdCompressor(write_content_size=sized).compress(part) for part in parts]
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, n, degree, bits, flags | 2 * bool(records), 6, 32 + len(records))
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts, strict=True))
    return b"".join([header, records, table, *frames])


def _version_4(folder: Path, degree: int, sized: bool, records: bytes) -> None:
    """Version 4 holds what version 3 does."""
    third = spz.encode(gaussians(degree), 0)
    (folder / "fourth.spz").write_bytes(as_version_4(third, records=records, sized=sized))
    for value, other in zip(
        spz.decode((folder / "fourth.spz").read_bytes(), "fourth.spz"), spz.decode(third, "third.spz"), strict=True
    ):
        np.testing.assert_array_equal(value, other)
    assert "SPZ version" in done("info", folder / "fourth.spz").out
    done("convert", folder / "fourth.spz", folder / "back.ply")
    done("render", folder / "fourth.spz", "--frames", 1, "--size", "32x24", "--out", folder / "views")


def _torn(folder: Path, cut: int) -> None:
    """A torn file of version 4 is refused."""
    content = as_version_4(spz.encode(gaussians(), 0))
    (folder / "torn.spz").write_bytes(content[:cut] if cut > 0 else content[: len(content) + cut])
    line = refused("info", folder / "torn.spz", names=folder / "torn.spz")
    assert "truncated" in line or "damaged" in line


def _of_splat_transform(folder: Path) -> None:
    """splat-transform takes the logit of an opacity of 255 for infinity, which is an opacity of 1."""
    opaque = gaussians()
    opaque.opacity_logits[:] = 90.0
    back = spz.decode(spz.encode(opaque, 0), "file")
    save_ply(folder / "file.ply", back)
    columns = read_vertices(folder / "file.ply")
    columns["opacity"] = np.full(N, np.inf, np.float32)
    write_vertices(folder / "theirs.ply", columns)
    (warning,) = done("info", folder / "theirs.ply").warnings
    assert f"{N} of {N} opacities are infinite" in warning


RENAMED: dict[str, dict[str, str]] = {
    "features and scaling": {
        **{"f_dc_": "features_dc_{}", "f_rest_": "features_rest_{}", "opacity": "opacities"},
        **{"scale_": "scaling_{}", "rot_": "rotation_{}"},
    },
    "gsplat's words": {"scale_": "scales_{}", "rot_": "quats_{}", "x": "means_0", "y": "means_1", "z": "means_2"},
    "letters": {
        **{"scale_0": "scale_x", "scale_1": "scale_y", "scale_2": "scale_z"},
        **{"rot_0": "rot_w", "rot_1": "rot_x", "rot_2": "rot_y", "rot_3": "rot_z"},
    },
    "short letters": {
        **{"scale_0": "sx", "scale_1": "sy", "scale_2": "sz"},
        **{"rot_0": "qw", "rot_1": "qx", "rot_2": "qy", "rot_3": "qz"},
    },
    "upper case": {"x": "X", "y": "Y", "z": "Z", "opacity": "Opacity", "scale_": "Scale_{}", "rot_": "Rot_{}"},
}

CASES: dict[str, Callable[[Path], None]] = {
    **{what: partial(_renamed, names=names) for what, names in RENAMED.items()},
    "another order": _in_another_order,
    **{f"colours of type {kind}": partial(_colored, kind=kind) for kind in ("u1", "i4", "f4")},
    "colours of 16 bits": _wrong_colors,
    "two scales": _flat,
    "opacity of infinity": partial(_infinite, name="opacity", value=np.inf, taken=16.0),
    "opacity of minus infinity": partial(_infinite, name="opacity", value=-np.inf, taken=-16.0),
    "scale of minus infinity": partial(_infinite, name="scale_1", value=-np.inf, taken=-30.0),
    "scale of infinity": partial(_meaningless, name="scale_1", value=np.inf),
    "opacity of NaN": partial(_meaningless, name="opacity", value=np.nan),
    "centre of infinity": partial(_meaningless, name="x", value=-np.inf),
    "no colours": _without_colors,
    "a point cloud": _cloud,
    **{f"SPZ, one at {distance:g}": partial(_one_far, distance=distance) for distance in (2048.0, 5000.0, 30_000.0)},
    "SPZ, one too far": _too_far,
    **{f"SPZ 4 of degree {degree}": partial(_version_4, degree=degree, sized=True, records=b"") for degree in range(4)},
    "SPZ 4 with records": partial(_version_4, degree=1, sized=True, records=b"\x01\0\0\0\x04\0\0\0abcd"),
    "SPZ 4 of streams": partial(_version_4, degree=1, sized=False, records=b""),
    **{f"SPZ 4 cut at {cut}": partial(_torn, cut=cut) for cut in (20, 40, 150, -1)},
    "opacity of splat-transform": _of_splat_transform,
}
