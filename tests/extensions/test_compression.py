"""Compact files: bounds that hold for every number, bytes that stay the same, and damaged files."""

import json
import struct
import sys

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal

from compact import (
    check_damage,
    check_headers,
    population,
    refusal,
    rotation_error,
    with_header,
)
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.compression import lattice, levels, msz
from minisplat_ref.io.formats import spz
from minisplat_ref.io.packing import container as container
from minisplat_ref.io.packing.morton import morton_order
from minisplat_ref.types import Gaussians
from tolerances import CLOSED_FORM, QUATERNION_FLOAT32

LEVELS = range(levels.N_LEVELS)


def float32(low, high):
    return st.floats(low, high, width=32)


@st.composite
def populations(draw):
    """Draw Gaussians of any values that a lattice reaches, N from 0 to 7, of degree 0 to 3."""
    n, degree = draw(st.integers(0, 7)), draw(st.integers(0, 3))
    shapes = {
        "means": ((n, 3), float32(-(2.0**13), 2.0**13)),
        "quats": ((n, 4), float32(-(2.0**10), 2.0**10)),
        "log_scales": ((n, 3), float32(-16, 8)),
        "opacity_logits": ((n,), float32(-64, 64)),
        "sh_dc": ((n, 3), float32(-32, 32)),
        "sh_rest": ((n, (degree + 1) ** 2 - 1, 3), float32(-32, 32)),
    }
    fields = {name: draw(hnp.arrays(np.float32, shape, elements=of)) for name, (shape, of) in shapes.items()}
    assume(fields["quats"].any(axis=1).all())
    return Gaussians(**fields)


# The lattice


@given(
    hnp.arrays(np.float32, st.integers(1, 9), elements=st.floats(width=32, allow_nan=False, allow_infinity=False)),
    st.integers(-30, 30),
)
def test_lattice_bound_holds_to_the_last_bit(values, exponent):
    assume(np.abs(values).max() <= 2.0**52 * 2.0**exponent)
    integers = lattice.to_lattice(values, exponent, "values")
    back = lattice.from_lattice(integers, exponent)
    assert (np.abs(back.astype(np.float64) - values.astype(np.float64)) <= 2.0 ** (exponent - 1)).all()
    assert_array_equal(lattice.to_lattice(back, exponent, "values"), integers)


def test_lattice_out_of_reach():
    with pytest.raises(InputError, match=r"means reach 1e\+30, too far for steps of 2\^-5: .*--level 0"):
        lattice.to_lattice(np.array([1e30], np.float32), -5, "means")


@given(hnp.arrays(np.float32, (4, 4), elements=float32(-2.0, 2.0)), st.integers(-12, -6))
def test_rotations_stay_within_their_angle(quats, exponent):
    assume(quats.any(axis=1).all())
    rotations = lattice.to_rotations(quats, exponent)
    back = lattice.from_rotations(rotations, exponent)
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (quats.astype(np.float64), back.astype(np.float64)))
    distance = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    angles = 4 * np.arcsin(distance / 2)  # a chord of the sphere of quaternions, whose angle is half the rotation's
    assert (angles <= lattice.rotation_bound(exponent) * (1 + CLOSED_FORM) + CLOSED_FORM).all()
    again = lattice.to_rotations(back, exponent)
    assert_array_equal(again.largest, rotations.largest)
    assert_array_equal(again.others, rotations.others)


def test_ties_of_the_largest_component():
    """If all components are alike, or one rounds up to the largest, the first becomes 1 and is positive."""
    quats = np.array([[-1, 1, 1, -1], [0.9999, -1.0, 0, 0]], np.float32)
    rotations = lattice.to_rotations(quats, -6)
    assert rotations.largest.tolist() == [0, 0]
    assert rotations.others.tolist() == [[-64, -64, 64], [-64, 0, 0]]


# .msz


