"""transforms.json in its three dialects."""

import json
import math
import shutil

import numpy as np
import pytest

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import load_scene, load_transforms
from minisplat_ref.io.images import write_image
from minisplat_ref.io.ply import write_vertices
from minisplat_ref.io.transforms import find_frames, read_transforms
from photo_scenes import HEIGHT, WIDTH, colored_image, edit_transforms, sparse_color_errors, write_transforms
from tolerances import CLOSED_FORM, COLOR_RATIO, FOX_CENTERS, FOX_ROTATIONS, SAME_CAMERAS

NERFSTUDIO = {"fl_x": 40.0, "fl_y": 42.0, "cx": 15.5, "cy": 12.25, "w": WIDTH, "h": HEIGHT}


def views_of(scene):
    return {view.name: view for view in (*scene.train_views, *scene.test_views)}


def project(camera, point):
    x, y, z = camera.cam_from_world_R @ point + camera.cam_from_world_t
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z


def center_of(camera):
    return -camera.cam_from_world_R.T @ camera.cam_from_world_t


# Closed form


def test_opengl_axes_become_opencv_axes(tmp_path):
    """The first camera stands at z = 5 and looks along -z: world right is right, world up is up."""
    write_transforms(tmp_path, **NERFSTUDIO)
    camera = views_of(load_transforms(tmp_path))["0000"].camera
    np.testing.assert_allclose(camera.cam_from_world_R, np.diag([1.0, -1.0, -1.0]), atol=CLOSED_FORM)
    np.testing.assert_allclose(camera.cam_from_world_t, [0.0, 0.0, 5.0], atol=CLOSED_FORM)
    assert project(camera, [0, 0, 0]) == pytest.approx((15.5, 12.25, 5.0), abs=CLOSED_FORM)
    assert project(camera, [1, 0, 0]) == pytest.approx((15.5 + 40 / 5, 12.25, 5.0), abs=CLOSED_FORM)
    assert project(camera, [0, 1, 0]) == pytest.approx((15.5, 12.25 - 42 / 5, 5.0), abs=CLOSED_FORM)
    assert camera.cam_from_world_R.dtype == camera.cam_from_world_t.dtype == np.float64


def test_all_cameras_look_at_the_origin_from_where_they_stand(tmp_path):
    scene = load_transforms(write_transforms(tmp_path, **NERFSTUDIO), test_every=0)
    for i, view in enumerate(scene.train_views):
        assert project(view.camera, [0, 0, 0]) == pytest.approx((15.5, 12.25, 5.0), abs=CLOSED_FORM)
        expected = [5 * math.sin(0.5 * i), 0, 5 * math.cos(0.5 * i)]
        np.testing.assert_allclose(center_of(view.camera), expected, atol=CLOSED_FORM)
    centers = np.stack([center_of(view.camera) for view in scene.train_views])
    radius = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert scene.extent == pytest.approx(1.1 * radius, rel=CLOSED_FORM)
    assert scene.points.shape == scene.point_colors.shape == (0, 3)


# Blender


