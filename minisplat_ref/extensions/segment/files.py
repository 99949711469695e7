"""Files of the commands: a model with its cameras, masks of photographs, and models with labels."""

from collections import namedtuple
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import CORE, load_extension
from minisplat_ref.io.frames import frame_of_means, place_camera, place_population
from minisplat_ref.io.images import open_image
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import further_properties, read_label, save_ply
from minisplat_ref.io.ply_file import read_vertices
from minisplat_ref.io.run_files import model_file, read_cameras
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import Renderer
from minisplat_ref.training.recipe_settings import configure_renderer
from minisplat_ref.training.representation import nothing_shared
from minisplat_ref.types import Bools, Camera, Ints

COLUMN = "label"


class Subject(NamedTuple):
    """A model with its cameras."""

    file: Path
    """Its PLY."""
    label: Label
    """The label of the file."""
    population: Any
    """As the file holds it."""
    placed: Any
    """The same in a world that float32 can hold."""
    renderer: Renderer
    cameras: list[Viewpoint]
    """In the world of ``placed``."""


def read_subject(path: Path, cameras: Path | None = None) -> Subject:
    """Read a run's folder, or a PLY with the ``cameras.json`` beside it.

    Raises
    ------
    InputError
        There is no model or there are no cameras, or the renderer needs parameters that no PLY holds.
    """
    file = model_file(path)
    label = read_label(file)
    owner = CORE if label.extension is None else load_extension(label.extension)
    representation = owner.representation
    if representation.shared is not nothing_shared:
        raise InputError(
            f"{file} is drawn by {owner.name}, with parameters that no PLY holds: segment a run of another recipe"
        )
    population = owner.load(file, representation.population)
    views = read_cameras(file, cameras)
    frame = frame_of_means(population.means)
    return Subject(
        file,
        label,
        population,
        place_population(population, representation.units, frame),
        configure_renderer(representation.renderer, label.set),
        [view._replace(camera=place_camera(view.camera, frame)) for view in views],
    )


def save_labelled(path: Path, subject: Subject, labels: Ints) -> None:
    """Write the whole model with the property ``label``, which other programs skip."""
    fields = subject.population._asdict() | {COLUMN: labels.astype(np.float32)}
    save_ply(path, namedtuple("Labelled", fields)(**fields), subject.label)


def save_part(path: Path, subject: Subject, is_kept: Bools) -> None:
    """Write those primitives that are kept, as the model's file has them."""
    population = subject.population
    save_ply(path, population._make(field[is_kept] for field in population), subject.label)


def read_labels(subject: Subject) -> Ints:
    """Return the labels [N] that :func:`save_labelled` wrote.

    Raises
    ------
    InputError
        The file has none.
    """
    if COLUMN not in further_properties(subject.file):
        raise InputError(f"{subject.file} has no labels: write them with minisplat-ref segment label")
    return read_vertices(subject.file)[COLUMN].astype(np.int64)


def read_masks(folder: Path, viewpoints: list[Viewpoint]) -> list[tuple[Viewpoint, Ints]]:
    """Return the cameras that have a mask ``NAME.png``, each with the ids [H, W] of its pixels.

    A mask may be a whole number of times as large as its camera's image, as those of photographs that a training has
    made smaller; then it is read at the middle of each block.

    Raises
    ------
    InputError
        There is no folder or no mask, one belongs to no camera, has another size, or is no image of ids.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder: give one with a PNG of ids for each photograph")
    files = {path.relative_to(folder).with_suffix("").as_posix(): path for path in sorted(folder.rglob("*.png"))}
    names = {viewpoint.name for viewpoint in viewpoints}
    if not files:
        raise InputError(f"{folder} holds no PNG: give one of ids for each photograph, called as that is")
    unknown = [name for name in files if name not in names]
    if unknown:
        some = ", ".join(sorted(names)[:3])
        raise InputError(f"{files[unknown[0]]}: no photograph of that name; the run has {some}, ...: rename the mask")
    return [(v, _read_mask(files[v.name], v.camera)) for v in viewpoints if v.name in files]


def _read_mask(path: Path, camera: Camera) -> Ints:
    with open_image(path) as image:
        ids = np.array(image)  # of a palette: indices
    if ids.ndim != 2 or ids.dtype.kind not in "bui":
        raise InputError(f"{path}: {image.mode} pixels are no ids; write one channel of whole numbers, 0 is background")
    height, width = ids.shape
    factor = width // camera.width
    if factor < 1 or (width, height) != (factor * camera.width, factor * camera.height):
        raise InputError(
            f"{path}: {width} x {height} pixels, and its photograph was trained on with {camera.width} x"
            f" {camera.height}; give it that size, or a whole number of times that"
        )
    middle = slice(factor // 2, None, factor)
    return ids[middle, middle].astype(np.int64)
