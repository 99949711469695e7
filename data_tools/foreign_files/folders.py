"""Folders and projects of other programs: what is in them is opened, or the line names the export to use."""

import json
import shutil
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.foreign_files.building import OPTIONS, done, refused, room
from data_tools.foreign_files.dialects import N, gaussians
from data_tools.foreign_files.leftovers import as_transforms
from minisplat_ref.io import load_ply, load_scene, save_ply
from minisplat_ref.io.formats import sog
from minisplat_ref.io.ply_file import read_vertices
from minisplat_ref.types import Gaussians


def _shifted(by: float) -> Gaussians:
    return gaussians()._replace(means=gaussians().means + np.float32(by))


def _of_graphdeco(folder: Path, iterations: Sequence[int], below: str) -> None:
    """The newest iteration is read, by its number, with the cameras beside it."""
    run = folder / "output"
    for iteration in iterations:
        place = run / "point_cloud" / f"iteration_{iteration}"
        place.mkdir(parents=True)
        save_ply(place / "point_cloud.ply", _shifted(iteration / 1000))
    (run / "cfg_args").write_text("Namespace(sh_degree=3)")
    camera = {"id": 0, "img_name": "a", "width": 48, "height": 36, "fx": 40, "fy": 40}
    camera |= {"position": [0, 0, -8], "rotation": np.eye(3).tolist()}
    (run / "cameras.json").write_text(json.dumps([camera, {**camera, "img_name": "b"}]))
    said = done("convert", run / below, folder / "a.ply")
    assert f"iteration_{max(iterations)}" in said.err, said.err
    np.testing.assert_array_equal(load_ply(folder / "a.ply").means, _shifted(max(iterations) / 1000).means)
    assert f"Gaussians {N}" in " ".join(done("info", run / below).out.split())
    if not below:
        done("render", run, "--cameras", "all", "--out", folder / "views")
        assert len(list((folder / "views").glob("*.png"))) == 2
    done("render", run / below, "--frames", 1, "--size", "32x24", "--out", folder / "orbit")


def _unbundled(folder: Path, degree: int, as_file: bool) -> None:
    """A SOG that is not packed is that SOG."""
    content = sog.encode(gaussians(degree), 0)
    (folder / "packed.sog").write_bytes(content)
    (folder / "open").mkdir()
    with zipfile.ZipFile(folder / "packed.sog") as archive:
        archive.extractall(folder / "open")
    path = folder / "open" / "meta.json" if as_file else folder / "open"
    done("convert", path, folder / "a.ply")
    for value, other in zip(load_ply(folder / "a.ply"), sog.decode(content, "packed"), strict=True):
        np.testing.assert_array_equal(value, other)
    assert "SOG version" in done("info", path).out
    done("render", path, "--frames", 1, "--size", "32x24", "--out", folder / "views")
    (folder / "open" / "quats.webp").unlink()
    assert "quats.webp is not beside it" in refused("info", path, names="meta.json")


def _table(folder: Path, degree: int, end: str) -> None:
    """A table of splat-transform is the PLY of the same columns."""
    save_ply(folder / "a.ply", gaussians(degree))
    columns = read_vertices(folder / "a.ply")
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in rows)]
    (folder / "table.csv").write_text(end.join(lines) + end, newline="")
    for value, other in zip(load_ply(folder / "table.csv"), gaussians(degree), strict=True):
        np.testing.assert_array_equal(value, other)
    assert f"Gaussians {N}" in " ".join(done("info", folder / "table.csv").out.split())
    done("convert", folder / "table.csv", folder / "b.spz")
    (folder / "torn.csv").write_text(end.join(lines[:5]) + end + "1,2")
    assert "row 4 is not" in refused("info", folder / "torn.csv", names=folder / "torn.csv")


