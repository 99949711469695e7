"""Compact files: bounds that hold for every number, bytes that stay the same, and files that lie."""

import gzip
import json
import shutil
import struct
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from scenes import make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_IMAGE, QUATERNION_FLOAT32, ROUNDED_TO_FLOAT32, SPZ_ROTATION

from minisplat_ref import load_ply, save_ply
from minisplat_ref.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.experiments import conversion
from minisplat_ref.extensions import extension as extension_module
from minisplat_ref.extensions import shared_container as container
from minisplat_ref.extensions.compression import lattice, levels, msz, spz
from minisplat_ref.extensions.compression import study as rate_distortion
from minisplat_ref.extensions.extension import Extension, find_format, load_extension
from minisplat_ref.extensions.shared_morton import morton_codes, morton_order
from minisplat_ref.extensions.shared_planes import from_planes, to_planes, unzigzag, zigzag
from minisplat_ref.io import load_scene
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.types import Gaussians, Model, view_from

LEVELS = range(levels.N_LEVELS)
FEW_BYTES = 2_000_000  # that a refusal may take, whatever the file claims


def float32(low, high):
    return st.floats(low, high, width=32)


@st.composite
def populations(draw):
    """Gaussians of any values that a lattice reaches, N from 0 to 7, degree 0 to 3."""
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


def population(n=40, sh_degree=3, seed=0):
    gaussians = make_gaussians(np.random.default_rng(seed), n, sh_degree=sh_degree)
    return Gaussians(*(field.astype(np.float32) for field in gaussians))


def over_largest(quats):
    """Quaternions over their largest components, in float64."""
    quats = quats.astype(np.float64)
    largest = np.take_along_axis(quats, np.argmax(np.abs(quats), axis=1)[:, None], axis=1)
    return quats / largest


# Morton order and planes of bytes


def test_morton_codes_are_bits_in_turn(rng):
    cells = rng.integers(0, 2**21, size=(50, 3), dtype=np.uint64)
    cells[:4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [2**21 - 1] * 3]
    expected = [sum((int(x[a]) >> b & 1) << (3 * b + a) for b in range(21) for a in range(3)) for x in cells]
    assert expected[:4] == [1, 2, 4, 2**63 - 1]
    assert morton_codes(cells).tolist() == expected


def test_morton_order_walks_an_octree(rng):
    """The eight corners of a cube, x fastest; equal points stay as they follow each other."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], np.float64)
    shuffled = rng.permutation(8)
    assert_array_equal(corners[shuffled][morton_order(corners[shuffled])], corners)
    assert_array_equal(morton_order(np.ones((5, 3))), np.arange(5))
    assert morton_order(np.zeros((0, 3))).shape == (0,)


def test_morton_neighbours_are_near(rng):
    points = rng.uniform(size=(2000, 3))

    def step(p):
        return np.linalg.norm(np.diff(p, axis=0), axis=1).mean()

    assert step(points[morton_order(points)]) < 0.2 * step(points)


@given(hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.integers(0, 4)), elements=st.integers(-(2**63), 2**63 - 1)))
def test_planes_there_and_back(values):
    raw, n_planes = to_planes(zigzag(values))
    assert_array_equal(unzigzag(from_planes(raw, n_planes, values.shape[1], len(values))), values)
    assert len(raw) == n_planes * values.size


def test_zigzag_keeps_small_numbers_small():
    assert zigzag(np.array([0, -1, 1, -2, 2])).tolist() == [0, 1, 2, 3, 4]
    assert to_planes(zigzag(np.array([[-128, 127]])))[1] == 1
    assert to_planes(zigzag(np.array([[-129, 0]])))[1] == 2


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
    """All components alike, and one that rounds up to the largest: the first is the one, and positive."""
    quats = np.array([[-1, 1, 1, -1], [0.9999, -1.0, 0, 0]], np.float32)
    rotations = lattice.to_rotations(quats, -6)
    assert rotations.largest.tolist() == [0, 0]
    assert rotations.others.tolist() == [[-64, -64, 64], [-64, 0, 0]]


# .msz


@settings(max_examples=40, deadline=None)
@given(populations(), st.sampled_from(LEVELS))
def test_msz_bound_and_same_bytes(gaussians, level):
    """Every number within its bound, and the second encoding is the first."""
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
    """The row of each decoded one: by the order of the centres' lattice points, which the format promises."""
    order = morton_order(np.rint(gaussians.means.astype(np.float64) / (2 * bound)))
    assert sorted(order.tolist()) == list(range(len(back.means)))
    return order


