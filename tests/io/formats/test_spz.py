"""SPZ: bytes worked out by hand, axes, and a file of another program."""

import gzip
import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose

from compact import population, refusal, rotation_error
from minisplat_ref import load_ply
from minisplat_ref.errors import InputError
from minisplat_ref.io.formats import spz
from minisplat_ref.types import Gaussians
from tolerances import ROUNDED_TO_FLOAT32


def spz_raw(gaussians, level=0):
    return gzip.decompress(spz.encode(gaussians, level))


def test_spz_by_hand():
    """The bytes of one Gaussian are those worked out with a pencil."""
    gaussians = Gaussians(
        means=np.array([[1.0, -2.0, 0.5]], np.float32),
        quats=np.array([[2.0, 0.0, 0.0, 0.0]], np.float32),
        log_scales=np.array([[-10.0, -6.0, 7.0]], np.float32),
        opacity_logits=np.array([0.0], np.float32),
        sh_dc=np.array([[0.0, 2.0, -9.0]], np.float32),
        sh_rest=np.array([[[0.25, 0.0, -0.25], [0.0, 0.0, 0.0], [0.02, 0.04, 0.0]]], np.float32),
    )
    raw = spz_raw(gaussians)
    assert raw[:16] == b"NGSP" + bytes([3, 0, 0, 0, 1, 0, 0, 0, 1, 12, 0, 0])
    assert raw[16:25] == bytes([0, 16, 0, 0, 32, 0, 0, 248, 255])  # 4096, 8192 and -2048: y and z change sign
    assert raw[25:26] == bytes([128])  # 127.5 rounds up
    assert raw[26:29] == bytes([128, 204, 0])  # 127.5, 255 (0.3 + 0.5), below the range
    assert raw[29:32] == bytes([0, 64, 255])
    assert raw[32:36] == bytes([0, 0, 0, 0b11000000])  # w, the last of x, y, z, w, is largest
    assert raw[36:] == bytes([96, 128, 160, 128, 128, 128, 128, 136, 128])  # -32, 32; 3 and 5
    raw = spz_raw(gaussians._replace(quats=np.array([[-1.0, 0.0, 1.0, 0.0]], np.float32)), 2)
    assert raw[4] == 2 and raw[32:35] == bytes([128, 218, 128])  # -w, so y changes sign twice: 127.5 (1 + 0.7071)


@pytest.mark.parametrize("level", [0, 2])
@pytest.mark.parametrize("sh_degree", range(4))
def test_spz_round_trip(level, sh_degree, rng):
    gaussians = population(200, sh_degree)
    gaussians = gaussians._replace(sh_rest=np.clip(gaussians.sh_rest, -0.9, 0.9), sh_dc=0.5 * gaussians.sh_dc)
    content = spz.encode(gaussians, level)
    back = spz.decode(content, "file")
    assert_allclose(back.means, gaussians.means, rtol=0, atol=2.0**-13)
    assert_allclose(back.log_scales, gaussians.log_scales, rtol=0, atol=1 / 32 + ROUNDED_TO_FLOAT32)
    opacities = [1 / (1 + np.exp(-g.opacity_logits)) for g in (gaussians, back)]
    assert_allclose(*opacities, rtol=0, atol=0.5 / 255 + ROUNDED_TO_FLOAT32)
    assert_allclose(back.sh_dc, gaussians.sh_dc, rtol=0, atol=0.5 / 255 / 0.15 + ROUNDED_TO_FLOAT32)
    assert np.abs(back.sh_rest - gaussians.sh_rest)[:, :3].max(initial=0) <= 4.5 / 128  # rounded twice
    assert np.abs(back.sh_rest - gaussians.sh_rest).max(initial=0) <= 8.5 / 128
    # Version 3: each component within half of sqrt(1/2)/511; version 2 within 1/255, and w by what is left.
    # Version 2 has the worst where w is near zero: w = sqrt(1 - x^2 - y^2 - z^2) is uncertain by sqrt(2 sqrt(3) / 255).
    angle = rotation_error(gaussians.quats, back.quats).max()
    assert angle < (0.005 if level == 0 else 0.24)
    assert spz.encode(back, level) == content


