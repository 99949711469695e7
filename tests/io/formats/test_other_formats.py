"""Formats of other programs: bytes worked out by hand, stated losses, damage in one line, and the command line."""

import io
import json
import math
import struct
import warnings
import zipfile

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from compact import population, refusal, refused_line, rotation_error
from data_tools.foreign_files.ksplat import write_ksplat
from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.extensions.extension import find_format
from minisplat_ref.io import load_ply, save_ply
from minisplat_ref.io.formats import compressed_ply, glb, ksplat, levels8, sog, splat
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.types import Gaussians
from tolerances import CLOSED_FORM, ROUNDED_TO_FLOAT32

COMPRESSED, GLB, KSPLAT = compressed_ply.COMPRESSED_PLY, glb.GLB, ksplat.KSPLAT
SOG, SPLAT = sog.SOG, splat.SPLAT
OPACITY = 0.5 / 255 + ROUNDED_TO_FLOAT32
COLOR = 0.5 / 255 / 0.28209479 + ROUNDED_TO_FLOAT32  # of a coefficient of degree 0 in 255ths of colour
HALF = 2.0**-11  # relative error of a half float


def encoded(format_, gaussians):
    """A file, without the warning that harmonics are left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        return format_.encode(gaussians, 0)


def mild(n=300, sh_degree=3):
    """Gaussians whose colours and harmonics are in every format's range."""
    gaussians = population(n, sh_degree)
    return gaussians._replace(sh_dc=np.clip(gaussians.sh_dc, -1.7, 1.7), sh_rest=np.clip(gaussians.sh_rest, -1.2, 1.7))


def in_morton_order(gaussians):
    order = morton_order(gaussians.means.astype(np.float64))
    return Gaussians(*(field[order] for field in gaussians))