def rotation_error(quats, others):
    a, b = (q / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (quats, others))
    distance = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(distance / 2)


@pytest.mark.parametrize("sh_degree", range(4))
def test_msz_becomes_smaller_level_by_level(sh_degree):
    sizes = [len(msz.encode(population(2000, sh_degree), level)) for level in LEVELS]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.5 * sizes[1]


def test_msz_step_of_centres_follows_the_scene():
    """A scene ten times as large, in other units, has the same integers if ten were a power of two: take eight."""
    gaussians = population()
    larger = gaussians._replace(means=8 * gaussians.means, log_scales=gaussians.log_scales + np.float32(np.log(8.0)))
    steps = [msz._checked(container.take_apart(msz.CONTAINER, msz.encode(g, 6), "")).steps for g in (gaussians, larger)]
    assert steps[1].means - steps[0].means in (2, 3, 4)  # log scales are rounded, too
    assert steps[0].means < np.log2(np.exp(gaussians.log_scales).min())


def test_small_gaussians_decide_and_thin_ones_do_not():
    """Middle axes of e^-3 (a tenth and more) and of 1: 2^-5 is the last power of two below e^-3 = 0.0498."""
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


# .spz


def spz_raw(gaussians, level=0):
    return gzip.decompress(spz.encode(gaussians, level))


def test_spz_by_hand():
    """One Gaussian whose bytes can be worked out with a pencil."""
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
    raw = spz_raw(gaussians._replace(quats=np.array([[-1.0, 0.0, 1.0, 0.0]], np.float32)), 1)
    assert raw[4] == 2 and raw[32:35] == bytes([128, 218, 128])  # -w, so y changes sign twice: 127.5 (1 + 0.7071)


def test_spz_signs_are_those_of_the_basis(rng):
    """Half a turn around x: each harmonic of the turned direction is plus or minus that of the direction."""
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = directions * [1, -1, -1]
    assert_allclose(sh_basis(turned, 3)[:, 1:], sh_basis(directions, 3)[:, 1:] * spz.SIGNS, atol=CLOSED_FORM)


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("sh_degree", range(4))
def test_spz_there_and_back(level, sh_degree, rng):
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


