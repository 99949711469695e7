"""OMG: distinctiveness by hand, codebooks, a decoder of few features, and the file that holds them."""

import json

import numpy as np
import pytest
import zstandard
from numpy.testing import assert_allclose, assert_array_equal
from scipy.cluster.vq import kmeans2

from actions import act, scene_of, state_of
from compact import check_damage, check_headers, population, refusal, short_run, with_header
from minisplat_ref import load_ply
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_format, find_recipe
from minisplat_ref.extensions.omg import file as omg
from minisplat_ref.extensions.omg import trained_file
from minisplat_ref.extensions.omg.codes import fit_codes, quantise
from minisplat_ref.extensions.omg.file import compute_features, fit_decoder
from minisplat_ref.extensions.omg.recipe import distinct_importance, local_distinctiveness, prune_indistinct
from minisplat_ref.extensions.omg.trained_file import read_training
from minisplat_ref.methods.mini_splatting import MINI_SPLATTING, prune_tail
from minisplat_ref.rendering import RenderSettings
from minisplat_ref.strategy.importance import indoor
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.schedule import action_name, firing_steps
from minisplat_ref.training.state import Iteration
from minisplat_ref.types import Frame, Gaussians
from scenes import as_dtype, balls, make_camera
from tolerances import CLOSED_FORM, HALF_FLOAT

LEVELS = range(len(omg.LEVELS))


# Distinctiveness


def test_distinctiveness_by_hand(rng):
    """For six Gaussians in a line, the differences to the left and right neighbours add up, whatever the row order."""
    means = np.column_stack([np.arange(6.0), np.zeros(6), np.zeros(6)])
    gray = np.array([0.0, 1.0, 1.0, 1.0, 5.0, 2.0])
    colors = np.column_stack([gray, gray, gray - 3])
    expected = np.array([2.0, 1.0, 0.0, 4.0, 7.0, 6.0])  # the ends have one neighbour, which counts twice
    for _ in range(5):
        rows = rng.permutation(6)
        assert_allclose(local_distinctiveness(means[rows], colors[rows]), expected[rows], atol=CLOSED_FORM)


def test_neighbours_are_found_in_the_box_of_the_centres():
    """In a box of 8 x 1, the upper half is behind the whole lower one; in a cube, x alone would decide."""
    means = np.array([[0.0, 0, 0], [0.0, 1, 0], [2.0, 0, 0], [8.0, 1, 0]])
    gray = np.array([0.0, 10.0, 1.0, 13.0])  # in the order of the box: 0, 1, 10, 13; of the cube: 0, 10, 1, 13
    colors = np.repeat(gray[:, None], 3, axis=1)
    assert_allclose(local_distinctiveness(means, colors), [2.0, 12.0, 10.0, 6.0], rtol=CLOSED_FORM)


def test_distinctiveness_is_the_mean_of_the_channels():
    colors = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, -3.0]])
    assert_allclose(local_distinctiveness(np.eye(3)[:2], colors), [4.0, 4.0], rtol=CLOSED_FORM)


@pytest.mark.parametrize("n", [0, 1])
def test_a_single_gaussian_is_not_distinct(n):
    assert_array_equal(local_distinctiveness(np.zeros((n, 3)), np.ones((n, 3))), np.zeros(n))


def test_score():
    importance, distinctiveness = np.array([2.0, 3.0, 5.0]), np.array([1.0, 2.0, 0.0])
    assert_array_equal(distinct_importance(importance, distinctiveness, 2.0), [2.0, 12.0, 0.0])
    assert_array_equal(distinct_importance(importance, distinctiveness, 0.0), importance)


# The event


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", supersampling=1, n_views=6, width=32, height=24, n_points=120, test_every=4).scene


def state_and_iteration(scene):
    state = initial_state(scene, MINI_SPLATTING, seed=0)
    nothing = dict.fromkeys(Iteration._fields)
    iteration = Iteration(**nothing | {"scene": scene, "render_settings": RenderSettings(scene.background)})
    return state, iteration


def test_without_distinctiveness_it_is_mini_splattings_pruning(scene):
    """With the power 0 it agrees to the last byte."""
    (ours, iteration), (theirs, _) = state_and_iteration(scene), state_and_iteration(scene)
    prune_indistinct(ours, iteration, metric=indoor, distinct_mass=0.9, distinct_power=0.0)
    prune_tail(theirs, iteration, metric=indoor, mass=0.9, is_intersecting=True)
    assert 0 < len(ours.gaussians.means) < len(scene.points)
    for field, other in zip(ours.gaussians, theirs.gaussians, strict=True):
        assert field.tobytes() == other.tobytes()


