"""Structure from motion, end to end: cameras against the truth, the choice of a model, and what is said."""

import shutil

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.datasets import sfm
from minisplat_ref.datasets.sfm import attempts, mapping
from minisplat_ref.datasets.sfm import features as features_module
from minisplat_ref.datasets.sfm.features import is_connected, overlapping_pairs, pairs_to_match, reaches
from minisplat_ref.datasets.sfm.judging import Matches, choose, count_explained, is_good
from minisplat_ref.datasets.sfm.mapping import Mapped
from minisplat_ref.datasets.sfm.photographs import Photographs
from minisplat_ref.io import load_scene
from minisplat_ref.io.images import read_image, write_image
from minisplat_ref.io.lens import import_pycolmap
from photo_scenes import assert_refused, colored_image, sparse_color_errors
from textured_world import HEIGHT, WIDTH, take_photographs, write_photographs
from tolerances import COLOR_RATIO, SFM_CENTERS, SFM_DEPTH, SFM_FOCAL, SFM_REPEAT, SFM_TRUE_CENTERS

FOCALS = (1.1 * WIDTH, 1.9 * WIDTH)  # of the zoom lens at 24 and 41.5 mm


@pytest.fixture(scope="module")
def shots():
    return take_photographs(np.random.default_rng(3), FOCALS * 6)


def similarity(a, b):
    """Return scale, rotation and translation that take points a [n, 3] onto b."""
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    U, _, Vt = np.linalg.svd((b - mean_b).T @ (a - mean_a))
    rotation = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    scale = np.vdot(b - mean_b, (a - mean_a) @ rotation.T) / np.vdot(a - mean_a, a - mean_a)
    return scale, rotation, mean_b - scale * rotation @ mean_a


def centers(cameras):
    return np.stack([-camera.cam_from_world_R.T @ camera.cam_from_world_t for camera in cameras])


def depth_errors(scene, shots):
    """Relative errors in depth of the scene's points, and the number of views that see each."""
    cameras = [shots[int(view.name)].camera for view in scene.train_views]
    scale, rotation, translation = similarity(centers(view.camera for view in scene.train_views), centers(cameras))
    points = scale * scene.points @ rotation.T + translation
    errors, n_views = [[] for _ in points], np.zeros(len(points), int)
    for view in scene.train_views:
        camera, depth = shots[int(view.name)].camera, shots[int(view.name)].depth
        x, y, z = (points[view.point_ids] @ camera.cam_from_world_R.T + camera.cam_from_world_t).T
        u = np.clip((camera.fx * x / z + camera.cx).astype(int), 1, WIDTH - 2)
        v = np.clip((camera.fy * y / z + camera.cy).astype(int), 1, HEIGHT - 2)
        for row, i, j, distance in zip(view.point_ids, v, u, z, strict=True):
            patch = depth[i - 1 : i + 2, j - 1 : j + 2]  # features lie at edges too
            errors[row].append(np.abs(patch - distance).min() / distance)
            n_views[row] += 1
    return np.array([np.median(error) for error in errors]), n_views


def run_sfm(photos, scene, *options):
    return main(["sfm", str(photos), "--out", str(scene), *options])


def lines_of(printed):
    """Return the lines, without the one about the shell, which is printed where the environment is not active."""
    return [line for line in printed.splitlines() if not line.startswith("in a new terminal")]


# against the truth


