"""Masks as files, and the labels that a camera sees."""

from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.segment.votes import colored
from minisplat_ref.io.images import open_image
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.rendering import Renderer, Request
from minisplat_ref.types import Camera, Ints, Model, view_from


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


def label_map(population: Any, labels: Ints, renderer: Renderer, camera: Camera) -> Ints:
    """Return the label [H, W] that each pixel shows: the one whose Gaussians have the largest weight together.

    The rest of a pixel, behind the Gaussians of all labels but 0, is the background's, with label 0.
    """
    found = np.unique(labels[labels > 0])
    sums = np.zeros((1 + len(found), camera.height, camera.width))
    black = Request(np.zeros(3, population.means.dtype))
    for first in range(0, len(found), 3):
        ids = found[first : first + 3]
        colors = np.zeros((len(labels), 3))
        for channel, label in enumerate(ids):
            colors[:, channel] = labels == label
        image = renderer.render(Model(colored(population, colors)), view_from(camera), black)[0].image
        sums[1 + first : 1 + first + len(ids)] = np.moveaxis(image[..., : len(ids)], 2, 0)
    sums[0] = 1 - sums[1:].sum(axis=0)
    return np.concatenate([[0], found])[np.argmax(sums, axis=0)]