def test_with_distinctiveness_it_keeps_fewer_and_more_distinct_ones(scene):
    (ours, iteration), (theirs, _) = state_and_iteration(scene), state_and_iteration(scene)
    prune_indistinct(ours, iteration, metric=indoor, distinct_mass=0.9, distinct_power=2.0)
    prune_tail(theirs, iteration, metric=indoor, mass=0.9, is_intersecting=True)
    assert 0 < len(ours.gaussians.means) < len(theirs.gaussians.means)


def test_the_recipe_keeps_99_percent_of_importance_times_distinctiveness_squared():
    """Nine equal balls in a row, so LD^2 decides: 100, 100, 34.81, 3.24, 34.81, 36, 4, 36 and 100, 448.86 in all.

    The fourth carries 0.7 %, the fourth and the seventh together 1.6 %: only the fourth goes.
    """
    steps = np.array([5, 5, 0.9, 0.9, 5, 1, 1, 5])
    places = np.column_stack([1.6 * (np.arange(9) - 4), np.zeros(9), np.full(9, 100.0)])
    gaussians = balls(places, np.full(9, 0.3), np.full(9, 0.9))
    gray = np.concatenate([[0], np.cumsum(steps * (-1) ** np.arange(8))])
    state = state_of(as_dtype(gaussians._replace(sh_dc=np.repeat(gray[:, None], 3, axis=1)), np.float32))
    act(find_recipe("omg"), prune_indistinct, state, scene_of([make_camera(160, 16, fx=1000.0, fy=1000.0)]))
    assert_allclose(state.gaussians.means[:, 0], np.delete(places[:, 0], 3), rtol=1e-6)


def test_where_all_colours_are_alike_it_does_nothing(scene):
    state, iteration = state_and_iteration(scene)
    state.gaussians.sh_dc[:] = 0.25
    note = prune_indistinct(state, iteration, metric=indoor, distinct_mass=0.9, distinct_power=2.0)
    assert "all colours are alike" in note and len(state.gaussians.means) == len(scene.points)


def test_the_recipe_is_mini_splatting_but_for_its_last_pruning_and_what_comes_with_networks_and_codes():
    names = [action_name(event) for event in find_recipe("omg").events]
    theirs = [action_name(event) for event in MINI_SPLATTING.events]
    own = {"start_networks", "start_codes", "round_centres", "write_fields"}
    assert [name for name in names if name not in own] == [
        "prune_indistinct" if name == "prune_tail" else name for name in theirs
    ]
    assert own < set(names) and firing_steps(find_recipe("omg"), prune_indistinct) == [20_000]


# Codebooks


def test_few_different_vectors_are_their_own_codes(rng):
    vectors = rng.integers(0, 3, size=(500, 4)) / 4.0
    quantised = quantise(vectors, 2, 9)
    assert_array_equal(quantised.vectors(), vectors)
    assert [codes.shape for codes in quantised.codes] == [(9, 2), (9, 2)] and quantised.indices.shape == (500, 2)


def test_codes_are_means_of_their_own_and_vectors_take_the_nearest(rng):
    vectors = np.concatenate(
        [middle + rng.normal(size=(n, 2)) for n, middle in ((40, 0.0), (40, 50.0), (20, np.array([-60.0, 0.0])))]
    )
    codes = fit_codes(vectors, 3)
    expected = [vectors[:40].mean(axis=0), vectors[40:80].mean(axis=0), vectors[80:].mean(axis=0)]
    assert_allclose(codes[np.argsort(codes[:, 0])], np.array(expected)[[2, 0, 1]], rtol=CLOSED_FORM, atol=CLOSED_FORM)
    quantised = quantise(rng.normal(size=(400, 2)), 2, 16)
    assert len(quantised.codes[0]) == 16


def test_codes_are_those_of_twelve_rounds_of_lloyds_algorithm():
    """SciPy's, from the first number of each of the eight cells in which they lie, and the last of all."""
    vectors = np.linspace(0.0, 1.0, 401)[:, None] ** 3
    start = np.array([vectors[vectors[:, 0] >= k / 8][0] for k in range(9)])
    eleven, twelve = (kmeans2(vectors, start, iter=n, minit="matrix")[0] for n in (11, 12))
    assert np.abs(twelve - eleven).max() > 1e-4  # it has not ended
    assert_allclose(fit_codes(vectors, 9), twelve, rtol=1e-9)


