"""Small scenes on disk, written by hand so that every number in them is known."""

import json

import numpy as np

from minisplat_ref.io.images import write_image

WIDTH, HEIGHT = 32, 24
PINHOLE = (40.0, 42.0, 15.5, 12.25)  # fx, fy, cx, cy
DISTORTED = (40.0, 42.0, 16.0, 12.0, 0.1, -0.05, 0.004, -0.003)  # OPENCV


def colored_image(index, width=WIDTH, height=HEIGHT):
    """One flat colour per image, so that a mix-up shows."""
    return np.full((height, width, 3), (10 * index, 20 * index, 255 - 10 * index), np.uint8)


def write_colmap(
    folder, *, n=4, model="PINHOLE", params=PINHOLE, names=None, image_size=None, camera_size=(WIDTH, HEIGHT)
):
    """A COLMAP text model with n cameras on the x axis, looking along +z, and three points."""
    names = names or [f"{i:04d}.png" for i in range(n)]
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    numbers = " ".join(map(repr, params))
    (sparse / "cameras.txt").write_text(f"# comment\n1 {model} {camera_size[0]} {camera_size[1]} {numbers}\n")
    poses = [f"{i + 1} 1 0 0 0 {-float(i)} 0 0 1 {name}\n\n" for i, name in enumerate(names)]
    (sparse / "images.txt").write_text("".join(reversed(poses)))  # not in the order of their names
    points = ["7 0 0 5 255 0 0 0.5", "3 1 0 5 0 255 0 0.5", "9 0 1 5 0 0 255 0.5"]
    (sparse / "points3D.txt").write_text("".join(f"{point}\n" for point in points))
    for i, name in enumerate(names):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / "images" / name, colored_image(i, *(image_size or camera_size)))
    return folder


def looking_at_origin(azimuth, distance=5.0):
    """world_from_camera in OpenGL axes: on a circle in the xz plane, y up, looking at the origin."""
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    return [
        [cos, 0.0, sin, distance * sin],
        [0.0, 1.0, 0.0, 0.0],
        [-sin, 0.0, cos, distance * cos],
        [0.0, 0.0, 0.0, 1.0],
    ]


def write_transforms(folder, *, n=4, name="transforms.json", images="images", suffix=".png", listed=".png", **top):
    """A transforms.json with n cameras on a quarter circle; entries of ``top`` stand beside the frames."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(n):
        frames.append({"file_path": f"{images}/{i:04d}{listed}", "transform_matrix": looking_at_origin(0.5 * i)})
        (folder / images).mkdir(exist_ok=True)
        write_image(folder / images / f"{i:04d}{suffix}", colored_image(i))
    (folder / name).write_text(json.dumps({**top, "frames": frames}))
    return folder


def edit_transforms(file, change):
    """Apply a function to the content of a transforms.json."""
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def sparse_color_errors(scene):
    """Mean difference in levels between the colours of sparse points and the pixels where they are seen.

    The second number is the same with the colours shuffled: a wrong frame, pairing of images or axis comes near it.
    """
    errors, shuffled = [], []
    for view in scene.train_views:
        camera = view.camera
        x, y, z = (scene.points @ camera.cam_from_world_R.T + camera.cam_from_world_t).T
        u = np.floor(camera.fx * x / z + camera.cx).astype(int)
        v = np.floor(camera.fy * y / z + camera.cy).astype(int)
        is_inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        assert is_inside.mean() > 0.05
        found, expected = (
            a.astype(float) for a in (view.image[v[is_inside], u[is_inside]], scene.point_colors[is_inside])
        )
        errors.append(np.abs(found - expected).mean())
        shuffled.append(np.abs(found - np.roll(expected, len(expected) // 2, axis=0)).mean())
    return np.mean(errors), np.mean(shuffled)


def assert_refused(capsys, folder, code, message):
    """Exit code 2, one line that says why, and nothing new in the folder."""
    assert code == 2
    error = capsys.readouterr().err
    assert error.startswith("minisplat-ref: error: ") and error.count("\n") == 1
    assert message in error
    assert not [path for path in folder.rglob("*") if path.name.startswith(".") or path.name == "out"]
