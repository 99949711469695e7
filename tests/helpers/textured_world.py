"""Photographs of a small world whose textures structure from motion recognises, with known cameras."""

from typing import NamedTuple

import numpy as np
from PIL import ExifTags, Image

from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.datasets.synthetic.furniture import place, rotate_z, sheet
from minisplat_ref.datasets.synthetic.materials import Noise, random_lattice
from minisplat_ref.datasets.synthetic.shapes import Box, Sphere
from minisplat_ref.datasets.synthetic.tracer import World, trace_view
from minisplat_ref.types import Camera

WIDTH, HEIGHT = 256, 192
STEP_DEGREES = 9.0
TARGET = np.array([0.0, 0.0, 0.2])


class Shot(NamedTuple):
    """A photograph and its truth."""

    camera: Camera
    image: np.ndarray
    depth: np.ndarray


def textured_world(rng):
    """A floor, three boxes and a ball, all covered with clouds of two colours."""
    lattice = random_lattice(rng)

    def clouds(low, high, size):
        return Noise(low, high, np.full(3, size), lattice, n_octaves=4, contrast=2.2)

    primitives = (
        sheet(4.0, 4.0, clouds("#20301c", "#e8e0b0", 0.31), [0.0, 0.0, 0.0]),
        place(Box(0.3, 0.25, 0.3), clouds("#301010", "#f0c0a0", 0.17), [-0.5, 0.2, 0.3], rotate_z(20)),
        place(Box(0.2, 0.2, 0.5), clouds("#101830", "#c0d8f0", 0.13), [0.5, 0.4, 0.5], rotate_z(50)),
        place(Box(0.25, 0.35, 0.15), clouds("#2a1030", "#f0d0f0", 0.15), [0.1, -0.5, 0.15], rotate_z(-15)),
        place(Sphere(0.3), clouds("#102820", "#d0f0d8", 0.19), [-0.45, -0.7, 0.3]),
    )
    white = np.full(3, 0.55)
    return World(primitives, np.array([[1.0, -2.0, 4.0]]), white, 4.0, white, white, sky=lambda d: np.ones_like(d))


def take_photographs(rng, focals):
    """One photograph for each focal length in pixels, along an arc around the middle."""
    world = textured_world(rng)
    shots = []
    for i, focal in enumerate(focals):
        angle = np.radians(STEP_DEGREES * (i - 0.5 * len(focals)) - 90.0)
        radius = 2.4 + 0.3 * rng.random()
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), 1.1 + 0.5 * rng.random()])
        camera = look_at(position, TARGET, focal, WIDTH, HEIGHT)
        traced = trace_view(world, camera, 2)
        shots.append(Shot(camera, traced.image, traced.depth))
    return shots


def write_photographs(folder, shots, millimetres):
    """Write photographs as 00.jpg and so on; with millimetres, EXIF data say the focal length (None: no EXIF data)."""
    folder.mkdir()
    for i, (shot, focal) in enumerate(zip(shots, millimetres, strict=True)):
        exif = Image.Exif()
        if focal is not None:
            exif.update({ExifTags.Base.Make: "Maker", ExifTags.Base.Model: "Zoom 1"})
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLength] = focal
        Image.fromarray(shot.image).save(folder / f"{i:02d}.jpg", exif=exif, quality=95)