def opacities(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def one(**changes):
    fields = {
        "means": [[1.0, -2.0, 0.5]],
        "quats": [[0.0, 0.0, -2.0, 0.0]],
        "log_scales": [[0.0, math.log(2.0), math.log(0.5)]],
        "opacity_logits": [0.0],
        "sh_dc": [[0.0, 9.0, -9.0]],
        "sh_rest": np.zeros((1, 0, 3)),
    }
    return Gaussians(*(np.array(field, np.float32) for field in (fields | changes).values()))


# what they share


def test_the_largest_component_is_left_out():
    largest, others = levels8.drop_largest(np.array([[1.0, 0, 0, 0], [0, -3.0, 0, 0], [1, 1, 1, -2.0]]))
    assert largest.tolist() == [0, 1, 3]
    assert_allclose(others[0], 0.5)
    assert_allclose(others[2], 0.5 - math.sqrt(1 / 14), atol=CLOSED_FORM)  # -1/sqrt(7) / sqrt(2), as the sign changed
    back = levels8.restore_largest(largest, others)
    assert_allclose(back[1], [0, 1, 0, 0], atol=CLOSED_FORM)
    assert_allclose(back[2], np.array([-1, -1, -1, 2]) / math.sqrt(7), atol=CLOSED_FORM)


def test_opacities_of_0_and_1_have_logits():
    logits = levels8.decode_logits(np.array([0, 51, 255], np.uint8))
    assert_allclose(1 / (1 + np.exp(-logits)), [0.25 / 255, 0.2, 254.75 / 255], rtol=CLOSED_FORM)


# .splat


def test_splat_by_hand():
    content = SPLAT.encode(one(), 0)
    assert struct.unpack("<6f", content[:24]) == pytest.approx((1.0, -2.0, 0.5, 1.0, 2.0, 0.5))
    assert content[24:] == bytes([128, 255, 0, 128]) + bytes([128, 128, 0, 128])  # 127.5 rounds up; -128 + 128


@pytest.mark.parametrize("n", [0, 300])
def test_splat_round_trip(n):
    gaussians = mild(n)
    with pytest.warns(InputWarning, match="no harmonics above degree 0"):
        content = SPLAT.encode(gaussians, 0) if n else SPLAT.encode(mild(3), 0)[:0]
    back = SPLAT.decode(content, "file")
    assert back.sh_rest.shape == (n, 0, 3)
    assert_allclose(back.means, gaussians.means)
    assert_allclose(back.log_scales, gaussians.log_scales, atol=4 * ROUNDED_TO_FLOAT32)
    assert_allclose(opacities(back), opacities(gaussians), atol=OPACITY)
    assert_allclose(back.sh_dc, gaussians.sh_dc, atol=COLOR)
    assert rotation_error(back.quats, gaussians.quats).max(initial=0) < 2 / 128  # each component within 1/256


def test_splat_refuses():
    with pytest.raises(InputError, match=r"scales of row 0, e\^\[0\.0, 0\.0, 200\.0\], are beyond float32"):
        SPLAT.encode(one(log_scales=[[0.0, 0.0, 200.0]]), 0)
    assert "31 bytes are no rows of 32" in refusal(SPLAT, bytes(31))
    assert "row 0 has the scales [0.0, 0.0, 0.0]" in refusal(SPLAT, bytes(32))
    row = SPLAT.encode(one(), 0)
    assert "means is nan" in refusal(SPLAT, struct.pack("<f", math.nan) + row[4:])


# compressed PLY


def test_compressed_ply_by_hand():
    """Two Gaussians, so that one is at each bound: all bits 0 or 1; and a rotation in 10 bits."""
    two = Gaussians(*(np.concatenate(fields) for fields in zip(one(), one(means=[[3.0, 4.0, 5.0]]), strict=True)))
    two.sh_dc[:] = [[0, 0, 0], [1, 1, 1]]
    two.quats[1] = [1.0, 0.0, 1.0, 0.0]
    content = COMPRESSED.encode(two, 0)
    body = content[content.index(b"end_header\n") + 11 :]
    assert len(body) == 18 * 4 + 2 * 16
    assert struct.unpack("<6f", body[:24]) == (1, -2, 0.5, 3, 4, 5)
    position, rotation, _, color = struct.unpack("<4I", body[72:88])
    assert position == 0 and color == 128  # 127.5 rounds up
    assert rotation == 2 << 30 | 512 << 20 | 512 << 10 | 512  # y; 511.5 rounds up
    position, rotation, scale, color = struct.unpack("<4I", body[88:])
    assert position == 0xFFFFFFFF and color >> 8 == 0xFFFFFF and scale == 0  # all scales are equal
    assert rotation == 0 << 30 | 512 << 20 | 1023 << 10 | 512  # w, the first of two that are largest; y = 1/sqrt(2)


@pytest.mark.parametrize(("n", "sh_degree"), [(0, 1), (1, 0), (256, 1), (300, 2), (600, 3)])
def test_compressed_ply_round_trip(n, sh_degree):
    gaussians = in_morton_order(mild(n, sh_degree))
    content = COMPRESSED.encode(gaussians, 0)
    back = COMPRESSED.decode(content, "file.compressed.ply")
    for name, steps in (("means", [2047, 1023, 2047]), ("log_scales", [2047, 1023, 2047]), ("sh_dc", [255] * 3)):
        values, found = getattr(gaussians, name), getattr(back, name)
        for begin in range(0, n, 256):
            chunk = slice(begin, begin + 256)
            within = np.ptp(values[chunk], axis=0) * 0.5 / np.array(steps) + 10 * ROUNDED_TO_FLOAT32
            assert (np.abs(found[chunk] - values[chunk]) <= within).all(), name
    assert_allclose(opacities(back), opacities(gaussians), atol=OPACITY)
    assert_allclose(back.sh_rest, gaussians.sh_rest, atol=8 / 256 / 2 + ROUNDED_TO_FLOAT32)
    assert rotation_error(back.quats, gaussians.quats).max(initial=0) < 0.005  # each within half of sqrt(2) / 1023
    assert dict(COMPRESSED.describe(content, "file"))["opacities"] == "within 0.002"


def test_compressed_ply_of_an_older_writer():
    """Without the bounds of colours, which are then 0 and 1."""
    content = COMPRESSED.encode(one(), 0)
    end = content.index(b"end_header\n") + 11
    names = [f"property float {bound}_{color}\n".encode() for bound in ("min", "max") for color in "rgb"]
    header = content[:end]
    for name in names:
        header = header.replace(name, b"")
    color = struct.pack("<I", 51 << 24 | 102 << 16 | 255 << 8 | 255)
    back = COMPRESSED.decode(header + content[end : end + 48] + content[end + 72 : -4] + color, "file")
    assert_allclose(back.sh_dc[0] * 0.28209479 + 0.5, [0.2, 0.4, 1.0], atol=ROUNDED_TO_FLOAT32)


def test_compressed_ply_refuses(tmp_path):
    content = COMPRESSED.encode(mild(20, 1), 0)
    assert "truncated" in refusal(COMPRESSED, content[:-1])
    assert "its header is not that" in refusal(COMPRESSED, content.replace(b"element chunk 1", b"element chunk 2"))
    assert "truncated" in refusal(
        COMPRESSED, content.replace(b"element vertex 20", b"element vertex 25").replace(b"sh 20", b"sh 25")
    )
    assert "its header is not that" in refusal(COMPRESSED, content.replace(b"uint packed_scale", b"int packed_scale"))
    assert "f_rest_0 to f_rest_8" in refusal(COMPRESSED, content.replace(b"uchar f_rest_3", b"uchar f_rest_9"))
    save_ply(tmp_path / "plain.ply", mild(3))
    assert "not a compressed PLY" in refusal(COMPRESSED, (tmp_path / "plain.ply").read_bytes())
    (tmp_path / "named.ply").write_bytes(content)
    with pytest.raises(InputError, match=r"named\.ply: .*let its name end in \.compressed\.ply"):
        load_ply(tmp_path / "named.ply")


# .sog


def changed_sog(content, **changes):
    """A file whose meta.json says something else."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(file, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, json.dumps(json.loads(data) | changes) if name == "meta.json" else data)
    return file.getvalue()


def sog_parts(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        images = {
            name: np.asarray(Image.open(io.BytesIO(archive.read(name))))
            for name in archive.namelist()
            if name != "meta.json"
        }
        return json.loads(archive.read("meta.json")), images


def test_sog_by_hand():
    two = Gaussians(*(np.concatenate(fields) for fields in zip(one(), one(means=[[3.0, 4.0, 5.0]]), strict=True)))
    two.opacity_logits[1] = -90
    meta, images = sog_parts(SOG.encode(two, 0))
    assert (meta["version"], meta["count"]) == (2, 2) and "shN" not in meta
    assert_allclose(meta["means"]["mins"], [math.log(2), -math.log(3), math.log(1.5)])
    assert_allclose(meta["means"]["maxs"], np.log([4, 5, 6]))
    assert images["means_l.webp"][0, :2].tolist() == images["means_u.webp"][0, :2].tolist() == [[0] * 3, [255] * 3]
    assert images["quats.webp"][0, 0].tolist() == [128, 128, 128, 254]  # y; 127.5 rounds up
    book = meta["scales"]["codebook"]
    assert len(book) == 256
    assert_allclose([book[i] for i in images["scales.webp"][0, 0]], np.log([1.0, 2.0, 0.5]), atol=ROUNDED_TO_FLOAT32)
    sh0 = images["sh0.webp"][0]
    assert sh0[:2, 3].tolist() == [128, 0]
    assert [meta["sh0"]["codebook"][i] for i in sh0[1, :3]] == [0.0, 9.0, -9.0]  # kept though its pixel is transparent


@pytest.mark.parametrize(("n", "sh_degree"), [(0, 1), (1, 0), (300, 1), (300, 2), (300, 3)])
def test_sog_round_trip(n, sh_degree):
    gaussians = in_morton_order(mild(n, sh_degree))
    content = SOG.encode(gaussians, 0)
    back = SOG.decode(content, "file")
    logs = [np.sign(m) * np.log1p(np.abs(m.astype(np.float64))) for m in (gaussians.means, back.means)]
    if n:
        assert_allclose(logs[1], logs[0], atol=np.ptp(logs[0], axis=0).max() * 0.5 / 65535 + ROUNDED_TO_FLOAT32)
    assert_allclose(opacities(back), opacities(gaussians), atol=OPACITY)
    assert rotation_error(back.quats, gaussians.quats).max(initial=0) < 0.02  # each within half of sqrt(2) / 255
    for name in ("log_scales", "sh_dc", "sh_rest")[: 3 if sh_degree and n else 2]:
        values, found = getattr(gaussians, name), getattr(back, name)
        if values.size:  # 256 levels at equal distances would have an error of 0.29 of a step
            assert np.sqrt(np.mean((found - values) ** 2)) < 0.29 * np.ptp(values) / 255, name
    assert SOG.encode(gaussians, 0) == content


def test_sog_palette_of_many(monkeypatch):
    """More Gaussians than the palette has entries: those that are alike share one."""
    monkeypatch.setattr(sog, "PALETTE_MAX", 64)
    rng = np.random.default_rng(2)
    kinds = rng.normal(size=(60, 9))
    rows = kinds[rng.integers(0, 60, 1000)] + rng.normal(0, 1e-3, (1000, 9))
    palette, labels = sog._palette(rows.reshape(1000, 3, 3), np.arange(1000))
    assert palette.shape == (64, 9) and {*np.bincount(labels, minlength=64).tolist()} == {15, 16}  # 1000 halved 6 times
    assert np.mean((palette[labels] - rows) ** 2) < 0.5 * rows.var(axis=0).mean()
    gaussians = population(1000, 1)._replace(sh_rest=rows.reshape(1000, 3, 3).astype(np.float32))
    back = SOG.decode(SOG.encode(gaussians, 0), "file")
    assert len(np.unique(back.sh_rest.reshape(1000, 9), axis=0)) <= 64


def test_sog_refuses():
    content = SOG.encode(mild(20, 1), 0)
    assert "SOG of version 3" in refusal(SOG, changed_sog(content, version=3))
    assert "pixels for 2,000,000,000 Gaussians" in refusal(SOG, changed_sog(content, count=2_000_000_000))
    assert "says no number" in refusal(SOG, changed_sog(content, count="many"))
    assert "names no files of quats" in refusal(SOG, changed_sog(content, quats={}))
    assert "no item named 'a.webp'" in refusal(SOG, changed_sog(content, quats={"files": ["a.webp"]}))
    meta, _ = sog_parts(content)
    assert "entry that its palette lacks" in refusal(SOG, changed_sog(content, shN=meta["shN"] | {"count": 3}))
    assert "of degree 4" in refusal(SOG, changed_sog(content, shN=meta["shN"] | {"bands": 4}))
    assert "a codebook has 2 levels" in refusal(SOG, changed_sog(content, sh0=meta["sh0"] | {"codebook": [0, 1]}))
    assert "not a SOG file" in refusal(SOG, content[:-5])
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        scales = archive.read("scales.webp")
    assert "not a SOG file" in refusal(SOG, content.replace(scales[:40], bytes(40)))


# .ksplat


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_ksplat_is_read(level, sh_degree):
    gaussians = mild(83, sh_degree)
    content = write_ksplat(gaussians, level)
    back = KSPLAT.decode(content, "file")
    # From the bucket's centre, at most half a step of 2.5 / 32767.
    assert_allclose(back.means, gaussians.means, atol=1e-6 if level == 0 else 1.25 / 32767 + ROUNDED_TO_FLOAT32)
    assert_allclose(back.log_scales, gaussians.log_scales, atol=HALF + ROUNDED_TO_FLOAT32)
    assert rotation_error(back.quats, gaussians.quats).max() < 4 * HALF
    assert_allclose(opacities(back), opacities(gaussians), atol=OPACITY)
    assert_allclose(back.sh_dc, gaussians.sh_dc, atol=COLOR)
    atol = (ROUNDED_TO_FLOAT32, 2 * HALF, 0.5 * 3 / 255 + ROUNDED_TO_FLOAT32)[level]
    assert_allclose(back.sh_rest, gaussians.sh_rest, atol=atol)
    assert ("level", str(level)) in KSPLAT.describe(content, "file")


def test_ksplat_without_bounds_has_harmonics_to_one_and_a_half():
    """The file's own bounds are -1.25 and 1.75: a byte is then a quarter more than with -1.5 and 1.5."""
    content = write_ksplat(mild(83, 1), 2)
    without = content[:36] + bytes(8) + content[44:]
    with_bounds, found = (KSPLAT.decode(data, "file") for data in (content, without))
    assert_allclose(found.sh_rest, with_bounds.sh_rest - 0.25, atol=ROUNDED_TO_FLOAT32)


def test_ksplat_reads_no_size_as_a_tiny_one():
    gaussians = mild(83, 0)
    gaussians.log_scales[5, 1] = -np.inf
    assert KSPLAT.decode(write_ksplat(gaussians, 0), "file").log_scales[5, 1] == -10


def test_ksplat_refuses():
    content = write_ksplat(mild(83, 1), 1)

    def with_(place, kind, value):
        return content[:place] + struct.pack(kind, value) + content[place + struct.calcsize(kind) :]

    section = 4096 + 1024  # the first is empty
    assert "version 1.1" in refusal(KSPLAT, with_(0, "<B", 1))
    assert "truncated" in refusal(KSPLAT, content[:4000]) and "truncated" in refusal(KSPLAT, content[:-1])
    assert "truncated" in refusal(KSPLAT, with_(4, "<I", 2**31))
    assert "do not have 84 Gaussians" in refusal(KSPLAT, with_(16, "<I", 84))
    assert "level 3" in refusal(KSPLAT, with_(20, "<H", 3))
    assert "of degree 3" in refusal(KSPLAT, with_(section + 40, "<H", 3))
    assert "buckets hold fewer than 42" in refusal(KSPLAT, with_(section + 32, "<I", 0))
    assert "truncated" in refusal(KSPLAT, with_(section + 4, "<I", 2**31))
    with pytest.raises(InputError, match="read, but not written"):
        KSPLAT.encode(mild(3), 0)


# .glb


def glb_parts(content):
    n = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + n]), content[28 + n :]