@settings(max_examples=40, deadline=None)
@given(populations(), st.sampled_from(LEVELS))
def test_msz_bound_and_same_bytes(gaussians, level):
    """Every number is within its bound, and the second encoding equals the first."""
    content = msz.encode(gaussians, level)
    back = msz.decode(content, "file")
    assert msz.encode(back, level) == content
    assert all(field.dtype == np.float32 for field in back)
    if level == 0:
        order = morton_order(gaussians.means)
        for field, decoded in zip(gaussians, back, strict=True):
            assert field[order].tobytes() == decoded.tobytes()
        return
    header = json.loads(content[10 : 10 + struct.unpack("<I", content[6:10])[0]])
    bounds = {name: 2.0 ** (exponent - 1) for name, exponent in header["steps"].items()}
    rows = matching_rows(gaussians, back, bounds["means"])
    for name, bound in bounds.items():
        original, decoded = getattr(gaussians, name)[rows], getattr(back, name)
        if name == "quats":
            error = rotation_error(original, decoded)
            assert (error <= lattice.rotation_bound(header["steps"]["quats"]) + QUATERNION_FLOAT32).all()
        else:
            assert (np.abs(original.astype(np.float64) - decoded) <= bound).all(), name


def matching_rows(gaussians, back, bound):
    """Return the row of each decoded Gaussian, by the order of the centres' lattice points, which is defined."""
    order = morton_order(np.rint(gaussians.means.astype(np.float64) / (2 * bound)))
    assert sorted(order.tolist()) == list(range(len(back.means)))
    return order


def test_a_gaussian_of_the_finest_level_by_hand():
    """Steps of 2^-8 for log scales and 2^-6 for the logit, 2^-8 and 2^-9 for the colour, 2^-10 for the quaternion.

    The middle deviation is e^-1.3, in which 2^-2 is the largest power of two, so centres have steps of 2^-9.
    """
    one = Gaussians(
        means=np.array([[0.7, -0.7, 0.0]]),
        quats=np.array([[1.0, 0.3, -0.3, 0.0]]),
        log_scales=np.array([[-1.3, -5.0, 0.01]]),
        opacity_logits=np.array([0.4]),
        sh_dc=np.array([[0.3, -0.3, 0.001]]),
        sh_rest=np.full((1, 3, 3), 0.1),
    )
    back = msz.decode(msz.encode(Gaussians(*(field.astype(np.float32) for field in one)), 1), "file")
    expected = Gaussians(
        np.array([[358, -358, 0]]) / 512,
        np.array([[1024, 307, -307, 0]]) / 1024,
        np.array([[-333, -1280, 3]]) / 256,
        np.array([26]) / 64,
        np.array([[77, -77, 0]]) / 256,
        np.full((1, 3, 3), 51) / 512,
    )
    for name, field in back._asdict().items():
        assert_array_equal(field, getattr(expected, name).astype(np.float32), err_msg=name)


def test_levels_drop_a_bit_of_geometry_and_of_colour_in_turn():
    assert levels.exponents(2) == (-6, -9, -7, -6, -8, -9)
    assert levels.exponents(3) == (-6, -9, -7, -5, -7, -8)
    assert levels.exponents(12) == (-1, -4, -2, -1, -3, -4)


@pytest.mark.parametrize("sh_degree", range(4))
def test_msz_becomes_smaller_level_by_level(sh_degree):
    sizes = [len(msz.encode(population(2000, sh_degree), level)) for level in LEVELS]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.5 * sizes[1]


def test_msz_step_of_centres_follows_the_scene():
    """A scene eight times as large has the same integers, because eight is a power of two."""
    gaussians = population()
    larger = gaussians._replace(means=8 * gaussians.means, log_scales=gaussians.log_scales + np.float32(np.log(8.0)))
    steps = [msz._check_header(container.parse(msz.CONTAINER, msz.encode(g, 6), "")).steps for g in (gaussians, larger)]
    assert steps[1].means - steps[0].means in (2, 3, 4)  # log scales are rounded, too
    assert steps[0].means < np.log2(np.exp(gaussians.log_scales).min())


