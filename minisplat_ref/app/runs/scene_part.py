"""A part of a scene that is trained for itself: which photographs, which of their pixels, and where its Gaussians are.

A part is two files, ``NAME.json`` and, beside it, ``NAME.npz`` with cameras, points and masks. They have all that a
training needs of the scene besides its photographs: the model of a large scene is read once, when its parts are
planned, and not again for each. Places are in the frame of the scene's files, on a plane: a point x has the coordinates
``axes (x - origin)``.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app import listing_file
from minisplat_ref.app.runs.run_folder import read_json_object, write_json
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.frames import return_points
from minisplat_ref.io.json_file import as_array
from minisplat_ref.io.npz import read_npz
from minisplat_ref.io.scene import Listing
from minisplat_ref.io.stored_views import Pixels, StoredView
from minisplat_ref.strategy.ops import contiguous, take
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Bools, Floats, Scene, View

WAY_OUT = "plan the blocks again, into another folder"


class Plane(NamedTuple):
    """The plane on which a scene is divided."""

    origin: Floats
    """[3] in the frame of the files."""
    axes: Floats
    """[2, 3] orthonormal."""

    def coordinates(self, points: Floats) -> Floats:
        """Return [P, 2] of points [P, 3] in the frame of the files."""
        return (points.astype(np.float64) - self.origin) @ self.axes.T


class Box(NamedTuple):
    """A rectangle of the plane, half-open: points on the upper edge are outside."""

    low: tuple[float, float]
    """Minus infinity where it has no end."""
    high: tuple[float, float]

    def contains(self, coordinates: Floats) -> Bools:
        """Return [P] of coordinates [P, 2]."""
        x, y = coordinates.T
        return (x >= self.low[0]) & (x < self.high[0]) & (y >= self.low[1]) & (y < self.high[1])

    def to_json(self) -> list[list[float | None]]:
        """Return the four numbers, null for infinity."""
        return [[value if math.isfinite(value) else None for value in corner] for corner in self]


class Region(NamedTuple):
    """The box of a part's first Gaussians."""

    plane: Plane
    box: Box

    def find_rows(self, state: TrainState) -> Bools:
        """Return [N]: which Gaussians of a state lie in the region."""
        means = return_points(state.gaussians.means, state.frame)
        return self.box.contains(self.plane.coordinates(means))


def keep_rows(state: TrainState, rows: Bools) -> TrainState:
    """Keep Gaussians [N] of a state, with their moments and statistics."""
    state.gaussians, first, second = (
        contiguous(take(fields, rows)) for fields in (state.gaussians, state.adam.first, state.adam.second)
    )
    state.adam = state.adam._replace(first=first, second=second)
    state.stats = {name: np.ascontiguousarray(values[rows]) for name, values in state.stats.items()}
    return state


class Part(NamedTuple):
    """The data that one block is trained on."""

    region: Region
    """The block with its surroundings."""
    listing: Listing
    """Of its photographs, all for training, and of the points that they show."""
    masks: Mapping[str, Bools]
    """[H, W] by the name of the photograph: True where it shows the region, or nothing at all."""
    extent: float | None = None
    """That of the whole scene, in the unit of the files, for a part that continues a training of the whole; None for
    one that has an extent of its own."""

    def write(self, path: Path) -> None:
        """Write both files; ``path`` is that of the JSON, which comes last."""
        with replacing(path.with_suffix(".npz")) as temporary, open(temporary, "wb") as file:
            bits = {f"{k:05d}": np.packbits(mask) for k, mask in enumerate(self.masks.values())}
            np.savez(file, allow_pickle=False, **bits, **listing_file.to_arrays(self.listing))
        content = {
            "origin": self.region.plane.origin.tolist(),
            "axes": self.region.plane.axes.tolist(),
            "region": self.region.box.to_json(),
            "extent": self.extent,
            "masks": [[name, *mask.shape] for name, mask in self.masks.items()],
            **listing_file.to_json(self.listing),
        }
        write_json(path, content)

    def hide(self, scene: Scene) -> Scene:
        """Return the scene that was built of the listing, with masks, and with the extent of the whole if it has that.

        Raises
        ------
        InputError
            A photograph has another size than its mask.
        """
        scene = scene._replace(train_views=tuple(self._masked(view) for view in scene.train_views))
        return scene if self.extent is None else scene._replace(extent=self.extent)

    def _masked(self, view: View) -> View:
        mask = self.masks[view.name]
        if mask.shape != (view.camera.height, view.camera.width):
            raise InputError(
                f"photograph {view.name} is {view.camera.width}x{view.camera.height} and was"
                f" {mask.shape[1]}x{mask.shape[0]} when the blocks were planned: {WAY_OUT}"
            )

        def hide(pixels: Pixels) -> Pixels:
            return pixels._replace(mask=mask if pixels.mask is None else mask & pixels.mask)

        if isinstance(view, StoredView):
            return view.change(hide)
        return view._replace(mask=hide(Pixels(view.image, view.mask)).mask)


def read_part(path: Path, source: Path) -> Part:
    """Read the files of :meth:`Part.write`.

    Parameters
    ----------
    path : Path
        Of the JSON.
    source : Path
        Of the scene.

    Raises
    ------
    InputError
        A file is missing or damaged.
    """
    region, content = read_region(path), read_json_object(path)
    try:
        arrays = read_npz(path.with_suffix(".npz"), WAY_OUT)
        listing, masks = listing_file.read_listing(source, content, arrays), _unpack(content["masks"], arrays)
        extent = content["extent"]
        return Part(region, listing, masks, None if extent is None else float(extent))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _version_error(path, error) from error


def read_region(path: Path) -> Region:
    """Read of a part only where it is; errors are those of :func:`read_part`."""
    content = read_json_object(path)
    origin, axes = as_array(content.get("origin"), (3,)), as_array(content.get("axes"), (2, 3))
    if origin is None or axes is None:
        raise InputError(f"{path} has no plane: {WAY_OUT}")
    try:
        return Region(Plane(origin, axes), box_from_json(content["region"]))
    except (KeyError, TypeError, ValueError) as error:
        raise _version_error(path, error) from error


def _version_error(path: Path, error: Exception) -> InputError:
    return InputError(f"{path} is not a part of a scene of this version ({error}): {WAY_OUT}")


def box_from_json(content: Any) -> Box:
    """Read the output of :meth:`Box.to_json`; raises TypeError or ValueError for anything else."""
    (x0, y0), (x1, y1) = content
    low = tuple(-math.inf if value is None else float(value) for value in (x0, y0))
    high = tuple(math.inf if value is None else float(value) for value in (x1, y1))
    return Box((low[0], low[1]), (high[0], high[1]))


def _unpack(sizes: Any, bits: Mapping[str, Any]) -> dict[str, Bools]:
    masks = {}
    for k, (name, height, width) in enumerate(sizes):
        flat = np.unpackbits(bits[f"{k:05d}"], count=height * width).astype(bool)
        masks[str(name)] = flat.reshape(height, width)
    return masks