def changed_glb(content, change):
    """A file whose JSON has been changed in place."""
    document, body = glb_parts(content)
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def test_glb_by_hand():
    rest = np.arange(9, dtype=np.float32).reshape(1, 3, 3)
    document, body = glb_parts(GLB.encode(one(quats=[[2.0, 0.0, 0.0, 0.0]], sh_rest=rest), 0))
    (primitive,) = document["meshes"][0]["primitives"]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    assert list(primitive["attributes"])[-1] == "KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"
    assert struct.unpack("<3f", body[:12]) == (-1, 2, 0.5)  # x and y change sign
    assert body[12:16] == bytes([128, 255, 0, 128])
    assert struct.unpack("<4f", body[16:32]) == (0, 0, 0, 1)  # xyzw
    assert struct.unpack("<4f", body[32:48]) == pytest.approx((1, 2, 0.5, 0.5))
    assert struct.unpack("<9f", body[60:]) == (0, -1, -2, 3, 4, 5, -6, -7, -8)  # y and x are odd


def test_glb_signs_are_those_of_the_basis(rng):
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = directions * [-1, -1, 1]
    assert_allclose(sh_basis(turned, 3)[:, 1:], sh_basis(directions, 3)[:, 1:] * glb.SIGNS, atol=CLOSED_FORM)