def test_spz_of_another_program(shared_data):
    """Three trained Gaussians as PLY and as SPZ of version 3, both by others."""
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


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 1])
def test_another_program_reads_our_spz(level, tmp_path):
    """PlayCanvas' splat-transform, of npm, where it is on the PATH: axes, harmonics and rotations, not only bytes."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("no splat-transform on the PATH: npm install @playcanvas/splat-transform")
    ours = tmp_path / "ours.spz"
    ours.write_bytes(spz.encode(population(200), level))
    subprocess.run([program, "-g", "cpu", ours, tmp_path / "theirs.ply"], check=True, capture_output=True)
    back, theirs = spz.decode(ours.read_bytes(), ours), load_ply(tmp_path / "theirs.ply")
    for name in ("means", "log_scales", "opacity_logits", "sh_dc", "sh_rest"):
        assert_allclose(getattr(theirs, name), getattr(back, name), rtol=0, atol=10 * ROUNDED_TO_FLOAT32, err_msg=name)
    assert rotation_error(theirs.quats, back.quats).max() < SPZ_ROTATION


def test_spz_reaches_2048():
    gaussians = population(3, 0)
    gaussians.means[1] = [2047.99, 0, 0]
    assert np.isfinite(spz.decode(spz.encode(gaussians, 0), "file").means).all()
    gaussians.means[1] = [2048, 0, 0]
    with pytest.raises(InputError, match=r"centre of row 1 is 2048 away, and SPZ reaches 2048 \(1 of 3 are too far\)"):
        spz.encode(gaussians, 0)


def test_spz_opacities_of_0_and_1_are_finite():
    gaussians = population(2, 0)._replace(opacity_logits=np.array([-90, 90], np.float32))
    content = spz.encode(gaussians, 0)
    back = spz.decode(content, "file")
    assert_allclose(1 / (1 + np.exp(-back.opacity_logits)), [0.25 / 255, 254.75 / 255], rtol=ROUNDED_TO_FLOAT32)
    assert spz.encode(back, 0) == content


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_nothing_there_and_back(format_):
    for level in range(len(format_.levels)):
        back = format_.decode(format_.encode(population(0), level), "file")
        assert len(back.means) == 0 and back.sh_rest.shape == (0, 15, 3)


# Files that lie


@pytest.fixture
def refused(monkeypatch):
    """Decode what must be refused in one line that names the file, with hardly any memory; return the line."""

    def run(format_, content):
        tracemalloc.start()
        try:
            with pytest.raises(InputError) as caught:
                format_.decode(content, "lie.bin")
            assert tracemalloc.get_traced_memory()[1] < FEW_BYTES
        finally:
            tracemalloc.stop()
        assert str(caught.value).startswith("lie.bin")
        return str(caught.value)

    return run


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_truncated_anywhere(format_, refused):
    content = format_.encode(population(20), 0)
    for length in [0, 1, 5, 9, 15, 40, len(content) // 2, len(content) - 9, len(content) - 1]:
        refused(format_, content[:length])


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_damaged_anywhere(format_, rng):
    """A changed byte is refused by a checksum or a check; what is not seen decodes to Gaussians all the same."""
    content = format_.encode(population(20), format_.default_level)
    n_refused = 0
    for place in rng.integers(0, len(content), size=300):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        try:
            back = format_.decode(bytes(damaged), "lie.bin")
        except InputError:
            n_refused += 1
        else:
            assert all(np.isfinite(field).all() for field in back)
    assert n_refused > 250


@pytest.mark.parametrize("format_", [msz.MSZ, spz.SPZ], ids=lambda f: f.suffix)
def test_foreign_files(format_, refused):
    assert "not a" in refused(format_, b"ply\nformat ascii 1.0\n" * 5)
    assert refused(format_, b"")
    assert refused(format_, spz.encode(population(), 0) if format_ is msz.MSZ else msz.encode(population(), 0))


def with_header(content, **changes):
    """An .msz whose header says something else."""
    length = struct.unpack("<I", content[6:10])[0]
    header = json.loads(content[10 : 10 + length]) | changes
    text = json.dumps(header).encode()
    return content[:6] + struct.pack("<I", len(text)) + text + content[10 + length :]


def test_msz_of_another_version(refused):
    content = msz.encode(population(), 3)
    assert "MSZ of version 7" in refused(msz.MSZ, content[:4] + struct.pack("<H", 7) + content[6:])


def test_msz_that_claims_too_much(refused):
    content = msz.encode(population(), 3)
    assert "would take" in refused(msz.MSZ, with_header(content, n=2**31 - 1))
    assert "n 2147483648" in refused(msz.MSZ, with_header(content, n=2**31))
    assert "n -1" in refused(msz.MSZ, with_header(content, n=-1))
    assert "n True" in refused(msz.MSZ, with_header(content, n=True))
    assert "header would have" in refused(msz.MSZ, content[:6] + struct.pack("<I", 2**31) + content[10:])
    assert "do not have" in refused(msz.MSZ, with_header(content, n=41))
    assert "sh_degree 4" in refused(msz.MSZ, with_header(content, sh_degree=4))
    assert "which steps" in refused(msz.MSZ, with_header(content, steps={"means": 1}))
    assert "how many planes" in refused(msz.MSZ, with_header(content, planes={"means": 9}))
    assert "list its streams" in refused(msz.MSZ, with_header(content, streams=[["means"]]))
    assert "bytes expected" in refused(msz.MSZ, with_header(content, streams=[["means", 2**40]]))
    assert "nested too deeply" in refused(msz.MSZ, deep(content))


def deep(content):
    text = b"[" * 60_000
    return content[:6] + struct.pack("<I", len(text)) + text + content[10:]


def spz_of(version=3, n=2**31 - 1, degree=3, bits=12, body=b""):
    return gzip.compress(struct.pack("<IIIBBBB", spz.MAGIC, version, n, degree, bits, 0, 0) + body)


def test_spz_that_claims_too_much(refused):
    assert "2,147,483,647 Gaussians cannot be" in refused(spz.SPZ, spz_of())
    assert "version 1" in refused(spz.SPZ, spz_of(version=1))
    assert "version 4" in refused(spz.SPZ, struct.pack("<III", spz.MAGIC, 4, 1) + bytes(40))
    assert "degree 9" in refused(spz.SPZ, spz_of(degree=9))
    assert "24 fractional bits" in refused(spz.SPZ, spz_of(bits=24))
    assert "truncated, 211 bytes and their end expected, 46 found" in refused(spz.SPZ, spz_of(n=3, body=bytes(30)))
    assert "NGSP" in refused(spz.SPZ, gzip.compress(bytes(50)))


def test_missing_packer_names_the_extra(monkeypatch):
    content = msz.encode(population(), 3)
    monkeypatch.setitem(sys.modules, "zstandard", None)
    for call in (lambda: msz.encode(population(), 3), lambda: msz.decode(content, "file")):
        with pytest.raises(InputError, match=r"pip install 'minisplat_ref\[compression\]'"):
            call()


# The choice of a level


def test_finest_that_fits_and_coarsest_that_is_good_enough():
    gaussians = population(300)
    sizes = [len(msz.encode(gaussians, level)) for level in LEVELS]
    choice = conversion.finest_within(gaussians, msz.MSZ, sizes[4])
    assert choice.level == 4 and len(choice.content) == sizes[4]
    assert conversion.finest_within(gaussians, msz.MSZ, sizes[4] - 1).level == 5
    with pytest.raises(InputError, match=r"no level of \.msz fits 10 bytes, the coarsest takes"):
        conversion.finest_within(gaussians, msz.MSZ, 10)

    def psnr_of(given):
        """Falls with the error of the colours, which is smaller at every finer level."""
        return 30.0 - 100 * np.abs(np.sort(given.sh_dc, axis=0) - np.sort(gaussians.sh_dc, axis=0)).max()

    drops = [30 - psnr_of(msz.decode(msz.encode(gaussians, level), "")) for level in LEVELS]
    for allowed in (0.2, 1.0, 4.0):
        choice = conversion.coarsest_within(gaussians, msz.MSZ, allowed, psnr_of)
        assert choice.level == max(level for level in LEVELS if drops[level] <= allowed)
        assert choice.drop == drops[choice.level]
    assert len({conversion.coarsest_within(gaussians, msz.MSZ, a, psnr_of).level for a in (0.2, 1.0, 4.0)}) == 3
    with pytest.raises(InputError, match=r"every level of \.spz loses more than 0 dB"):
        conversion.coarsest_within(gaussians, spz.SPZ, 0.0, psnr_of)


# Formats are found by their suffixes


def test_formats_are_found(monkeypatch):
    assert find_format("a/b.MSZ") is msz.MSZ and find_format("b.spz") is spz.SPZ
    assert find_format("b.ply") is None and find_format("b.xyz") is None
    ours = load_extension("compression")
    monkeypatch.setattr(extension_module, "load_extensions", lambda: [ours, Extension("other", formats=(msz.MSZ,))])
    with pytest.raises(InputError, match=r"\.msz is a format of the extensions compression and other"):
        find_format("b.msz")


def test_a_ply_loads_no_extension(monkeypatch):
    monkeypatch.setattr(extension_module, "load_extensions", lambda: pytest.fail("loaded"))
    assert find_format("b.ply") is None


# The command line


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short training; tests do not change it but for its evaluations."""
    root = tmp_path_factory.mktemp("compression")
    scene = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
    write_scene(make_scene("room", supersampling=1, **scene), root / "nook", scene)
    options = ["--recipe", "3dgs-accel", "--iterations", "30", "--test-every", "4", "--out", str(root / "run")]
    assert main(["train", str(root / "nook"), *options]) == 0
    return root / "run"