def write_blender(folder, rng):
    for split, n in (("train", 3), ("test", 2)):
        write_transforms(
            folder, n=n, name=f"transforms_{split}.json", images=split, listed="", camera_angle_x=2 * math.atan(0.5)
        )
        for i in range(n):
            rgba = np.dstack([colored_image(i), np.zeros((HEIGHT, WIDTH), np.uint8)])
            rgba[: HEIGHT // 2, :, 3] = 255
            write_image(folder / split / f"{i:04d}.png", rgba)
    return folder


@pytest.mark.parametrize("background", [None, (1.0, 1.0, 1.0), (0.0, 1.0, 0.2)])
def test_blender(tmp_path, rng, background):
    write_blender(tmp_path, rng)
    scene = load_transforms(tmp_path, background=background)
    assert [view.name for view in scene.train_views] == ["train_0000", "train_0001", "train_0002"]
    assert [view.name for view in scene.test_views] == ["test_0000", "test_0001"]
    np.testing.assert_array_equal(scene.background, background or (0, 0, 0))
    for view in scene.train_views:
        assert view.camera[2:8] == pytest.approx((32.0, 32.0, 16.0, 12.0, 32, 24), rel=CLOSED_FORM)  # square pixels
        assert view.mask is None
        np.testing.assert_array_equal(view.image[: HEIGHT // 2], colored_image(int(view.name[-4:]))[: HEIGHT // 2])
        assert (view.image[HEIGHT // 2 :] == np.rint(255 * scene.background)).all()
    assert load_transforms(tmp_path, test_every=0).test_views == ()


def test_random_points_of_a_blender_scene_fill_its_cube(tmp_path, rng):
    """Of a Blender scene alone: other exports of that file's name have other units."""
    write_blender(tmp_path / "blender", rng)
    scene = load_transforms(tmp_path / "blender")
    np.testing.assert_array_equal(scene.random_box, [[-1.3] * 3, [1.3] * 3])
    (tmp_path / "other").mkdir()
    write_transforms(tmp_path / "other", name="transforms_train.json", fl_x=32.0)
    assert load_transforms(tmp_path / "other").random_box is None


def test_folds_of_photographs_that_are_held_out_already(tmp_path, rng):
    write_blender(tmp_path, rng)
    with pytest.raises(InputError, match=r"transforms_test\.json says which .* give .*transforms_train\.json as"):
        load_scene(tmp_path, test_every=2, offset=1)
    with pytest.warns(InputWarning, match=r"transforms_test\.json is not used, 2 of its images are in no other file"):
        scene = load_scene(tmp_path / "transforms_train.json", test_every=3, offset=1)
    assert [view.name for view in scene.test_views] == ["0001"]


def test_blender_points(tmp_path, rng):
    write_blender(tmp_path, rng)
    write_vertices(tmp_path / "points3d.ply", {"x": np.array([1.0]), "y": np.array([2.0]), "z": np.array([3.0])})
    with pytest.warns(InputWarning, match=r"points3d\.ply has no red, green, blue: its points are gray"):
        np.testing.assert_array_equal(load_transforms(tmp_path).points, [[1, 2, 3]])


def test_points_that_are_not_finite(tmp_path):
    write_transforms(tmp_path, name="transforms_train.json", camera_angle_x=0.7)
    write_vertices(tmp_path / "points3d.ply", {name: np.array([np.nan, 2.0, 3.0]) for name in "xyz"})
    gray = pytest.warns(InputWarning, match=r"points3d\.ply has no red, green, blue: its points are gray")
    with gray, pytest.warns(UserWarning, match=r"points3d\.ply: 1 of 3 points are not finite and left out"):
        scene = load_transforms(tmp_path)
    np.testing.assert_array_equal(scene.points, [[2, 2, 2], [3, 3, 3]])
    assert (scene.point_colors == 128).all()


def test_real_blender_scene(shared_data):
    scene = load_scene(shared_data / "banana_blender", background=(1, 1, 1))
    assert (len(scene.train_views), len(scene.test_views)) == (12, 3)
    assert scene.points.shape == (1589, 3)
    for view in scene.train_views:
        assert (view.camera.width, view.camera.height) == (340, 226)
        assert 5.2 < np.linalg.norm(center_of(view.camera)) < 8.6
        assert (view.image[0, 0] == 255).all()
    assert (load_scene(shared_data / "banana_blender").train_views[0].image[0, 0] == 0).all()
    error, shuffled = sparse_color_errors(scene)
    assert error < COLOR_RATIO * shuffled


# nerfstudio


def test_intrinsics_per_frame_masks_and_points(tmp_path):
    write_transforms(tmp_path, **NERFSTUDIO, ply_file_path="sparse_pc.ply", applied_transform=[[0, 1, 0, 9]] * 3)
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], np.float32)
    write_vertices(tmp_path / "sparse_pc.ply", dict(zip("xyz", points.T, strict=True)))
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, 3:] = True
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "one.png", mask)

    def change(content):
        content["frames"][1] |= {"fl_x": 50.0, "cx": 14.0, "mask_path": "masks/one.png", "w": 16}

    edit_transforms(tmp_path / "transforms.json", change)
    write_image(tmp_path / "images" / "0001.png", colored_image(1, 16, HEIGHT))
    write_image(tmp_path / "masks" / "one.png", mask[:, :16])
    with pytest.warns(InputWarning, match=r"sparse_pc\.ply has no red, green, blue: its points are gray"):
        scene = load_transforms(tmp_path)
    views = views_of(scene)
    assert views["0001"].camera[2:8] == (50.0, 42.0, 14.0, 12.25, 16, HEIGHT)
    np.testing.assert_array_equal(views["0001"].mask, mask[:, :16])
    assert views["0002"].camera[2:8] == (40.0, 42.0, 15.5, 12.25, WIDTH, HEIGHT)
    assert views["0002"].mask is None
    np.testing.assert_array_equal(scene.points, points)  # applied_transform has been applied already
    np.testing.assert_allclose(center_of(views["0000"].camera), [0, 0, 5], atol=CLOSED_FORM)


def test_downscaling(tmp_path):
    write_transforms(tmp_path, **NERFSTUDIO)
    (tmp_path / "images_2").mkdir()
    for i in range(4):
        write_image(tmp_path / "images_2" / f"{i:04d}.png", colored_image(9 - i, 16, 12))
    view = views_of(load_transforms(tmp_path, downscale=2))["0001"]
    np.testing.assert_array_equal(view.image, colored_image(8, 16, 12))
    assert view.camera[2:8] == (20.0, 21.0, 7.75, 6.125, 16, 12)


# instant-ngp


def test_missing_images_are_named_and_skipped(tmp_path):
    write_transforms(tmp_path, n=6, suffix=".jpg", listed="", aabb_scale=4, camera_angle_x=1.0, camera_angle_y=0.7)

    def change(content):
        content["frames"][1]["file_path"] = "images\\0001"

    edit_transforms(tmp_path / "transforms.json", change)
    for i in (2, 5):
        (tmp_path / "images" / f"{i:04d}.jpg").unlink()
    with pytest.warns(UserWarning, match="2 of 6 images are missing and skipped: images/0002, images/0005$"):
        scene = load_transforms(tmp_path)
    assert sorted(views_of(scene)) == ["0000", "0001", "0003", "0004"]
    fx, fy = WIDTH / 2 / math.tan(0.5), HEIGHT / 2 / math.tan(0.35)
    assert scene.train_views[0].camera[2:6] == pytest.approx((fx, fy, 16.0, 12.0), rel=CLOSED_FORM)


def test_upstream_fox_lacks_17_images(shared_data):
    with pytest.warns(UserWarning, match=r"17 of 67 images are missing and skipped: images/0005\.jpg, ") as caught:
        scene = load_scene(
            shared_data / "fox" / "transforms_distorted" / "transforms_upstream_67frames.json", undistort=True
        )
    assert len(scene.train_views) + len(scene.test_views) == 50
    assert len(caught) == 1 and "\n" not in str(caught[0].message)


def test_no_image_exists(tmp_path):
    write_transforms(tmp_path, **NERFSTUDIO)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(InputError, match=r"transforms\.json: none of its 4 images exists, first images/0000\.png; put"):
        load_transforms(tmp_path)


# fox: three descriptions of one scene


def test_fox_agrees_with_colmap(shared_data):
    colmap = load_scene(shared_data / "fox")
    transforms = load_scene(shared_data / "fox" / "transforms.json")
    assert colmap.extent == pytest.approx(transforms.extent, rel=SAME_CAMERAS)
    for split in ("train_views", "test_views"):
        for a, b in zip(getattr(colmap, split), getattr(transforms, split), strict=True):
            assert a.name == b.name
            np.testing.assert_allclose(a.camera.cam_from_world_R, b.camera.cam_from_world_R, atol=SAME_CAMERAS)
            np.testing.assert_allclose(a.camera.cam_from_world_t, b.camera.cam_from_world_t, atol=SAME_CAMERAS)
            np.testing.assert_allclose(a.camera[2:8], b.camera[2:8], rtol=SAME_CAMERAS)
            np.testing.assert_array_equal(a.image, b.image)


def test_distorted_fox_agrees_up_to_a_similarity(shared_data):
    """Upstream's own calibration of the same photographs: another frame and scale, nearly the same cameras."""
    ours = load_scene(shared_data / "fox", test_every=0, downscale=8)
    theirs = load_scene(shared_data / "fox" / "transforms_distorted", test_every=0, undistort=True, downscale=8)
    assert [view.name for view in ours.train_views] == [view.name for view in theirs.train_views]
    views = list(zip(ours.train_views, theirs.train_views, strict=True))
    a, b = np.stack([(center_of(x.camera), center_of(y.camera)) for x, y in views], axis=1)  # [50, 3] each
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    a_from_b = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt  # best rotation of their world into ours
    scale = np.vdot(a, b @ a_from_b.T) / np.vdot(b, b)
    assert np.linalg.norm(a - scale * b @ a_from_b.T, axis=1).mean() < FOX_CENTERS * ours.extent
    traces = [np.vdot(x.camera.cam_from_world_R, y.camera.cam_from_world_R @ a_from_b.T) for x, y in views]
    assert np.degrees(np.arccos((np.array(traces) - 1) / 2)).mean() < FOX_ROTATIONS


# Lens distortion


@pytest.mark.parametrize(
    ("lens", "model"),
    [
        ({"k1": 0.01}, "OPENCV"),
        ({"p2": 1e-4}, "OPENCV"),
        ({"k3": 0.01}, "FULL_OPENCV"),
        ({"k3": -0.01}, "FULL_OPENCV"),
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"is_fisheye": True, "k1": 0.01}, "OPENCV_FISHEYE"),
    ],
)
def test_distortion_is_refused_or_undistorted(tmp_path, lens, model):
    write_transforms(tmp_path, **NERFSTUDIO, **lens)
    with pytest.raises(InputError, match=rf"lens distortion \(camera model {model}\).*undistort .* --out DIR`"):
        load_transforms(tmp_path)
    view = views_of(load_transforms(tmp_path, undistort=True))["0001"]
    assert view.image.shape == (view.camera.height, view.camera.width, 3)
    assert (view.image == colored_image(1)[0, 0]).all()