@pytest.mark.parametrize(("n", "sh_degree"), [(0, 0), (1, 0), (20, 1), (20, 2), (20, 3)])
def test_glb_round_trip(n, sh_degree):
    gaussians = mild(n, sh_degree)
    back = GLB.decode(GLB.encode(gaussians, 0), "file")
    for name in ("means", "sh_dc", "sh_rest"):
        np.testing.assert_array_equal(getattr(back, name), getattr(gaussians, name), err_msg=name)
    assert_allclose(back.log_scales, gaussians.log_scales, atol=4 * ROUNDED_TO_FLOAT32)
    assert_allclose(opacities(back), opacities(gaussians), atol=1e-6)
    assert rotation_error(back.quats, gaussians.quats).max(initial=0) < 1e-6


def test_glb_in_integers():
    """Opacity as normalised bytes, interleaved with what does not matter."""

    def change(document):
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        color = attributes["COLOR_0"]
        document["bufferViews"][color]["byteStride"] = 4
        document["accessors"].append(document["accessors"][color] | {"type": "SCALAR", "byteOffset": 3})
        attributes["KHR_gaussian_splatting:OPACITY"] = len(document["accessors"]) - 1

    gaussians = mild(20, 1)
    back = GLB.decode(changed_glb(GLB.encode(gaussians, 0), change), "file")
    assert_allclose(opacities(back), opacities(gaussians), atol=OPACITY)
    assert np.abs(opacities(back) - opacities(gaussians)).max() > 1e-4