@pytest.fixture
def one_line(capfd, tmp_path):
    def call(*arguments):
        capfd.readouterr()
        before = sorted(tmp_path.rglob("*"))
        assert main([str(argument) for argument in arguments]) == 2
        captured = capfd.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1, captured.err
        assert sorted(tmp_path.rglob("*")) == before
        return captured.err

    return call


def convert(*arguments):
    assert main(["convert", *map(str, arguments)]) == 0


def test_there_and_back_on_the_command_line(run, tmp_path, capsys):
    original = load_ply(run / "point_cloud.ply")
    convert(run, tmp_path / "a.msz", "--level", "0")
    convert(tmp_path / "a.msz", tmp_path / "a.ply")
    back, order = load_ply(tmp_path / "a.ply"), morton_order(original.means)
    for field, decoded in zip(original, back, strict=True):
        assert_array_equal(field[order], decoded)
    convert(run / "checkpoint.npz", tmp_path / "b.msz", "--level", "0")
    assert (tmp_path / "a.msz").read_bytes() == (tmp_path / "b.msz").read_bytes()
    capsys.readouterr()
    convert(tmp_path / "a.ply", tmp_path / "c.spz")
    out = capsys.readouterr().out
    assert "60 Gaussians of a.ply in" in out and "SPZ version: 3" in out
    convert(tmp_path / "c.spz", tmp_path / "d.msz")
    out = capsys.readouterr().out
    assert "level: 5 of 12" in out and "scales: within 0.78 %" in out and "world units along each axis" in out
    assert f"{(tmp_path / 'd.msz').stat().st_size:,} bytes" in out