def _model_refused(folder: Path, names: Sequence[str], content: str, says: str, given: str) -> None:
    """What needs its program is refused by every command in a line that names the export."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    path = folder / given
    for arguments in (("info", path), ("render", path), ("convert", path, folder / "a.ply")):
        assert says in refused(*arguments, names=path)


def _scene(folder: Path, model: str, images: str, given: str) -> None:
    """Models and photographs where other programs put them make the scene that they are."""
    scene = room(folder)
    expected = load_scene(scene, test_every=0)
    moved = scene.with_name("theirs")
    (moved / model).parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(scene / "sparse" / "0", moved / model, dirs_exist_ok=True)
    shutil.copytree(scene / "images", moved / images)
    found = load_scene(moved / given, test_every=0)
    for view, other in zip(found.train_views, expected.train_views, strict=True):
        np.testing.assert_array_equal(view.image, other.image)
        np.testing.assert_array_equal(view.camera.cam_from_world_t, other.camera.cam_from_world_t)
    assert "8 of 8 photographs have cameras" in done("info", moved / given).out
    done("train", moved / given, *OPTIONS, "--out", folder / "run")
    done("eval", folder / "run")


def _transforms_first(folder: Path) -> None:
    """A transforms.json comes before the model that it was made of."""
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    (scene / "colmap").mkdir()
    shutil.move(scene / "sparse", scene / "colmap" / "sparse")
    del content["frames"][6:]
    (scene / "transforms.json").write_text(json.dumps(content))
    assert "6 of 8 photographs have cameras" in done("info", scene).out


def _no_photographs(folder: Path) -> None:
    scene = room(folder)
    shutil.move(scene / "sparse" / "0", folder / "alone")
    assert "no folder images/" in refused("info", folder / "alone", names=folder / "alone")


def _scene_refused(folder: Path, name: str, content: str, says: str) -> None:
    """A project of photogrammetry is refused with the export to use, as a folder and as the file."""
    (folder / "scene" / name).parent.mkdir(parents=True)
    (folder / "scene" / name).write_text(content)
    paths = [folder / "scene"] if "/" in name else [folder / "scene", folder / "scene" / name]
    for path in paths:
        assert says in refused("train", path, "--out", folder / "run", names=path)


METASHAPE = '<?xml version="1.0"?><document version="2.0.0"><chunk label="c"><sensors/></chunk></document>'

CASES: dict[str, Callable[[Path], None]] = {
    **{
        f"graphdeco {iterations} {below}": partial(_of_graphdeco, iterations=iterations, below=below)
        for iterations, below in (((7000, 30000), ""), ((900, 1000, 99), ""), ((1,), "point_cloud"))
    },
    "graphdeco, one iteration": partial(_of_graphdeco, iterations=(30000,), below="point_cloud/iteration_30000"),
    **{
        f"SOG in a folder, degree {degree}": partial(_unbundled, degree=degree, as_file=as_file)
        for degree, as_file in ((0, False), (1, True), (3, False))
    },
    **{
        f"table of degree {degree}": partial(_table, degree=degree, end=end)
        for degree, end in ((0, "\n"), (1, "\r\n"), (3, "\n"))
    },
    **{
        f"refused: {given}": partial(_model_refused, names=names, content=content, says=says, given=given)
        for names, content, says, given in (
            (("ckpts/ckpt_29999_rank0.pt",), "PK", "--save_ply", "ckpts/ckpt_29999_rank0.pt"),
            (("ckpts/ckpt_29999_rank0.pt",), "PK", "--save_ply", "ckpts"),
            (("model.pth",), "PK", "export_splats", "model.pth"),
            (("outputs/fox/splatfacto/2024/config.yml",), "!!python", "ns-export gaussian-splat", "outputs"),
            (("outputs/fox/splatfacto/2024/config.yml",), "!!", "splatfacto/2024/config.yml", "outputs/fox/splatfacto"),
            (("run/config.yml", "run/nerfstudio_models/step-000029999.ckpt"), "!!", "ns-export", "run"),
            (("lod/lod-meta.json", "lod/0_0/meta.json"), "{}", "the folder of one", "lod"),
            (("lod/lod-meta.json",), "{}", "splat-transform", "lod/lod-meta.json"),
            (("output/cfg_args",), "Namespace()", "train it to its end", "output"),
        )
    },
    **{
        f"scene: {model or 'bare'}, {images}, {given}": partial(_scene, model=model, images=images, given=given)
        for model, images, given in (
            ("colmap/sparse/0", "images", ""),
            ("distorted/sparse/0", "input", ""),
            ("", "images", ""),
            ("sparse/0", "images", "sparse/0"),
            ("model", "images", "model"),
        )
    },
    "transforms.json before colmap/": _transforms_first,
    "a model without photographs": _no_photographs,
    **{
        f"scene refused: {name}": partial(_scene_refused, name=name, content=content, says=says)
        for name, content, says in (
            ("cameras.xml", METASHAPE, "File > Export > Export Cameras"),
            ("cams.XML", METASHAPE.replace("?>", "?>\n"), "ns-process-data metashape"),
            ("scene.rcproj", "<RealityCaptureProject/>", "COLMAP there"),
            ("registration.csv", "#name,x,y,alt,heading,pitch,roll\n", "RealityCapture"),
            ("bundle.out", "# Bundle file v0.3\n2 0\n", "Bundler"),
            ("sparse.nvm", "NVM_V3\n", "VisualSFM"),
            ("keyframes/corrected_cameras/1.json", "{}", "ns-process-data polycam"),
            ("keyframes/cameras/1.json", "{}", "Polycam"),
            ("cfg_args", "Namespace()", "the scene that it was trained on"),
        )
        if name != "cfg_args"
    },
}