def test_rare_vectors_are_not_starved(rng):
    """Beside a dense cluster, no vector of a thin tail is further from its code than 1/64 of the tail's width."""
    vectors = np.concatenate([rng.normal(size=(5000, 1)), rng.uniform(-20, 20, size=(60, 1))])
    error = np.abs(quantise(vectors, 1, 64).vectors() - vectors)
    assert error.max() < 40 / 64


def mse(vectors, width, n_codes):
    return np.mean((quantise(vectors, width, n_codes).vectors() - vectors) ** 2)


def test_sub_vectors_are_cheap_at_high_rates_and_no_better_at_low_ones(rng):
    """For six independent normal numbers, codebooks are compared at equal size (384 numbers) and at 6 bits a vector."""
    vectors = rng.normal(size=(4000, 6))
    assert mse(vectors, 2, 64) < 0.2 * mse(vectors, 6, 64)
    assert mse(vectors, 6, 64) < mse(vectors, 2, 4)
    errors = [mse(vectors, 2, k) for k in (4, 16, 64, 256)]
    assert errors == sorted(errors, reverse=True)


def test_harmonics_of_few_dimensions_are_recovered(rng):
    directions, mean = rng.normal(size=(3, 45)), rng.normal(size=45)
    harmonics = mean + rng.normal(size=(200, 3)) @ directions
    decoder = fit_decoder(harmonics, 3)
    back = decoder.harmonics(compute_features(harmonics, decoder))
    assert np.abs(back - harmonics).max() < 10 * HALF_FLOAT * np.abs(harmonics).max()
    basis = decoder.directions.astype(np.float64)
    assert_allclose(basis @ basis.T, np.eye(3), atol=10 * HALF_FLOAT)


def test_the_decoder_is_the_best_linear_one(rng):
    """Three directions of random rotations do no better, and the error is the variance that is left."""
    harmonics = rng.normal(size=(500, 8)) * [5, 4, 3, 1, 0.5, 0.4, 0.3, 0.2]
    decoder = fit_decoder(harmonics, 3)
    error = np.sum((decoder.harmonics(compute_features(harmonics, decoder)) - harmonics) ** 2)
    left = np.linalg.svd(harmonics - harmonics.mean(axis=0), compute_uv=False)[3:]
    assert error == pytest.approx(np.sum(left**2), rel=0.01)


# The file


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("sh_degree", range(4))
def test_round_trip(level, sh_degree):
    gaussians = population(200, sh_degree)
    content = omg.encode(gaussians, level)
    back = omg.decode(content, "file")
    assert omg.encode(gaussians, level) == content
    assert all(
        field.shape == other.shape and field.dtype == np.float32 for field, other in zip(back, gaussians, strict=True)
    )
    center = np.median(gaussians.means, axis=0)
    offsets = (gaussians.means - center).astype(np.float16).astype(np.float32)
    rows = np.lexsort((center + offsets).T)
    found = np.lexsort(back.means.T)
    assert_array_equal(back.means[found], (center + offsets)[rows])  # the centres by themselves, whatever their order
    sizes = omg.LEVELS[level]
    assert len(np.unique(back.opacity_logits)) <= sizes.opacities
    for axis in range(3):
        assert len(np.unique(back.log_scales[:, axis])) <= sizes.scales
    assert len(np.unique(back.quats[:, :2], axis=0)) <= sizes.rotations


def test_each_row_is_the_nearest_that_the_codebooks_have():
    """With as many codes as rows, only the error of half floats is left, row by row."""
    gaussians = population(60, 1)
    back = omg.decode(omg.encode(gaussians, 0), "file")
    order = omg.find_order(gaussians)
    ours = Gaussians(*(field[order] for field in gaussians))
    for name in ("log_scales", "opacity_logits", "sh_dc", "sh_rest"):
        field, other = getattr(ours, name), getattr(back, name)
        assert np.abs(field - other).max() < 10 * HALF_FLOAT * np.abs(field).max(), name
    quats = ours.quats / np.linalg.norm(ours.quats, axis=1, keepdims=True)
    signs = np.where(quats[:, :1] < 0, -1, 1)
    assert np.abs(quats * signs - back.quats).max() < HALF_FLOAT


def test_sizes_fall_level_by_level():
    gaussians = population(3000)
    sizes = [len(omg.encode(gaussians, level)) for level in LEVELS]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 12 * 3000