def test_sizes_and_drops_on_the_command_line(run, tmp_path, one_line, capfd):
    sizes = [len(msz.encode(load_ply(run / "point_cloud.ply"), level)) for level in LEVELS]
    convert(run, tmp_path / "a.msz", "--max-bytes", sizes[7])
    assert (tmp_path / "a.msz").stat().st_size == sizes[7]
    assert "no level of .msz fits 99 bytes" in one_line("convert", run, tmp_path / "b.msz", "--max-bytes", 99)
    capfd.readouterr()
    convert(run, tmp_path / "c.msz", "--max-drop", "0.05")
    out = capfd.readouterr().out
    assert "dB lost on 6 of 6 training views of nook" in out
    assert (tmp_path / "c.msz").stat().st_size < sizes[1]
    ply = run / "point_cloud.ply"
    convert(ply, tmp_path / "d.msz", "--max-drop", "0.05", "--scene", run.parent / "nook")
    needs = one_line("convert", ply, tmp_path / "e.msz", "--max-drop", "0.05")
    assert "is no run: give --scene PATH" in needs


def test_what_convert_refuses(run, tmp_path, one_line):
    assert "has levels 0 to 12" in one_line("convert", run, tmp_path / "a.msz", "--level", "13")
    assert "a PLY has one precision" in one_line("convert", run, tmp_path / "a.ply", "--max-bytes", "9")
    assert ".ply or .msz or .spz" in one_line("convert", run, tmp_path / "a.xyz")
    assert "are for --max-drop" in one_line("convert", run, tmp_path / "a.msz", "--scene", run)
    assert "knows its extension" in one_line("convert", run, tmp_path / "a.msz", "--extension", "velocity")
    (tmp_path / "bad.msz").write_bytes(b"MSZ\n")
    assert "bad.msz: not a MSZ file" in one_line("convert", tmp_path / "bad.msz", tmp_path / "a.ply")
    assert "bad.msz" in one_line("info", tmp_path / "bad.msz")


def test_further_fields_need_a_ply(run, tmp_path, one_line, capfd):
    from minisplat_ref.extensions.velocity.method import at_rest

    moving = at_rest(load_ply(run / "point_cloud.ply"), np.random.default_rng(0))
    save_ply(tmp_path / "moving.ply", moving)
    line = one_line("convert", tmp_path / "moving.ply", tmp_path / "a.msz", "--extension", "velocity")
    assert "velocities, which .msz does not hold: convert it to a PLY" in line
    convert(tmp_path / "moving.ply", tmp_path / "b.ply", "--extension", "velocity")
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "moving.ply").read_bytes()
    convert(tmp_path / "moving.ply", tmp_path / "c.msz")
    assert "also has velocities_0, velocities_1, velocities_2, which are left out" in capfd.readouterr().err
    line = one_line("render", tmp_path / "c.msz", "--extension", "velocity", "--out", tmp_path / "views")
    assert ".msz does not hold velocities of extension velocity" in line


def test_compact_files_are_drawn_and_measured_and_described(run, tmp_path, capsys):
    """At level 0 every picture and every measure is that of the run, but for the order, which nothing depends on."""
    convert(run, tmp_path / "a.msz", "--level", "0")
    cameras = ["--cameras", str(run / "cameras.json")]
    for source, out in ((tmp_path / "a.msz", "one"), (run / "point_cloud.ply", "other")):
        assert main(["render", str(source), *cameras, "--out", str(tmp_path / out)]) == 0
    pictures = sorted((tmp_path / "one").glob("*.png"))
    assert len(pictures) == 8
    for path in pictures:
        assert path.read_bytes() == (tmp_path / "other" / path.name).read_bytes()
    before = json.loads((run / "metrics.json").read_text())
    assert main(["eval", str(run), "--model", str(tmp_path / "a.msz"), "--out", str(tmp_path / "eval")]) == 0
    metrics = json.loads((tmp_path / "eval" / "metrics.json").read_text())
    assert metrics["psnr"] == before["psnr"] and metrics["model"] == str((tmp_path / "a.msz").resolve())
    assert main(["eval", str(run), "--model", str(tmp_path / "a.msz")]) == 0
    assert (run / "eval-a.msz" / "metrics.json").exists() and json.loads((run / "metrics.json").read_text()) == before
    capsys.readouterr()
    assert main(["info", str(tmp_path / "a.msz")]) == 0
    out = capsys.readouterr().out
    assert "0: every float32" in out and "Gaussians" in out and "60" in out
    assert main(["extensions", "compression"]) == 0
    assert ".msz (lattices of 13 precisions, zstandard), .spz" in capsys.readouterr().out