def test_glb_of_flat_gaussians():
    content = GLB.encode(one(), 0)
    _, body = glb_parts(content)
    flat = body[:32] + bytes(4) + body[36:]  # after the position, colour and rotation
    back = GLB.decode(content[: -len(body)] + flat, "file")
    assert_allclose(back.log_scales[0], [math.log(1e-10), math.log(2), math.log(0.5)], rtol=1e-6)


def test_glb_refuses():
    content = GLB.encode(mild(20, 1), 0)

    def refused(change):
        return refusal(GLB, changed_glb(content, change))

    def primitive(document):
        return document["meshes"][0]["primitives"][0]

    assert "truncated" in refusal(GLB, content[:-1]) and "truncated" in refusal(GLB, content[:15])
    assert "not a .glb" in refusal(GLB, b"glTF" + struct.pack("<II", 1, 20) + bytes(20))
    assert "on a moved node" in refused(lambda d: d["nodes"][0].update(rotation=[0, 0, 1, 0]))
    assert "0 primitives" in refused(lambda d: primitive(d).pop("extensions"))
    assert "kernel disc" in refused(
        lambda d: primitive(d)["extensions"]["KHR_gaussian_splatting"].update(kernel="disc")
    )
    assert "ends behind its bytes" in refused(lambda d: d["accessors"][0].update(count=10**12))
    assert "different lengths" in refused(lambda d: d["accessors"][2].update(count=19))
    assert "not those of degree" in refused(lambda d: primitive(d)["attributes"].popitem())
    assert "POSITION cannot be read" in refused(lambda d: primitive(d)["attributes"].update(POSITION=99))
    with pytest.raises(InputError, match="beyond float32"):
        GLB.encode(one(log_scales=[[0.0, 0.0, -200.0]]), 0)