def test_small_gaussians_decide_and_thin_ones_do_not():
    """With middle axes of e^-3 (a tenth and more) and of 1, the size is 2^-5, the last power below e^-3 = 0.0498."""
    log_scales = np.full((40, 3), 0.0)
    log_scales[:6] = [-9.0, -3.0, 2.0]
    integers = lattice.to_lattice(log_scales, -8, "log_scales")
    assert levels.size_exponent(integers, -8) == -5
    log_scales[:6] = 0.0
    log_scales[:, 1] = -9.0
    assert levels.size_exponent(lattice.to_lattice(log_scales, -8, "log_scales"), -8) == 0
    assert levels.size_exponent(np.full((3, 3), -(10**6)), 0) == -100


def test_msz_of_float64_is_that_of_float32():
    doubled = Gaussians(*(field.astype(np.float64) for field in population()))
    assert msz.encode(doubled, 3) == msz.encode(population(), 3)


def test_msz_refuses_nan():
    gaussians = population()
    gaussians.sh_dc[3, 1] = np.nan
    with pytest.raises(InputError, match=r"sh_dc is nan at index \[3, 1\]"):
        msz.encode(gaussians, 4)


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_round_trip_of_no_gaussians(format_):
    for level in range(len(format_.levels)):
        back = format_.decode(format_.encode(population(0), level), "file")
        assert len(back.means) == 0 and back.sh_rest.shape == (0, 15, 3)


# Damaged files


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_truncated_anywhere(format_):
    content = format_.encode(population(20), 0)
    for length in [0, 1, 5, 9, 15, 40, len(content) // 2, len(content) - 9, len(content) - 1]:
        refusal(format_, content[:length])


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_damaged_anywhere(format_, rng):
    check_damage(format_, format_.encode(population(20), format_.default_level), rng, 300)


def test_headers_that_lie_at_random(rng):
    check_headers(msz.MSZ, msz.encode(population(7, 1), 5), rng, 300)
    header = msz._check_header(container.parse(msz.CONTAINER, msz.encode(population(7, 1), 5), ""))
    steps = header.steps._replace(log_scales=55)._asdict()  # once an overflow
    assert "which steps" in refusal(msz.MSZ, with_header(msz.encode(population(), 3), steps=steps))


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_foreign_files(format_):
    assert "not a" in refusal(format_, b"ply\nformat ascii 1.0\n" * 5)
    assert refusal(format_, b"")
    assert refusal(format_, spz.encode(population(), 0) if format_ is msz.MSZ else msz.encode(population(), 0))


def test_msz_of_another_version():
    content = msz.encode(population(), 3)
    assert "MSZ of version 7" in refusal(msz.MSZ, content[:4] + struct.pack("<H", 7) + content[6:])


def test_msz_that_claims_too_much():
    content = msz.encode(population(), 3)
    assert "would take" in refusal(msz.MSZ, with_header(content, n=2**31 - 1))
    assert "n 2147483648" in refusal(msz.MSZ, with_header(content, n=2**31))
    assert "n -1" in refusal(msz.MSZ, with_header(content, n=-1))
    assert "n True" in refusal(msz.MSZ, with_header(content, n=True))
    assert "header would have" in refusal(msz.MSZ, content[:6] + struct.pack("<I", 2**31) + content[10:])
    assert "do not have" in refusal(msz.MSZ, with_header(content, n=41))
    assert "sh_degree 4" in refusal(msz.MSZ, with_header(content, sh_degree=4))
    assert "which steps" in refusal(msz.MSZ, with_header(content, steps={"means": 1}))
    assert "how many planes" in refusal(msz.MSZ, with_header(content, planes={"means": 9}))
    assert "list its streams" in refusal(msz.MSZ, with_header(content, streams=[["means"]]))
    assert "bytes expected" in refusal(msz.MSZ, with_header(content, streams=[["means", 2**40]]))
    assert "nested too deeply" in refusal(msz.MSZ, deep(content))


def deep(content):
    text = b"[" * 60_000
    return content[:6] + struct.pack("<I", len(text)) + text + content[10:]


def test_missing_packer_names_the_extra(monkeypatch):
    content = msz.encode(population(), 3)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for call in (lambda: msz.encode(population(), 3), lambda: msz.decode(content, "file")):
        with pytest.raises(InputError, match=r"pip install 'minisplat_ref\[compression\]'"):
            call()