# The study


def study(run, out, *options):
    ply = str(run / "point_cloud.ply")
    return main(
        ["study", "compression/rate-distortion", str(run.parent / "nook"), "--ply", ply, "--out", out, *options]
    )


def test_study_of_a_ply(run, tmp_path, capsys):
    """What keeps every float loses nothing, and the finest lattice is nearer than the coarsest."""
    copier = tmp_path / "copier"
    copier.write_text('#!/bin/sh\n[ "$1 $2" = "-g cpu" ] && cp "$3" "$4"\n')
    copier.chmod(0o755)
    assert study(run, str(tmp_path / "out"), "--splat-transform", str(copier)) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    drops = {point["name"]: point["drop"] for point in result["runs"][0]}
    sizes = {point["name"]: point["n_bytes"] for point in result["runs"][0]}
    assert list(drops) == ["ply", "sog", "spz version 3", "spz version 2", *(f"msz {level}" for level in LEVELS)]
    assert drops["ply"] == drops["sog"] == drops["msz 0"] == 0.0
    assert abs(drops["msz 1"]) < 0.2 * abs(drops["msz 12"])
    assert sizes["ply"] == sizes["sog"] == (run / "point_cloud.ply").stat().st_size
    assert sizes["msz 5"] == len(msz.encode(load_ply(run / "point_cloud.ply"), 5))
    assert (tmp_path / "out" / "figure.png").stat().st_size > 10_000
    assert "bytes a Gaussian" in capsys.readouterr().out


def test_a_smaller_scene_is_the_same_picture_and_only_spz_suffers(run):
    """At 1/512 the step of SPZ, 2^-12, is as large as an eighth of a unit was."""
    views, gaussians = load_scene(run.parent / "nook").test_views, load_ply(run / "point_cloud.ply")
    pictures = []
    for factor in (1.0, 1 / 512):
        small, camera = rate_distortion.shrink(gaussians, factor), rate_distortion.shrunk_camera(views[0], factor)
        conventions = GSPLAT_MAIN._replace(near_plane=factor * GSPLAT_MAIN.near_plane)
        files = [format_.decode(format_.encode(small, level), "") for format_, level in ((msz.MSZ, 5), (spz.SPZ, 0))]
        request = Request(conventions=conventions)
        pictures.append([SPLATTING.render(Model(g), view_from(camera), request)[0].image for g in (small, *files)])
    (large, large_msz, large_spz), (small, small_msz, small_spz) = pictures
    assert np.abs(small - large).max() < 20 * PARITY_FLOAT32_IMAGE
    assert rms(small_msz - small) < 2 * rms(large_msz - large)
    assert rms(small_spz - small) > 2 * rms(large_spz - large)


def rms(image):
    return np.sqrt(np.mean(image**2))


def test_study_trains(run, tmp_path, capsys):
    nook = str(run.parent / "nook")
    options = ["--recipe", "3dgs-accel", "--iterations", "3", "--seeds", "2", "--out", str(tmp_path / "out")]
    assert main(["study", "compression/rate-distortion", nook, *options]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(result["runs"]) == len(result["psnr"]) == 2 and result["iterations"] == 3
    assert "nook" in capsys.readouterr().out


def test_study_that_cannot_be(run, tmp_path, one_line):
    out = str(tmp_path / "out")
    program = ["--splat-transform", "not-there"]
    ply = str(run / "point_cloud.ply")
    name = "compression/rate-distortion"
    nook = str(run.parent / "nook")
    assert "not-there does not work" in one_line("study", name, nook, "--ply", ply, "--out", out, *program)
    assert "neither a folder" in one_line("study", name, "nowhere", "--out", out)
    assert "--seeds is 0" in one_line("study", name, nook, "--out", out, "--seeds", "0")