def test_two_focal_lengths_at_one_size(shots, tmp_path, capsys):
    write_photographs(tmp_path / "photos", shots, (24.0, 41.5) * 6)
    assert run_sfm(tmp_path / "photos", tmp_path / "scene", "--features", "standard") == 0
    printed = capsys.readouterr()
    assert printed.err == ""  # no bars where there is no terminal
    first, kept, groups, up, *_, following = lines_of(printed.out)
    assert up.startswith("up is ") and up.endswith("(--up says it otherwise)")
    assert ": 12 of 12 photographs (100%), " in first and " points, reprojection error 0." in first
    assert kept.startswith("kept: incremental mapper with standard features: 12 "), "the other one is not needed"
    assert groups == (
        "one camera for each size, camera and focal length: 6 of 256 x 192, Maker Zoom 1, 24 mm;"
        " 6 of 256 x 192, Maker Zoom 1, 41.5 mm"
    )
    assert following.startswith("next: ") and "--downscale" not in following
    scene = load_scene(tmp_path / "scene", test_every=0)
    for view in scene.train_views:
        assert view.camera.fx == pytest.approx(FOCALS[int(view.name) % 2], rel=SFM_FOCAL)
    found, truth = (
        centers([view.camera for view in scene.train_views]),
        centers([shots[int(view.name)].camera for view in scene.train_views]),
    )
    scale, rotation, translation = similarity(found, truth)
    errors = np.linalg.norm(scale * found @ rotation.T + translation - truth, axis=1)
    assert errors.max() < SFM_TRUE_CENTERS
    errors, n_views = depth_errors(scene, shots)
    assert (n_views == 2).sum() > 200 and (n_views > 2).sum() > 200
    assert np.median(errors) < SFM_DEPTH
    assert (errors[n_views == 2] > 5 * SFM_DEPTH).mean() < 0.15
    assert (errors[n_views > 2] > 5 * SFM_DEPTH).mean() < 0.05