@pytest.mark.parametrize("n", [0, 1, 2])
def test_hardly_any_gaussians(n):
    for level in LEVELS:
        assert len(omg.decode(omg.encode(population(n), level), "file").means) == n


def test_no_rotation_becomes_zero():
    """Rotations by 180 degrees have w = x = 0, and the mean of opposite (y, z) may be zero, so w is kept above zero."""
    gaussians = population(40, 0)
    gaussians.quats[:] = [0, 0, 1, 1]
    gaussians.quats[::2] = [0, 0, -1, -1]
    for level in LEVELS:
        back = omg.decode(omg.encode(gaussians, level), "file")
        assert_array_equal(back.quats[:, :2], np.tile([omg.QUAT_MIN, 0.0], (40, 1)))


def test_what_half_floats_do_not_reach():
    gaussians = population(10)
    gaussians.means[3, 0] = 1e6
    with pytest.raises(InputError, match=r"means reach 1e\+06, but half floats 65504: choose another format"):
        omg.encode(gaussians, 2)

    gaussians.means[:, 0] = 1e35
    with pytest.raises(InputError, match=r"means are 1e\+35 from the origin: move the scene"):
        omg.encode(gaussians, 2)


# Damaged files


def test_damaged_files():
    content = omg.encode(population(20), 2)
    for length in (0, 4, 9, 30, len(content) // 2, len(content) - 1):
        refusal(omg.OMG_FILE, content[:length])
    assert "OMG of version 9" in refusal(omg.OMG_FILE, content[:4] + bytes([9, 0]) + content[6:])
    assert "not an OMG file" in refusal(omg.OMG_FILE, b"MSZ\n" + content[4:])
    assert "would take" in refusal(omg.OMG_FILE, with_header(content, n=2**31 - 1))
    codes = {"scales": [2**16] * 3, "rotations": [2**16] * 2, "opacities": [2**16], "appearance": [2**16] * 3}
    lies = [
        {"n": 2**31},
        {"n": -1},
        {"center": [1, 2]},
        {"center": [1e308, 0.0, 0.0]},
        {"center": ["a", 0.0, 0.0]},
        {"codes": {}},
        {"n_features": 45},
    ]
    for lie in [*lies, {"planes": {"means": 1}}, {"sh_degree": 4}, {"codes": codes | {"scales": [-1, 2, 3]}}]:
        assert "does not describe Gaussians" in refusal(omg.OMG_FILE, with_header(content, **lie))
    assert "damaged" in refusal(omg.OMG_FILE, with_header(content, codes=codes))
    assert "codebook" in refusal(omg.OMG_FILE, repacked(content, lose_code))
    assert "means is nan" in refusal(omg.OMG_FILE, repacked(content, make_nan))


def repacked(content, change):
    """Return the file with its header and streams changed and every checksum right."""
    packed = omg.parse(omg.CONTAINER, content, "")
    header = {name: value for name, value in packed.header.items() if name != "streams"}
    streams = {name: zstandard.ZstdDecompressor().decompress(frame) for name, frame in packed.frames.items()}
    change(header, streams)
    return omg.pack(omg.CONTAINER, header, streams.items())


def lose_code(header, streams):
    """Drop the last code of opacities, so that the largest index is their number."""
    (n_codes,) = header["codes"]["opacities"]
    header["codes"] = header["codes"] | {"opacities": [n_codes - 1]}
    streams["opacities codes"] = streams["opacities codes"][:-2]


def make_nan(header, streams):
    """Make the first centre a signalling NaN, 0x7d00; zigzag encoding doubles it, and it takes two planes."""
    n = header["planes"]["means"] * 3 * header["n"]
    low, high = bytearray(n // 2), bytearray(n // 2)
    high[0] = 2 * 0x7D
    streams["means"] = bytes(low + high)


def test_damaged_anywhere(rng):
    check_damage(omg.OMG_FILE, omg.encode(population(20), 2), rng, 200)
    check_headers(omg.OMG_FILE, omg.encode(population(7, 1), 2), rng, 300)


# The command line


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a scene, and a run of the recipe omg on it."""
    run = short_run(tmp_path_factory.mktemp("omg"), "omg", "--set", "distinct_mass=0.9")
    return run.parent / "nook", run


def test_train_convert_draw_and_measure(folders, tmp_path, capsys):
    _, run = folders
    events = [json.loads(line) for line in (run / "events.jsonl").read_text().splitlines()]
    assert any("prune_indistinct" in json.dumps(event) for event in events)
    out = tmp_path / "a.omg"
    assert main(["convert", str(run), str(out)]) == 0
    printed = capsys.readouterr().out
    assert "level: 2 of 4" in printed and "features: 3 for the higher harmonics" in printed
    assert find_format(out) is omg.OMG_FILE
    assert main(["convert", str(out), str(tmp_path / "a.ply")]) == 0
    assert len(load_ply(tmp_path / "a.ply").means) == len(load_ply(run / "point_cloud.ply").means)
    assert main(["render", str(out), "--cameras", str(run / "cameras.json"), "--out", str(tmp_path / "views")]) == 0
    assert main(["eval", str(run), "--model", str(out), "--out", str(tmp_path / "eval")]) == 0
    assert main(["info", str(out)]) == 0
    assert "codes" in capsys.readouterr().out


def test_pack_a_training(folders, tmp_path, capfd):
    """The file of a run's codes and networks has what its PLY has, but for half floats; every command reads it."""
    _, run = folders
    out = tmp_path / "a.omg"
    assert main(["omg", "pack", str(run / "checkpoint.npz"), "--out", str(out)]) == 0
    n = len(load_ply(run / "point_cloud.ply").means)
    assert f"{n} Gaussians in {out}, {out.stat().st_size:,} bytes" in capfd.readouterr().out
    assert main(["convert", str(out), str(tmp_path / "a.ply")]) == 0
    expected, found = (load_ply(ply) for ply in (run / "point_cloud.ply", tmp_path / "a.ply"))
    for name in Gaussians._fields:
        a, b = (getattr(g, name)[np.lexsort(g.means.T)] for g in (expected, found))
        assert_allclose(b, a, atol=20 * HALF_FLOAT * max(1, np.abs(a).max()), err_msg=name)
    assert np.abs(expected.sh_rest).max() > 1e-4  # networks have been trained
    camera = ["--cameras", str(run / "cameras.json"), "--out", str(tmp_path / "views")]
    assert main(["render", str(out), *camera]) == 0
    assert main(["info", str(out)]) == 0
    assert "weights as half floats" in capfd.readouterr().out
    other, missing = tmp_path / "a.spz", tmp_path / "b.omg"
    assert main(["omg", "pack", str(run), "--out", str(missing)]) == 2
    assert "is a folder: give the checkpoint.npz in it" in capfd.readouterr().err
    assert main(["omg", "pack", str(run / "checkpoint.npz"), "--out", str(other)]) == 2
    assert "is not named .omg" in capfd.readouterr().err and not other.exists() and not missing.exists()


def test_damaged_trained_files(folders, rng):
    _, run = folders
    content = trained_file.encode(*read_training(run / "checkpoint.npz"))
    check_damage(omg.OMG_FILE, content, rng, 60)
    check_headers(omg.OMG_FILE, content, rng, 100)
    for lie in ({"n": -1}, {"unit": 0.0}, {"inverse_radius": 1e99}, {"codes": {}}, {"planes": {}}, {"center": [1, 2]}):
        assert "does not describe Gaussians" in refusal(omg.OMG_FILE, with_header(content, **lie))
    few = {"scale_codes": [0, 0, 0], "rotation_codes": [0, 0], "feature_codes": [0, 0, 0]}
    assert "damaged" in refusal(omg.OMG_FILE, with_header(content, codes=few))


def test_a_run_without_codes_is_not_packed(folders):
    _, run = folders
    model, frame = read_training(run / "checkpoint.npz")
    g = model.gaussians
    for columns in (g.codes[:, :0], g.codes[:, :5]):
        with pytest.raises(InputError, match="no codes for its features"):
            trained_file.encode(model._replace(gaussians=g._replace(codes=columns)), frame)


def test_a_file_is_in_the_frame_of_the_scene(folders):
    """A run in a frame that is moved and eight times as large has a file in that of the photographs."""
    _, run = folders
    model, frame = read_training(run / "checkpoint.npz")
    plain = trained_file.decode(trained_file.encode(model, frame), "a")
    moved = trained_file.decode(trained_file.encode(model, Frame((10.0, 20.0, -30.0), 8.0)), "a")
    assert_allclose(moved.means, 8 * plain.means + [10, 20, -30], rtol=1e-6)
    assert_allclose(moved.log_scales, plain.log_scales + np.log(8), rtol=1e-6)
    assert_array_equal(moved.sh_dc, plain.sh_dc)
