"""COLMAP scenes: cameras, points, masks, downscaling, undistortion."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from minisplat_ref.errors import InputError, InputWarning
from minisplat_ref.io import load_colmap, load_scene
from minisplat_ref.io.images import resize_image, write_image
from minisplat_ref.io.lens import import_pycolmap
from photo_scenes import DISTORTED, HEIGHT, PINHOLE, WIDTH, colored_image, sparse_color_errors, write_colmap
from tolerances import CAMERA_TEXT, CLOSED_FORM, COLOR_RATIO, SCENE_INFO, UNDISTORTED_LEVELS


def views_of(scene):
    return {view.name: view for view in (*scene.train_views, *scene.test_views)}


# Closed form


@pytest.mark.parametrize("offset", [0, 1, 2])
def test_folds_by_hand(tmp_path, offset):
    """Seven photographs and K = 3: each is held out once, and the other folds train on it."""
    folds = ["0000", "0003", "0006"], ["0001", "0004"], ["0002", "0005"]
    scene = load_scene(write_colmap(tmp_path, n=7), test_every=3, offset=offset)
    assert [view.name for view in scene.test_views] == folds[offset]
    others = [name for fold in folds if fold is not folds[offset] for name in fold]
    assert [view.name for view in scene.train_views] == sorted(others)


@pytest.mark.parametrize(("test_every", "offset"), [(3, 3), (3, -1), (0, 1)])
def test_an_offset_beyond_the_folds(tmp_path, test_every, offset):
    with pytest.raises(InputError, match=f"offset is {offset}; the first held-out"):
        load_scene(write_colmap(tmp_path), test_every=test_every, offset=offset)


def test_cameras_points_and_split_by_hand(tmp_path):
    scene = load_colmap(write_colmap(tmp_path / "shelf", n=5), test_every=3)
    assert scene.name == "shelf"
    assert [view.name for view in scene.train_views] == ["0001", "0002", "0004"]
    assert [view.name for view in scene.test_views] == ["0000", "0003"]
    for name, view in views_of(scene).items():
        camera, i = view.camera, int(name)
        assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (*PINHOLE, WIDTH, HEIGHT)
        assert camera.cam_from_world_R.dtype == camera.cam_from_world_t.dtype == np.float64
        np.testing.assert_array_equal(camera.cam_from_world_R, np.eye(3))
        np.testing.assert_array_equal(camera.cam_from_world_t, [-i, 0, 0])
        np.testing.assert_array_equal(view.image, colored_image(i))
        assert view.mask is None
    np.testing.assert_array_equal(scene.points, [[1, 0, 5], [0, 0, 5], [0, 1, 5]])  # by id
    np.testing.assert_array_equal(scene.point_colors, [[0, 255, 0], [255, 0, 0], [0, 0, 255]])
    centers = np.array([1.0, 2.0, 4.0])  # training cameras only
    assert scene.extent == pytest.approx(1.1 * (4.0 - centers.mean()), rel=CLOSED_FORM)
    np.testing.assert_array_equal(scene.background, np.zeros(3))


def test_rotation_and_simple_pinhole_by_hand(tmp_path):
    write_colmap(tmp_path, model="SIMPLE_PINHOLE", params=(40.0, 16.0, 12.0))
    half = math.sqrt(0.5)  # wxyz of 90 degrees about y: camera z is world -x
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace("1 1 0 0 0", f"1 {half!r} 0 {half!r} 0"))
    camera = views_of(load_colmap(tmp_path))["0000"].camera
    np.testing.assert_allclose(camera.cam_from_world_R, [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=CLOSED_FORM)
    assert (camera.fx, camera.fy) == (40.0, 40.0)


def test_tracks_say_which_view_sees_which_point(tmp_path):
    sparse = write_colmap(tmp_path) / "sparse" / "0"
    assert all(view.point_ids is None for view in views_of(load_colmap(tmp_path)).values())  # no tracks: not known
    tracks = {7: "1 0 3 0", 3: "1 1 1 2", 9: "3 1 1 3"}  # pairs of image and observation; image 1 has point 3 twice
    lines = (sparse / "points3D.txt").read_text().splitlines()
    (sparse / "points3D.txt").write_text("".join(f"{line} {tracks[int(line.split()[0])]}\n" for line in lines))
    seen = {1: "1 1 7 2 2 3 3 3 3 4 4 9", 3: "1 1 7 2 2 9"}  # x, y and point of each observation
    poses = [line for line in (sparse / "images.txt").read_text().splitlines() if line]
    (sparse / "images.txt").write_text("".join(f"{pose}\n{seen.get(int(pose.split()[0]), '')}\n" for pose in poses))
    views = views_of(load_colmap(tmp_path))
    for name, rows in {"0000": [0, 1, 2], "0001": [], "0002": [1, 2], "0003": []}.items():  # points sorted by id
        np.testing.assert_array_equal(views[name].point_ids, rows)


def test_no_test_views(tmp_path):
    scene = load_colmap(write_colmap(tmp_path), test_every=0)
    assert len(scene.train_views) == 4 and scene.test_views == ()


def test_sparse_without_zero_and_folders_of_images(tmp_path):
    write_colmap(tmp_path, names=["left/a.png", "left/b.png", "right/a.png", "right/b.png"])
    for file in (tmp_path / "sparse" / "0").iterdir():
        file.rename(tmp_path / "sparse" / file.name)
    scene = load_colmap(tmp_path, test_every=4)
    assert [view.name for view in scene.test_views] == ["images_left_a"]
    assert [view.name for view in scene.train_views] == ["images_left_b", "images_right_a", "images_right_b"]


def test_zero_distortion_is_a_pinhole(tmp_path):
    write_colmap(tmp_path, model="OPENCV", params=(*PINHOLE, 0, 0, 0, 0))
    assert views_of(load_colmap(tmp_path))["0000"].camera[2:6] == PINHOLE


# Real scenes


@pytest.mark.parametrize("name", ["fox", "banana", "brighton_beach"])
def test_real_scene_agrees_with_its_description(shared_data, name):
    info = json.loads((shared_data / name / "scene_info.json").read_text())
    scene = load_scene(shared_data / name)
    assert len(scene.train_views) + len(scene.test_views) == info["images"]
    assert [view.name + ".jpg" for view in scene.test_views] == info["test_split_llffhold8"]
    assert scene.points.shape == scene.point_colors.shape == (info["points"], 3)
    everything = load_scene(shared_data / name, test_every=0)
    assert everything.extent == pytest.approx(info["camera_extent_radius"], abs=SCENE_INFO)
    for view in everything.train_views:
        np.testing.assert_allclose(view.camera[2:6], info["fx_fy_cx_cy"], atol=SCENE_INFO)
        assert view.image.shape == (info["height"], info["width"], 3)


def test_real_views_see_their_points(shared_data):
    scene = load_scene(shared_data / "banana", test_every=0)
    for view in scene.train_views:
        camera, ids = view.camera, view.point_ids
        assert len(ids) > 20 and (np.diff(ids) > 0).all()
        x, y, z = (scene.points[ids] @ camera.cam_from_world_R.T + camera.cam_from_world_t).T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        assert (z > 0).all() and (u > 0).all() and (u < camera.width).all() and (v > 0).all()
        assert (v < camera.height).all()


def test_points_have_the_colours_of_the_images(shared_data):
    error, shuffled = sparse_color_errors(load_scene(shared_data / "banana", test_every=0))
    assert error < COLOR_RATIO * shuffled


def test_text_and_binary_agree(shared_data, tmp_path):
    (tmp_path / "images").symlink_to(shared_data / "banana" / "images")
    (tmp_path / "sparse").symlink_to(shared_data / "banana" / "sparse_txt")
    text, binary = load_scene(tmp_path), load_scene(shared_data / "banana")
    for a, b in zip(views_of(text).values(), views_of(binary).values(), strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.camera.cam_from_world_R, b.camera.cam_from_world_R, atol=CAMERA_TEXT)
        np.testing.assert_allclose(a.camera.cam_from_world_t, b.camera.cam_from_world_t, atol=CAMERA_TEXT)
        np.testing.assert_allclose(a.camera[2:8], b.camera[2:8], rtol=CAMERA_TEXT)
    np.testing.assert_allclose(text.points, binary.points, atol=CAMERA_TEXT)
    np.testing.assert_array_equal(text.point_colors, binary.point_colors)


# Downscaling


def test_downscaling_on_the_fly_scales_by_the_exact_ratio(tmp_path, rng):
    write_colmap(tmp_path)
    image = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    write_image(tmp_path / "images" / "0000.png", image)
    view = views_of(load_colmap(tmp_path, downscale=5))["0000"]  # 32x24 -> 6x5
    fx, fy, cx, cy = PINHOLE
    np.testing.assert_allclose(
        view.camera[2:8], [fx * 6 / 32, fy * 5 / 24, cx * 6 / 32, cy * 5 / 24, 6, 5], rtol=CLOSED_FORM
    )
    np.testing.assert_array_equal(view.image, resize_image(image, 6, 5))


@pytest.mark.parametrize("size", [(6, 4), (7, 5)])  # rounded down or up
def test_a_folder_of_downscaled_images_is_used(tmp_path, size):
    write_colmap(tmp_path)
    (tmp_path / "images_5").mkdir()
    for i in range(4):
        write_image(tmp_path / "images_5" / f"{i:04d}.png", colored_image(9 - i, *size))
    view = views_of(load_colmap(tmp_path, downscale=5))["0001"]
    np.testing.assert_array_equal(view.image, colored_image(8, *size))
    assert view.camera.fx == pytest.approx(PINHOLE[0] * size[0] / 32, rel=CLOSED_FORM)
    assert view.camera.cy == pytest.approx(PINHOLE[3] * size[1] / 24, rel=CLOSED_FORM)
    assert views_of(load_colmap(tmp_path))["0001"].image.shape == (HEIGHT, WIDTH, 3)


# Masks


def test_masks_and_alpha(tmp_path):
    write_colmap(tmp_path)
    left, top = np.zeros((2, HEIGHT, WIDTH), bool)
    left[:, : WIDTH // 2], top[: HEIGHT // 2] = True, True
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "0000.png.png", left)
    write_image(tmp_path / "masks" / "0001.png", left)
    transparent = np.dstack([colored_image(1), top.astype(np.uint8) * 255])
    write_image(tmp_path / "images" / "0001.png", transparent)
    write_image(tmp_path / "images" / "0002.png", transparent)
    views = views_of(load_colmap(tmp_path, background=(1, 1, 1)))
    np.testing.assert_array_equal(views["0000"].mask, left)
    np.testing.assert_array_equal(views["0001"].mask, left & top)
    np.testing.assert_array_equal(views["0002"].mask, top)
    np.testing.assert_array_equal(views["0002"].image, colored_image(1))  # masked, not composited
    assert views["0003"].mask is None
    small = views_of(load_colmap(tmp_path, downscale=4))["0000"]
    np.testing.assert_array_equal(small.mask, np.arange(8) < np.full((6, 1), 4))


def test_mask_of_another_size(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "0002.png", np.ones((5, 4), bool))
    with pytest.raises(InputError, match=r"masks/0002\.png: the mask is 4x5 but its image 0002\.png is 32x24; resize"):
        load_colmap(tmp_path)


# Lens distortion


def directions(camera, model, params):
    """x/z and y/z of every pixel centre of a COLMAP camera, [H, W, 2]."""
    pycolmap = import_pycolmap()
    lens = pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return lens.cam_from_img(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(camera.height, camera.width, 2)


def test_distortion_is_refused_with_the_way_out(tmp_path):
    write_colmap(tmp_path, model="OPENCV", params=DISTORTED)
    with pytest.raises(InputError, match=r"lens distortion \(camera model OPENCV\)") as caught:
        load_colmap(tmp_path)
    assert f"`minisplat-ref undistort {tmp_path} --out DIR`" in str(caught.value)


def test_undistorted_pixels_look_where_the_camera_says(tmp_path):
    """Paints the viewing direction into a distorted image; after undistortion a pinhole must find it at its pixels."""
    write_colmap(tmp_path, model="OPENCV", params=DISTORTED)
    camera = views_of(load_colmap(tmp_path, undistort=True))["0000"].camera._replace(width=WIDTH, height=HEIGHT)
    rays = directions(camera, "OPENCV", DISTORTED)  # [H, W, 2]
    painted = np.rint(128 + 200 * np.dstack([rays, np.zeros((HEIGHT, WIDTH))])).astype(np.uint8)
    write_image(tmp_path / "images" / "0000.png", painted)
    view = views_of(load_colmap(tmp_path, undistort=True))["0000"]
    camera = view.camera
    assert view.image.shape == (camera.height, camera.width, 3)
    assert (camera.fx, camera.fy) == DISTORTED[:2]
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    expected = 128 + 200 * np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=2)
    assert np.abs(view.image[..., :2] - expected).max() < UNDISTORTED_LEVELS
    half_a_pixel = 200 * 0.5 / camera.fx
    assert half_a_pixel > UNDISTORTED_LEVELS  # the test would see a shift of half a pixel


def test_masks_are_undistorted_along(tmp_path):
    write_colmap(tmp_path, model="OPENCV", params=DISTORTED)
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "0000.png", np.arange(WIDTH) < np.full((HEIGHT, 1), WIDTH // 2))
    view = views_of(load_colmap(tmp_path, undistort=True, downscale=2))["0000"]
    assert view.mask.shape == view.image.shape[:2] == (view.camera.height, view.camera.width)
    assert view.mask[:, : view.camera.width // 2 - 1].all() and not view.mask[:, view.camera.width // 2 + 1 :].any()


def test_panorama_has_no_pinhole(tmp_path):
    if not hasattr(import_pycolmap().CameraModelId, "EQUIRECTANGULAR"):
        pytest.skip("this pycolmap knows no panoramas")
    write_colmap(tmp_path, model="EQUIRECTANGULAR", params=(32.0, 24.0))
    with pytest.raises(InputError, match=r"png has camera model EQUIRECTANGULAR, a panorama, .*; cut pinhole views"):
        load_colmap(tmp_path, undistort=True)


def test_png_can_be_written_after_pycolmap_was_loaded():
    """pycolmap 4.2 loaded before Pillow makes the next PNG abort the process; ours must come in the right order."""
    code = "import io; from minisplat_ref.io.lens import import_pycolmap; import_pycolmap(); from PIL import Image;"
    code += "Image.effect_noise((300, 300), 50).save(io.BytesIO(), 'PNG')"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


# Bad input


def remove(*parts):
    return lambda folder: folder.joinpath(*parts).unlink()


def rewrite(name, old, new):
    def change(folder):
        file = folder / "sparse" / "0" / name
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new))

    return change


def write_small_image(folder):
    write_image(folder / "images" / "0002.png", colored_image(2, 8, 6))


def write_wrong_downscaled_image(folder):
    (folder / "images_2").mkdir()
    write_image(folder / "images_2" / "0001.png", colored_image(2, 8, 6))


BAD_SCENES = {
    "missing image": (remove("images", "0002.png"), {}, r"images/0002\.png: missing, but .*; add the image or remove"),
    "small image": (write_small_image, {}, r"images/0002\.png: the image is 8x6 but its camera is 32x24; put"),
    "wrong images_2": (
        write_wrong_downscaled_image,
        {"downscale": 2},
        r"images_2/0001\.png: the image is 8x6 but 1/2 of its camera is 16x12; "
        r"remove .*minisplat-ref downscale .*images",
    ),
    "no cameras": (
        remove("sparse", "0", "cameras.txt"),
        {},
        r"no COLMAP model, looked for .* run `minisplat-ref sfm",
    ),
    "no images": (
        remove("sparse", "0", "images.txt"),
        {},
        r"sparse/0: damaged or incomplete COLMAP model .*; copy or",
    ),
    "unknown model": (rewrite("cameras.txt", "PINHOLE", "PINGHOLE"), {}, "damaged or incomplete COLMAP model"),
    "cut numbers": (rewrite("cameras.txt", " 12.25", ""), {}, "damaged or incomplete COLMAP model"),
    "zero focal length": (
        rewrite("cameras.txt", "40.0", "0.0"),
        {},
        r"the camera of 0001\.png is not usable \(fx, .* are 0, 42",
    ),
    "NaN": (rewrite("cameras.txt", "15.5", "nan"), {}, r"damaged or incomplete|png is not usable \(fx"),  # by version
    "infinite pose": (rewrite("images.txt", " -2.0 ", " inf "), {}, r"damaged or incomplete|pose of 0002\.png is not"),
    "no empty lines": (
        rewrite("images.txt", "\n\n", "\n"),
        {},
        r"images\.txt: 4 images, of which 2 can be read: each needs a second line .* add the empty lines",
    ),
    "no last line": (
        rewrite("images.txt", "0000.png\n\n", "0000.png\n"),
        {},
        r"images\.txt: 4 images, of which 3 can be read: each needs a second line",
    ),
    "all held out": (
        lambda folder: None,
        {"test_every": 1},
        r"0 training and 4 test view\(s\), training needs at least 2; add",
    ),
    "negative split": (lambda folder: None, {"test_every": -1}, r"test_every is -1; it must be 0"),
    "downscale 0": (lambda folder: None, {"downscale": 0}, r"downscale is 0; it must be a whole number"),
    "downscale 1.5": (lambda folder: None, {"downscale": 1.5}, r"downscale is 1\.5; it must be a whole number"),
    "background": (lambda folder: None, {"background": (255, 0, 0)}, r"background is \(255, 0, 0\); it must be three"),
}


@pytest.mark.parametrize("name", BAD_SCENES)
def test_bad_scene(tmp_path, name):
    change, arguments, message = BAD_SCENES[name]
    change(write_colmap(tmp_path))
    with pytest.raises(InputError, match=message) as caught:
        load_colmap(tmp_path, **arguments)
    assert "\n" not in str(caught.value)


def test_heading_of_a_text_model_states_more_images(tmp_path, recwarn):
    """A model that was cut, or shortened by hand."""
    images = write_colmap(tmp_path) / "sparse" / "0" / "images.txt"
    lines = images.read_text()
    images.write_text(f"# Number of images: 4, mean observations per image: 0\n{lines}")
    assert len(load_colmap(tmp_path, test_every=0).train_views) == 4
    assert not recwarn.list
    images.write_text(f"# Number of images: 8, mean observations per image: 0\n{lines}")
    with pytest.warns(InputWarning, match=r"images\.txt: 4 images, though its heading says 8; export the model again"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("n", [1, 2])
def test_too_few_views(tmp_path, n):
    with pytest.raises(InputError, match=rf"{n - 1} training and 1 test view\(s\), training needs at least 2"):
        load_colmap(write_colmap(tmp_path, n=n))


def test_all_cameras_at_one_point(tmp_path):
    write_colmap(tmp_path)
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text("".join(f"{i + 1} 1 0 0 0 1 2 3 1 {i:04d}.png\n\n" for i in range(4)))
    with pytest.raises(InputError, match="all training cameras stand at one point, which shows no depth; move"):
        load_colmap(tmp_path)


def test_equal_names(tmp_path):
    write_colmap(tmp_path, names=["a.png", "a.jpg", "b.png", "c.png"])
    with pytest.raises(InputError, match="2 images are called images_a; give each its own name"):
        load_colmap(tmp_path)


def test_no_folder_of_images(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photos")
    with pytest.raises(InputError, match="no folder images/; put the photographs there"):
        load_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("part", [0.0, 0.5, 0.999])
def test_truncated_binary(shared_data, tmp_path, name, part):
    (tmp_path / "images").symlink_to(shared_data / "banana" / "images")
    (tmp_path / "sparse").mkdir()
    for file in (shared_data / "banana" / "sparse" / "0").iterdir():
        content = file.read_bytes()
        (tmp_path / "sparse" / file.name).write_bytes(
            content[: int(part * len(content))] if file.name == name else content
        )
    with pytest.raises(InputError, match=rf"({name}: truncated|sparse: damaged or incomplete).*; copy") as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("n_bytes", [0, 20, -20])
def test_truncated_frames(tmp_path, n_bytes):
    """The five-file form that COLMAP 4 writes; pycolmap itself loops for ever on some of these."""
    sparse = write_colmap(tmp_path) / "sparse" / "0"
    import_pycolmap().Reconstruction(sparse).write_binary(sparse)
    assert len(load_colmap(tmp_path).train_views) == 3
    (sparse / "frames.bin").write_bytes((sparse / "frames.bin").read_bytes()[:n_bytes])
    with pytest.raises(InputError, match=r"frames\.bin: truncated at \d+ bytes; copy"):
        load_colmap(tmp_path)


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: no such folder"):
        load_scene(tmp_path / "nowhere")
    looked_for = "sparse/0/cameras.bin or .txt, sparse/cameras.bin or .txt, transforms_train.json, transforms.json,"
    looked_for += " poses_bounds.npy;"
    with pytest.raises(
        InputError, match=f"no scene here, looked for {looked_for} .*minisplat-ref sfm PHOTOS --out SCENE"
    ):
        load_scene(tmp_path)


def test_pycolmap_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pycolmap, .* is not installed: pip install 'minisplat_ref\[photos\]'"):
        load_colmap(write_colmap(tmp_path))