# all of them


@pytest.mark.parametrize("format_", [SPLAT, SOG, COMPRESSED, GLB], ids=lambda f: f.suffix)
def test_damage_is_refused_or_harmless(format_, rng):
    content = encoded(format_, mild(40, 1))
    for cut in rng.integers(0, len(content), 30):
        try:
            format_.decode(content[:cut], "lie.bin")
        except InputError as error:
            assert str(error).startswith("lie.bin") and "\n" not in str(error)
    for place in rng.integers(0, len(content), 150):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        try:
            back = format_.decode(bytes(damaged), "lie.bin")
            format_.describe(bytes(damaged), "lie.bin")
        except InputError as error:
            assert str(error).startswith("lie.bin") and "\n" not in str(error)
        else:
            assert all(np.isfinite(field).all() for field in back)


def test_the_command_line_knows_them(tmp_path, capfd):
    save_ply(tmp_path / "a.ply", mild(30, 1))
    (tmp_path / "b.ksplat").write_bytes(write_ksplat(mild(30, 1), 1))
    for name in ("a.splat", "a.sog", "a.compressed.ply", "a.glb"):
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / name)]) == 0
        assert find_format(tmp_path / name) is not None
    for name in ("a.splat", "a.sog", "a.compressed.ply", "a.glb", "b.ksplat"):
        capfd.readouterr()
        assert main(["info", str(tmp_path / name)]) == 0
        assert "30" in capfd.readouterr().out
        assert main(["convert", str(tmp_path / name), str(tmp_path / "back.ply")]) == 0
        assert len(load_ply(tmp_path / "back.ply").means) == 30
    line = refused_line(capfd, tmp_path, "convert", tmp_path / "a.ply", tmp_path / "a.ksplat")
    assert "a .ksplat is read, but not written" in line
