"""Python says what the command line says: what of a scene's folder is not used, and what was made of a file."""

import json
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pycolmap
from PIL import Image

from data_tools.foreign_files.building import NAMES, OPTIONS, done, room
from data_tools.foreign_files.leftovers import as_transforms
from minisplat_ref.errors import InputWarning
from minisplat_ref.io import load_colmap, load_scene, load_transforms
from minisplat_ref.types import Scene

WHITE = Image.new("L", (48, 36), 255)


def loaded(load: Callable[..., Scene], scene: Path, **options: object) -> tuple[int, list[str]]:
    """Return the number of views that are loaded, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = load(scene, **options)
    said = [str(warning.message) for warning in caught if warning.category is InputWarning]
    assert all(warning.filename == __file__ for warning in caught), "the warning does not point to the caller's line"
    return len(found.train_views) + len(found.test_views), said


def _complete(folder: Path, load: Callable[..., Scene]) -> None:
    assert loaded(load, room(folder)) == (8, [])


def _few_of_a_model(folder: Path, n: int, load: Callable[..., Scene]) -> None:
    """A model has fewer images than photographs: how many, and which have none."""
    scene = room(folder)
    model = scene / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    for image_id in sorted(reconstruction.images)[n:]:
        reconstruction.deregister_frame(reconstruction.image(image_id).frame_id)
    for file in model.iterdir():
        file.unlink()
    reconstruction.write_binary(str(model))
    n_views, (warning,) = loaded(load, scene)
    assert n_views == n and warning.startswith(f"{scene}: {n} of 8 photographs have cameras; without a camera: ")
    assert warning.removeprefix(f"{scene}: ") in done("info", scene).out


def _few_frames(folder: Path, n: int) -> None:
    scene = room(folder)
    content = as_transforms(load_scene(scene))
    shutil.rmtree(scene / "sparse")
    (scene / "transforms.json").write_text(json.dumps({**content, "frames": content["frames"][:n]}))
    for load in (load_scene, load_transforms):
        n_views, (warning,) = loaded(load, scene)
        assert n_views == n and f"{n} of 8 photographs have cameras" in warning


def _mask(folder: Path, place: str) -> None:
    """A mask whose name fits no photograph is not used."""
    scene = room(folder)
    (scene / place).parent.mkdir()
    WHITE.save(scene / place)
    n_views, (warning,) = loaded(load_scene, scene)
    assert n_views == 8 and f"{Path(place).parent}/ has 1 files, 0 fit" in warning, warning


def _larger_model(folder: Path) -> None:
    scene = room(folder)
    shutil.copytree(scene / "sparse" / "0", scene / "sparse" / "1")
    _, said = loaded(load_scene, scene, model="sparse/1")
    assert len(said) == 1 and "sparse/0 has 8 images, sparse/1 has 8" in said[0]


def _once(folder: Path) -> None:
    """A command says it once."""
    scene = room(folder)
    WHITE.save(scene / "images" / "other.jpg")
    for arguments in (("info", scene), ("train", scene, *OPTIONS, "--out", folder / "run")):
        said = done(*arguments)
        assert (said.out + said.err).count("without a camera: other.jpg") == 1, said.err


CASES: dict[str, Callable[[Path], None]] = {
    **{f"nothing left, {load.__name__}": partial(_complete, load=load) for load in (load_scene, load_colmap)},
    **{
        f"{n} of 8, {load.__name__}": partial(_few_of_a_model, n=n, load=load)
        for n, load in ((3, load_scene), (5, load_scene), (6, load_colmap))
    },
    **{f"{n} of 8 frames": partial(_few_frames, n=n) for n in (3, 4, 7)},
    **{
        f"mask {place}": partial(_mask, place=place)
        for place in ("masks/a.png", f"mask/{NAMES[1]}.png", "Mattes/b.jpg")
    },
    "an equal second model": _larger_model,
    "a command says it once": _once,
}