@pytest.mark.parametrize("lens", [{"camera_model": "EQUIRECTANGULAR"}, {"k4": 0.1}])
def test_lens_that_is_not_supported(tmp_path, lens):
    write_transforms(tmp_path, **NERFSTUDIO, **lens)
    with pytest.raises(InputError, match=r"camera_model .* with k4 = .* of images/0000\.png is not supported; undis"):
        load_transforms(tmp_path, undistort=True)


# Bad input


def first_frame(**entries):
    return lambda content: content["frames"][0].update(entries)


def test_times(tmp_path):
    """Of the frame, else of the whole file, else 0; the views of both sets have theirs."""
    write_transforms(tmp_path / "a", **NERFSTUDIO)
    edit_transforms(
        tmp_path / "a" / "transforms.json", lambda c: [f.update(time=i / 4) for i, f in enumerate(c["frames"])]
    )
    scene = load_scene(tmp_path / "a", test_every=2)
    assert [view.time for view in scene.test_views] == [0.0, 0.5]
    assert [view.time for view in scene.train_views] == [0.25, 0.75]
    write_transforms(tmp_path / "b", **NERFSTUDIO, time="0.5")
    edit_transforms(tmp_path / "b" / "transforms.json", first_frame(time=1))
    scene = load_scene(tmp_path / "b", test_every=0)
    assert [view.time for view in scene.train_views] == [1.0, 0.5, 0.5, 0.5]
    write_transforms(tmp_path / "c", **NERFSTUDIO)
    assert all(view.time == 0.0 for view in load_scene(tmp_path / "c", test_every=0).train_views)