def test_masked_parts_have_no_features(shots, tmp_path, capsys):
    """The left third is masked, by alpha in some photographs and by a file in others; one photograph has no mask."""
    write_photographs(tmp_path / "photos", shots[:5], (24.0, 41.5, 24.0, 41.5, 24.0))
    (tmp_path / "photos" / "masks").mkdir()
    mask = np.tile(np.arange(WIDTH) >= WIDTH // 3, (HEIGHT, 1))
    for i in (0, 1):
        image = read_image(tmp_path / "photos" / f"0{i}.jpg")
        (tmp_path / "photos" / f"0{i}.jpg").unlink()
        write_image(tmp_path / "photos" / f"0{i}.png", np.dstack([image, np.uint8(255) * mask]))
    for i in (2, 3):
        write_image(tmp_path / "photos" / "masks" / f"0{i}.png", mask)
    assert run_sfm(tmp_path / "photos", tmp_path / "scene", "--features", "standard") == 0
    out = capsys.readouterr().out
    assert ": 5 of 5 photographs" in out and "\nmasks: of 4 photographs; " in out
    scene = load_scene(tmp_path / "scene", test_every=0)
    assert sorted(path.name for path in (tmp_path / "scene" / "masks").iterdir()) == [
        "00.png.png",
        "01.png.png",
        "02.jpg.png",
        "03.jpg.png",
    ]
    for view in scene.train_views:
        x, _, z = (scene.points[view.point_ids] @ view.camera.cam_from_world_R.T + view.camera.cam_from_world_t).T
        u = view.camera.fx * x / z + view.camera.cx
        assert len(u) > 15
        if view.name == "04":
            assert view.mask is None and (u < WIDTH / 3 - 10).any()
        else:
            assert u.min() > WIDTH / 3 - 10  # undistorted
            assert view.mask[:, : WIDTH // 3 - 10].mean() == 0 and view.mask[:, WIDTH // 3 + 10 :].mean() == 1


def test_same_photographs_give_the_same_cameras(shots, tmp_path):
    write_photographs(tmp_path / "photos", shots[:8:2], (None,) * 4)
    for name in "ab":
        assert run_sfm(tmp_path / "photos", tmp_path / name, "--features", "standard") == 0
    a, b = (load_scene(tmp_path / name, test_every=0) for name in "ab")
    assert a.points.shape == b.points.shape
    np.testing.assert_allclose(a.points, b.points, rtol=SFM_REPEAT, atol=SFM_REPEAT)
    for one, other in zip(a.train_views, b.train_views, strict=True):
        np.testing.assert_allclose(one.camera.cam_from_world_t, other.camera.cam_from_world_t, atol=SFM_REPEAT)
        assert one.camera.fx == pytest.approx(other.camera.fx, rel=SFM_REPEAT)


# what is tried


def test_dense_features_find_more(shots, tmp_path):
    write_photographs(tmp_path / "photos", shots[:8:2], (None,) * 4)
    n_points = []
    for features in ("standard", "dense"):
        result = sfm.run_sfm(tmp_path / "photos", tmp_path / features, features=features)
        assert result.kept.features == features and result.kept.n_placed == 4
        assert len(load_scene(tmp_path / features, test_every=0).points) == result.n_points
        n_points.append(result.n_points)
    assert n_points[1] > 1.5 * n_points[0]


def test_dense_features_are_matched_with_the_lost_photograph_first(shots, tmp_path, capsys):
    """It shows something else: its four pairs do not connect it, so the other six are left out."""
    write_photographs(tmp_path / "photos", shots[:4], (24.0, 41.5, 24.0, 41.5))
    write_image(tmp_path / "photos" / "other.png", colored_image(3, WIDTH, HEIGHT))
    result = sfm.run_sfm(tmp_path / "photos", tmp_path / "scene")
    assert result.left_out == ("other.png",) and result.kept.features == "standard"
    assert [part[:2] for part in result.parts[-2:]] == [("dense features", 5), ("dense matches", 4)]
    err = capsys.readouterr().err.splitlines()
    assert err == [
        "minisplat-ref: without a place: 1 of 5 photographs; dense features, 10 pairs",
        "minisplat-ref: dense features do not connect them either",
    ]


@pytest.mark.parametrize("is_asked", [True, False])
def test_only_what_is_lost_is_matched_thoroughly(is_asked, monkeypatch, tmp_path):
    """Unless dense features are asked for, or nothing has a place."""
    calls = []
    monkeypatch.setattr(attempts, "find_features", lambda *_: None)
    monkeypatch.setattr(attempts, "match_features", lambda *args: calls.append((args[2], args[3].is_guided)))
    monkeypatch.setattr(attempts, "reaches", lambda *_: True)
    photographs = Photographs(tmp_path, tmp_path, {}, {}, tmp_path, frozenset(), [])
    dense = attempts.Attempt(photographs, tmp_path, features_module.DENSE, "SIMPLE_RADIAL")
    pairs = pairs_to_match("abc", "exhaustive")
    assert attempts._match_lost_first(dense, pairs, frozenset("ab"), is_asked)
    assert calls == [([("a", "c"), ("b", "c")], True), ([("a", "b")], is_asked)]
    assert attempts._match_lost_first(dense, pairs, frozenset(), is_asked) and calls[2] == (pairs, True)


@pytest.mark.parametrize("is_joined", [True, False])
def test_neighbours_in_time_first(shots, tmp_path, capsys, monkeypatch, is_joined):
    """Of 12 photographs 21 pairs are at a distance of one or two; the other 45 are matched only where these fail.

    Since all photographs find a place, however few the points, nothing else is tried.
    """
    monkeypatch.setattr(attempts, "FEW", 11)
    monkeypatch.setattr(features_module, "NEIGHBOURS", (1, 2))
    if not is_joined:
        monkeypatch.setattr(attempts, "is_connected", lambda _: False)
    write_photographs(tmp_path / "photos", shots, (24.0, 41.5) * 6)
    result = sfm.run_sfm(tmp_path / "photos", tmp_path / "scene")
    assert result.kept.n_placed == 12 and not result.others
    matched = [("standard matches", n) for n in ([21] if is_joined else [21, 45])]
    assert [part[:2] for part in result.parts] == [
        ("standard features", 12),
        *matched,
        ("standard first mapper", 12),
    ]
    assert all(part.seconds > 0 for part in result.parts)
    assert ("45 further pairs are matched" in capsys.readouterr().err) == (not is_joined)


def test_all_pairs_where_neighbours_leave_a_photograph_without_a_place(shots, tmp_path, monkeypatch):
    monkeypatch.setattr(attempts, "FEW", 3)
    monkeypatch.setattr(features_module, "NEIGHBOURS", (1,))
    kept, calls = attempts.Attempt.map, []

    def map_worse(attempt):
        results, matches = kept(attempt)
        calls.append([part.n for part in attempt.parts if part.name == "standard matches"])
        return [result._replace(n_placed=len(calls) + 3) for result in results], matches

    monkeypatch.setattr(attempts.Attempt, "map", map_worse)
    write_photographs(tmp_path / "photos", shots[:5], (24.0, 41.5, 24.0, 41.5, 24.0))
    result = sfm.run_sfm(tmp_path / "photos", tmp_path / "scene")
    assert calls == [[4], [4, 6]] and result.kept.n_placed == 5


def test_pairs():
    names = [str(i) for i in range(20)]
    assert pairs_to_match(names[:3], "exhaustive") == [("0", "1"), ("0", "2"), ("1", "2")]
    partners = [int(b) for a, b in pairs_to_match(names, "sequential") if a == "1"]
    assert partners == [2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 17]


def write_matches(path, *matches):
    """Write a database of the photographs 1.jpg to 5.jpg with a number of matches between some."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(path) as database:
        database.write_camera(
            pycolmap.Camera(model="PINHOLE", width=9, height=9, params=(9, 9, 4, 4), camera_id=1), True
        )
        for i in range(1, 6):
            database.write_image(pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i), True)
        for a, b, n in matches:
            geometry = pycolmap.TwoViewGeometry(inlier_matches=np.stack([np.arange(n, dtype=np.uint32)] * 2, axis=1))
            database.write_two_view_geometry(a, b, geometry)
    return path


def test_photographs_are_connected_by_chains_of_15_matches(tmp_path):
    chain = ((1, 2, 20), (4, 5, 40), (3, 4, 30))
    assert not is_connected(write_matches(tmp_path / "a.db", *chain))
    assert not is_connected(write_matches(tmp_path / "b.db", *chain, (2, 3, 14)))
    assert is_connected(write_matches(tmp_path / "c.db", *chain, (2, 3, 15)))
    assert is_connected(write_matches(tmp_path / "d.db", (1, 5, 20), (2, 3, 20), (2, 5, 20), (3, 4, 20)))
    assert not is_connected(write_matches(tmp_path / "e.db"))


def test_a_lost_photograph_is_reached_by_two_that_have_a_place(tmp_path):
    placed = frozenset({"1.jpg", "2.jpg", "3.jpg"})
    one, two = ((1, 2, 99), (4, 5, 99), (3, 4, 30)), (2, 4, 15)
    assert not reaches(write_matches(tmp_path / "a.db", *one, (2, 5, 99)), placed)  # each of 4 and 5 matches one
    assert not reaches(write_matches(tmp_path / "b.db", *one, (2, 4, 14)), placed)
    assert reaches(write_matches(tmp_path / "c.db", *one, two), placed)
    assert reaches(tmp_path / "a.db", frozenset({"3.jpg"}))


def test_overlapping_pairs(tmp_path, monkeypatch):
    """Of a chain whose neighbours match: the best partner of each, and every pair of the one without a place."""
    write_matches(tmp_path / "database.db", (1, 2, 20), (2, 3, 40), (3, 4, 30), (1, 3, 14))
    monkeypatch.setattr(features_module, "PARTNERS", 1)
    pairs = pairs_to_match([f"{i}.jpg" for i in range(1, 6)], "exhaustive")
    placed = frozenset(f"{i}.jpg" for i in range(1, 5))
    chosen = overlapping_pairs(tmp_path / "database.db", pairs, placed)
    assert [a[0] + b[0] for a, b in chosen] == ["12", "15", "23", "25", "34", "35", "45"]


# the choice of a model


def cameras(n=2, shift=0.0):
    """A model of n photographs, 1 apart along x; each is moved by ``shift`` along y against the one before."""
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    params = (100, 100, 50, 50)
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=100, height=100, params=params, camera_id=1)
    )
    for i in range(n):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-float(i), shift * i, 0.0]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i + 1), pose)
    return model


def match_rows(n, other="1.jpg"):
    """n matches of 0.jpg with another photograph, in the same row."""
    first = np.full((n, 2), 50.0)
    return Matches(("0.jpg", other), first, first - [20.0, 0.0])


def test_matches_are_explained_within_four_pixels_of_the_epipolar_line():
    """Of cameras side by side, epipolar lines are rows, and Sampson's distance of rows d apart is d / sqrt(2)."""
    first = np.stack([np.full(6, 60.0), np.full(6, 50.0)], axis=1)
    second = np.stack([np.full(6, 40.0), 50.0 + np.array([0.0, 3.9, 5.6, -5.6, 5.7, 30.0])], axis=1)
    matches = [Matches(("0.jpg", "1.jpg"), first, second), match_rows(6, "2.jpg")]
    assert count_explained(cameras(), matches) == 4
    assert count_explained(cameras(), matches[1:]) == 0  # 2.jpg has no place
    # 20 to the left go with 40 down; 30 down are 10 / sqrt(5) off the line, the others 34.3 / sqrt(5) or more.
    assert count_explained(cameras(shift=2.0), matches) == 1


def test_a_good_result_places_all_and_explains_19_of_20_matches():
    def result(n_placed):
        return Mapped("incremental", "", cameras(), n_placed, 9, ())

    right, wrong = match_rows(95), match_rows(5, "2.jpg")  # which has no place
    assert is_good(result(2), [right, wrong], 2)
    assert not is_good(result(2), [right, wrong, wrong], 2)
    assert not is_good(result(2), [right], 3)
    assert not is_good(result(2), [], 2)


def test_the_model_that_explains_more_is_better_then_the_one_with_more_points():
    results = [
        Mapped("incremental", "standard", cameras(), 2, 100, ()),
        Mapped("global", "standard", cameras(shift=2.0), 2, 900, ()),
        Mapped("global", "dense", cameras(), 2, 101, ()),
        Mapped("incremental", "dense", None, 0, 0, ()),
    ]
    best, others = choose(results, [match_rows(200)])
    assert (best.features, best.n_points, best.n_explained) == ("dense", 101, 200)
    assert [other.n_explained for other in others] == [200, 0, 0]
    assert choose(results[3:], [match_rows(200)])[0].model is None


@pytest.mark.parametrize(("n_more", "n_points"), [(2, 900), (3, 100)])
def test_a_hundredth_of_the_matches_is_no_difference(n_more, n_points):
    """The larger model explains n more of 200 matches, those of a third photograph."""
    results = [Mapped("global", "", cameras(2), 2, 900, ()), Mapped("global", "", cameras(3), 3, 100, ())]
    assert choose(results, [match_rows(200 - n_more), match_rows(n_more, "2.jpg")])[0].n_points == n_points


def test_cameras_of_too_few_points_are_taken_back(shots, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(mapping, "SEEN_MIN", 10_000)
    write_photographs(tmp_path / "photos", shots[:5], (24.0, 41.5, 24.0, 41.5, 24.0))
    code = run_sfm(tmp_path / "photos", tmp_path / "out", "--features", "standard")
    assert_refused(capsys, tmp_path, code, "no two photographs could be placed; take them with more overlap")


def test_a_single_camera_that_is_left_is_taken_back_too(shots, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(mapping, "_unsupported", lambda model: sorted(model.reg_frame_ids())[1:])
    write_photographs(tmp_path / "photos", shots[:5], (24.0, 41.5, 24.0, 41.5, 24.0))
    code = run_sfm(tmp_path / "photos", tmp_path / "out", "--features", "standard")
    assert_refused(capsys, tmp_path, code, "no two photographs could be placed; take them with more overlap")


def test_points_of_two_views_project_closely(shots, tmp_path, monkeypatch):
    monkeypatch.setattr(mapping, "PAIR_ERROR_MAX", 0.1)
    write_photographs(tmp_path / "photos", shots[:5], (24.0, 41.5, 24.0, 41.5, 24.0))
    assert run_sfm(tmp_path / "photos", tmp_path / "scene", "--features", "standard") == 0
    points = import_pycolmap().Reconstruction(tmp_path / "scene" / "sparse" / "0").points3D.values()
    errors = np.array([(point.track.length() == 2, point.error) for point in points])
    is_pair = errors[:, 0] == 1
    assert is_pair.any() and errors[is_pair, 1].max() <= 0.1 < errors[~is_pair, 1].max()


# real photographs


def run_on_banana(shared_data, tmp_path, names, *options):
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in names:
        shutil.copy(shared_data / "banana" / "images" / name, photos)
    return run_sfm(photos, tmp_path / "scene", *options)


def check_banana(shared_data, folder, n_min):
    """Cameras agree with those from larger photographs, up to a similarity, and the points with the pixels."""
    scene = load_scene(folder, test_every=0)
    truth = {view.name: view.camera for view in load_scene(shared_data / "banana", test_every=0).train_views}
    assert len(scene.train_views) >= n_min
    a, b = (
        centers([view.camera for view in scene.train_views]),
        centers([truth[view.name] for view in scene.train_views]),
    )
    scale, rotation, translation = similarity(a, b)
    errors = np.linalg.norm(scale * a @ rotation.T + translation - b, axis=1)
    assert errors.max() < SFM_CENTERS * np.linalg.norm(b - b.mean(axis=0), axis=1).max()
    error, shuffled = sparse_color_errors(scene)
    assert error < COLOR_RATIO * shuffled


def test_four_photographs(shared_data, tmp_path, capsys):
    assert run_on_banana(shared_data, tmp_path, [f"DSC_04{i}.jpg" for i in (23, 24, 25, 38)]) == 0
    out = capsys.readouterr().out
    assert "4 of 4 photographs" in out and "dense" not in out and "groups" not in out
    check_banana(shared_data, tmp_path / "scene", 4)
    assert sorted(path.name for path in (tmp_path / "scene").iterdir()) == ["images", "sparse", "up.json"]


@pytest.mark.slow
def test_all_photographs(shared_data, tmp_path):
    names = [path.name for path in (shared_data / "banana" / "images").iterdir()]
    assert run_on_banana(shared_data, tmp_path, names, "--features", "standard") == 0
    check_banana(shared_data, tmp_path / "scene", 14)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n", "n_points"), [("lund", 29, 3000), ("buddha", 13, 3500)])
def test_photographs_that_the_incremental_mapper_cannot_place(shared_data, tmp_path, capsys, name, n, n_points):
    assert run_sfm(shared_data / name / "photos", tmp_path / "scene") == 0
    assert f": {n} of {n} photographs (100%), " in capsys.readouterr().out
    assert len(load_scene(tmp_path / "scene").points) > n_points


@pytest.mark.slow
def test_global_mapper_places_two_photographs_at_random(shared_data, tmp_path, capsys):
    """Standard features hardly connect two of the photographs: they see 7 and 1 points, off by 0.2 of the scene."""
    assert run_sfm(shared_data / "buddha" / "photos", tmp_path / "scene", "--features", "standard") == 0
    assert "\nwithout a place: 00052.jpg, 00060.jpg\n" in capsys.readouterr().out


# what is refused


def test_refused(tmp_path, capsys):
    photos = tmp_path / "photos"
    photos.mkdir()
    out = ["--out", str(tmp_path / "out")]
    assert_refused(capsys, tmp_path, main(["sfm", str(tmp_path / "nowhere"), *out]), "no such folder; give a folder")
    assert_refused(capsys, tmp_path, main(["sfm", str(photos), *out]), "no images in it (looked for .png .jpg")
    write_image(photos / "a.png", colored_image(1))
    assert_refused(
        capsys, tmp_path, main(["sfm", str(photos), *out]), "1 photograph, structure from motion needs at least 2"
    )
    write_image(photos / "b.png", colored_image(2))
    assert_refused(capsys, tmp_path, main(["sfm", str(photos), *out, "--long-side", "0"]), "--long-side is 0")
    assert_refused(
        capsys, tmp_path, main(["sfm", str(photos), *out]), "no two photographs could be placed; take them with more"
    )
    write_image(photos / "b.jpg", colored_image(2))
    (photos / "b.png").rename(photos / "b.bmp")
    assert_refused(
        capsys, tmp_path, main(["sfm", str(photos), *out]), "another photograph is called b.jpg; give each its own"
    )
    (photos / "b.bmp").unlink()
    (photos / "b.jpg").write_text("no image")
    assert_refused(capsys, tmp_path, main(["sfm", str(photos), *out]), "b.jpg: not an image that Pillow can read")


def test_photographs_that_colmap_leaves_out_are_named(tmp_path, capsys, monkeypatch):
    (tmp_path / "photos").mkdir()
    for i in range(3):
        write_image(tmp_path / "photos" / f"{i}.jpg", colored_image(i))
    pycolmap = import_pycolmap()
    original = pycolmap.extract_features

    def without_the_second(database, images, names, *rest, **named):
        original(database, images, [name for name in names if name != "1.jpg"], *rest, **named)

    monkeypatch.setattr(pycolmap, "extract_features", without_the_second)
    code = run_sfm(tmp_path / "photos", tmp_path / "out")
    assert_refused(capsys, tmp_path, code, "photos: COLMAP could not read 1.jpg; convert to JPEG again, or remove")