@pytest.mark.parametrize("sh_degree", range(4))
def test_spz_version_4_holds_what_version_3_does(sh_degree):
    third, fourth = (spz.encode(population(50, sh_degree), level) for level in (0, 1))
    assert fourth[:16] == b"NGSP" + bytes([4, 0, 0, 0, 50, 0, 0, 0, sh_degree, 12, 0, 6])
    assert struct.unpack("<I", fourth[16:20]) == (32,)
    assert struct.unpack("<QQ", fourth[32:48])[1] == 50 * 9
    for value, other in zip(spz.decode(fourth, "fourth"), spz.decode(third, "third"), strict=True):
        np.testing.assert_array_equal(value, other)
    assert spz.SPZ.describe(fourth, "fourth")[0] == ("SPZ version", "4")


def test_spz_of_another_program(shared_data):
    """Another program has written three trained Gaussians as PLY and as SPZ of version 3."""
    ply = load_ply(shared_data / "ply" / "metalsplatter_train_3points.ply")
    path = shared_data / "ply" / "metalsplatter_train_3points.spz"
    theirs = spz.decode(path.read_bytes(), path)
    assert_allclose(theirs.means, ply.means, rtol=0, atol=2.0**-13)
    assert_allclose(theirs.log_scales, ply.log_scales, rtol=0, atol=1 / 32)
    assert_allclose(theirs.sh_dc, ply.sh_dc, rtol=0, atol=0.5 / 255 / 0.15 + ROUNDED_TO_FLOAT32)
    assert_allclose(theirs.sh_rest, ply.sh_rest, rtol=0, atol=8.5 / 128)
    assert rotation_error(ply.quats, theirs.quats).max() < 0.005
    assert np.abs(theirs.sh_rest).max() > 0  # the harmonics' order and signs are seen
    assert spz_raw(ply) == gzip.decompress(path.read_bytes())  # byte for byte what they have written


def test_spz_has_as_many_fractional_bits_as_reach_the_farthest():
    gaussians = population(3, 0)
    for distance, bits in ((2047.99, 12), (2048, 11), (4095.99, 11), (5000, 10)):
        gaussians.means[1] = [distance, 0, 0]
        assert spz_raw(gaussians)[13] == bits
        means = spz.decode(spz.encode(gaussians, 0), "file").means
        assert_allclose(means, gaussians.means, rtol=0, atol=2.0 ** (-bits - 1))
    gaussians.means[1] = [1e6, 0, 0]
    with pytest.raises(InputError, match=r"centre of row 1 is 1e\+06 away, where SPZ has steps of 0\.125"):
        spz.encode(gaussians, 0)


def test_spz_opacities_of_0_and_1_are_finite():
    gaussians = population(2, 0)._replace(opacity_logits=np.array([-90, 90], np.float32))
    content = spz.encode(gaussians, 0)
    back = spz.decode(content, "file")
    assert_allclose(1 / (1 + np.exp(-back.opacity_logits)), [0.25 / 255, 254.75 / 255], rtol=ROUNDED_TO_FLOAT32)
    assert spz.encode(back, 0) == content


def spz_of(version=3, n=2**31 - 1, degree=3, bits=12, body=b""):
    return gzip.compress(struct.pack("<IIIBBBB", spz.MAGIC, version, n, degree, bits, 0, 0) + body)


def test_spz_that_claims_too_much():
    assert "2,147,483,647 Gaussians cannot be" in refusal(spz.SPZ, spz_of())
    assert "version 1" in refusal(spz.SPZ, spz_of(version=1))
    assert "version 5" in refusal(spz.SPZ, struct.pack("<III", spz.MAGIC, 5, 1) + bytes(40))
    assert "degree 9" in refusal(spz.SPZ, spz_of(degree=9))
    assert "24 fractional bits" in refusal(spz.SPZ, spz_of(bits=24))
    assert "truncated, 211 bytes and their end expected, 46 found" in refusal(spz.SPZ, spz_of(n=3, body=bytes(30)))
    assert "NGSP" in refusal(spz.SPZ, gzip.compress(bytes(50)))
