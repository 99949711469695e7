"""Synthetic scenes with exact truth: photographs, depth, normals, ids and sparse points, ray-traced with NumPy.

Reading order: shapes, geometry, materials, tracer, cameras, furniture, lights, truths, park, scenes, sparse_points;
files writes a scene as a COLMAP folder, and triangles makes a mesh of a world.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from minisplat_ref.datasets.synthetic.scenes import SETTINGS
from minisplat_ref.datasets.synthetic.sparse_points import sample_points
from minisplat_ref.datasets.synthetic.tracer import TracedView, World, trace_view
from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import suggest
from minisplat_ref.types import Bools, Camera, Floats, Ints, Scene, View

__all__ = ["SCENE_NAMES", "SyntheticScene", "make_scene"]

SCENE_NAMES = tuple(SETTINGS)
"""The scenes that :func:`make_scene` knows."""

EXTENT_MARGIN = 1.1  # of the largest distance of a camera from the mean: the definition in types.Scene


class SyntheticScene(NamedTuple):
    """A scene with the truth that photographs lack, with V training and T test views."""

    scene: Scene
    """The scene as a loader would return it."""
    train_depths: Floats
    """[V, H, W] float64 camera z at pixel centres, world units; 0 at the sky."""
    test_depths: Floats
    """[T, H, W] likewise."""
    train_normals: Floats
    """[V, H, W, 3] float64 unit normals towards the camera at pixel centres, world frame; 0 at the sky."""
    test_normals: Floats
    """[T, H, W, 3] likewise."""
    train_ids: Ints
    """[V, H, W] int16 index of the world's primitive at pixel centres; -1 at the sky."""
    test_ids: Ints
    """[T, H, W] likewise."""
    point_visibility: Bools
    """[V, P] which training view sees which of the scene's points."""
    world: World
    """The surfaces and their light, to trace further views."""


def make_scene(
    name: str,
    *,
    n_views: int = 24,
    width: int = 160,
    height: int = 120,
    seed: int = 0,
    supersampling: int = 2,
    n_points: int = 4000,
    point_noise: float | None = None,
    test_every: int = 8,
    progress: Callable[[Sequence[Camera]], Iterable[Camera]] = iter,
) -> SyntheticScene:
    """Ray-trace a scene. Equal arguments give equal bytes.

    Parameters
    ----------
    name : str
        One of ``SCENE_NAMES``.
    n_views : int
        Training views; test views are additional.
    width, height : int
        Image size, pixels.
    seed : int
        Textures, camera path and points follow from it.
    supersampling : int
        n of the n x n colour samples per pixel.
    n_points : int
        Sparse points; fewer when the views share too few surfaces.
    point_noise : float, optional
        Standard deviation of the error of each point coordinate, metres; by default the scene's own, which is 0 but for
        ``noisy-sphere``.
    test_every : int
        In walking order the first of this many views is a test view, like in loaders; 0 for no test views.
    progress : callable
        Wraps the sequence of cameras while the views are traced;
        :func:`~minisplat_ref.interface.progress.with_progress` shows a bar.

    Returns
    -------
    SyntheticScene
        Metres, z up, the floor at z = 0; views named in walking order.

    Raises
    ------
    InputError
        An unknown name or a number out of range.
    """
    if name not in SETTINGS:
        raise InputError(f"there is no synthetic scene {name!r}{suggest(name, SCENE_NAMES)}")
    _at_least(0, seed=seed, n_points=n_points, test_every=test_every)
    _at_least(1, supersampling=supersampling)
    _at_least(2, n_views=n_views)
    _at_least(8, width=width, height=height)
    if test_every == 1:
        raise InputError("test_every is 1, which leaves nothing to train on; give 0 for no test views, or 2 or more")
    if point_noise is not None and not (0.0 <= point_noise < np.inf):
        raise InputError(f"point_noise is {point_noise}; give a finite number of metres, 0 or more")
    scene_rng, camera_rng, point_rng = np.random.default_rng(seed).spawn(3)
    world, path, usual_noise = SETTINGS[name](scene_rng)
    noise = usual_noise if point_noise is None else point_noise
    n_total = n_views + (-(-n_views // (test_every - 1)) if test_every else 0)
    cameras = path.cameras(n_total, width, height, camera_rng)
    traced = [trace_view(world, camera, supersampling) for camera in progress(cameras)]
    views = [View(f"view_{i:04d}", cameras[i], traced[i].image, None) for i in range(n_total)]
    test_ids = list(range(0, n_total, test_every)) if test_every else []
    train_ids = [i for i in range(n_total) if i not in test_ids]

    train_traced, test_traced = ([traced[i] for i in ids] for ids in (train_ids, test_ids))
    points, colors, visibility = sample_points(
        world, [cameras[i] for i in train_ids], train_traced, n_points, noise, point_rng
    )
    train_centres = np.stack([cameras[i].center for i in train_ids])  # [V, 3]
    reach = np.linalg.norm(train_centres - train_centres.mean(axis=0), axis=1).max()
    seen = [np.flatnonzero(row) for row in visibility]  # of V views: the points that each sees
    scene = Scene(
        name=name,
        train_views=tuple(views[i]._replace(point_ids=ids) for i, ids in zip(train_ids, seen, strict=True)),
        test_views=tuple(views[i] for i in test_ids),
        points=points,
        point_colors=colors,
        background=np.zeros(3),
        extent=EXTENT_MARGIN * float(reach),
    )
    train, test = (_stack_truth(own, width, height) for own in (train_traced, test_traced))
    return SyntheticScene(
        scene, train.depth, test.depth, train.normals, test.normals, train.ids, test.ids, visibility, world
    )


class _Truth(NamedTuple):
    depth: Floats  # [n, H, W]
    normals: Floats  # [n, H, W, 3]
    ids: Ints  # [n, H, W]


def _stack_truth(traced: Sequence[TracedView], width: int, height: int) -> _Truth:
    """Return the truth of n views, which may be none."""
    shape = (len(traced), height, width)
    truth = _Truth(np.zeros(shape), np.zeros((*shape, 3)), np.zeros(shape, np.int16))
    for row, view in enumerate(traced):
        truth.depth[row], truth.normals[row], truth.ids[row] = view.depth, view.normals, view.ids
    return truth


def _at_least(least: int, **arguments: int) -> None:
    """Refuse arguments that are too small."""
    for name, value in arguments.items():
        if value < least:
            raise InputError(f"{name} is {value}; give {least} or more")