BAD_FILES = {
    "no frames": (lambda content: content.pop("frames"), "no list 'frames'"),
    "empty frames": (lambda content: content.update(frames=[]), "no list 'frames'"),
    "no file_path": (lambda content: content["frames"][2].pop("file_path"), "frame 2 has no file_path; add it"),
    "no matrix": (
        lambda content: content["frames"][2].pop("transform_matrix"),
        r"transform_matrix of images/0002\.png",
    ),
    "3x3 matrix": (first_frame(transform_matrix=np.eye(3).tolist()), r"images/0000\.png is not 4x4; repair"),
    "words": (first_frame(transform_matrix=[["a"] * 4] * 4), r"images/0000\.png is not 4x4; repair"),
    "scaled": (first_frame(transform_matrix=(2 * np.eye(4)).tolist()), r"the pose of 0000\.png is not a rotation"),
    "mirrored": (
        first_frame(transform_matrix=np.diag([-1.0, 1, 1, 1]).tolist()),
        r"the pose of 0000\.png is not a rotation",
    ),
    "NaN": (first_frame(transform_matrix=np.full((4, 4), np.nan).tolist()), r"the pose of 0000\.png is not a rotation"),
    "no focal length": (lambda content: content.pop("fl_x"), "neither fl_x nor camera_angle_x; add one"),
    "focal length in words": (first_frame(fl_x="wide"), r"fl_x of images/0000\.png is 'wide', not a number"),
    "NaN focal length": (first_frame(fl_y=math.nan), r"the camera of 0000\.png is not usable \(.* 40, nan, 15\.5"),
    "other size": (lambda content: content.update(w=64), "the image is 32x24 but its camera is 64x24; put"),
    "missing mask": (first_frame(mask_path="m.png"), r"m\.png: no such image"),
    "missing points": (
        lambda content: content.update(ply_file_path="p.ply"),
        r"p\.ply: missing, but .* remove ply_file_path",
    ),
    "one view": (lambda content: content.update(frames=content["frames"][:1]), "0 training and 1 test view"),
    "time in words": (first_frame(time="noon"), r"images/0000\.png has the time 'noon': give a number"),
    "no time": (first_frame(time=None), r"images/0000\.png has the time None: give a number"),
    "time that is NaN": (first_frame(time=math.nan), r"images/0000\.png has the time nan: give a number"),
    "time without end": (lambda content: content.update(time=math.inf), r"images/0000\.png has the time inf"),
    "same image twice": (
        lambda content: content["frames"].append(content["frames"][1]),
        "2 images are called images_0001; give each its own name",
    ),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file(tmp_path, name):
    change, message = BAD_FILES[name]
    write_transforms(tmp_path, **NERFSTUDIO)
    edit_transforms(tmp_path / "transforms.json", change)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(tmp_path)
    assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_not_json(tmp_path):
    write_transforms(tmp_path, **NERFSTUDIO)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(text[: len(text) // 2])
    with pytest.raises(InputError, match=r"transforms\.json: not valid JSON \(.*line 1 column .*\); copy"):
        load_scene(tmp_path)
    (tmp_path / "transforms.json").write_text(json.dumps([1, 2]))
    with pytest.raises(InputError, match="no list 'frames'"):
        load_scene(tmp_path)


def test_no_file(tmp_path):
    with pytest.raises(InputError, match=r"no transforms_train\.json or transforms\.json; give the folder"):
        load_transforms(tmp_path)


# lenses


def lens_of(folder, **entries):
    """The lens of the first frame of a file with these entries."""
    write_transforms(folder, fl_x=40.0, fl_y=42.0, cx=15.0, cy=12.0, **entries)
    (_, photo), *_ = find_frames(folder / "transforms.json", read_transforms(folder / "transforms.json"))
    return photo.lens


PINHOLE_OF_LENSES = (40.0, 42.0, 15.0, 12.0)


def test_coefficients_are_in_the_order_of_colmap(tmp_path):
    """k1, k2, p1, p2, then k3; of a fisheye k1 to k4."""
    given = {"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}
    assert lens_of(tmp_path / "a", **given) == ("OPENCV", (*PINHOLE_OF_LENSES, 0.1, 0.2, 0.3, 0.4))
    full = lens_of(tmp_path / "b", **given, k3=0.5)
    assert full == ("FULL_OPENCV", (*PINHOLE_OF_LENSES, 0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0))
    fisheye = lens_of(tmp_path / "c", k1=0.1, k2=0.2, k3=0.3, k4=0.4, camera_model="opencv_fisheye")
    assert fisheye == ("OPENCV_FISHEYE", (*PINHOLE_OF_LENSES, 0.1, 0.2, 0.3, 0.4))
    assert lens_of(tmp_path / "d", camera_model="Pinhole") is None


PARALLEL = {"camera_model": "AFFINE", "shear": 0.1, "metres_per_unit": 48.0}


def test_parallel_rays(tmp_path):
    """Shear, metres and the sun are those of affine optics; the extent is half the largest diagonal in world units."""
    assert lens_of(tmp_path / "a", **PARALLEL) == ("AFFINE", (*PINHOLE_OF_LENSES, 0.1, 48.0, 0.0, 0.0, 0.0))
    assert lens_of(tmp_path / "b", **PARALLEL, sun=[3, -4, 5])[1][4:] == (0.1, 48.0, 3.0, -4.0, 5.0)
    write_transforms(tmp_path, **NERFSTUDIO, **PARALLEL, sun=[3, -4, 5])
    for undistort in (False, True):
        with pytest.raises(InputError, match=r"rays of 000\d\.png are parallel .*train with --recipe satellite"):
            load_transforms(tmp_path, undistort=undistort)
    scene = load_transforms(tmp_path, as_photographed=True)
    cameras = [view.camera for view in scene.train_views]
    assert all(camera.optics == ("affine", (0.1, 48.0, 3.0, -4.0, 5.0)) for camera in cameras)
    assert scene.extent == max(np.hypot(c.width / c.fx, c.height / c.fy) for c in cameras) / 2


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"metres_per_unit": 0.0}, "metres_per_unit of .* is not above 0"),
        ({"metres_per_unit": float("nan")}, "metres_per_unit of .* is not above 0"),
        ({"sun": [1, 2, 0]}, "sun of .* is no direction"),
        ({"sun": [1, 2]}, "sun of .* is no direction"),
        ({"sun": [float("nan"), 0, 1]}, "coefficients that are not finite"),
        ({"shear": float("inf")}, "coefficients that are not finite"),
        ({"shear": "x"}, "shear of .* is 'x', not a number"),
    ],
)
def test_bad_parallel_rays(tmp_path, entries, message):
    write_transforms(tmp_path, **{**NERFSTUDIO, **PARALLEL, **entries})
    with pytest.raises(InputError, match=message):
        load_transforms(tmp_path, as_photographed=True)
