"""Arguments that the commands of fans share: the options for making fans of Gaussians, and the model."""

import argparse
from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.fans.mesh_files import is_fans, load_fans
from minisplat_ref.extensions.fans.shapes import Fans, FanShape, check_shape, convert_gaussians
from minisplat_ref.io.ply import load_ply
from minisplat_ref.io.run_files import model_file
from minisplat_ref.types import Gaussians

DEFAULT = FanShape()


def add_shape(parser: Any) -> None:
    """Add ``--sides``, ``--reach``, ``--rim`` and ``--solid``."""
    shape = parser.add_argument_group("how Gaussians become fans")
    shape.add_argument(
        "--sides", type=int, default=DEFAULT.n_sides, metavar="N", help="of a fan, at least 3 (default %(default)s)"
    )
    shape.add_argument(
        "--reach",
        type=float,
        default=DEFAULT.reach,
        metavar="K",
        help="standard deviations from the centre to the rim (default %(default)s)",
    )
    shape.add_argument(
        "--rim",
        type=float,
        default=DEFAULT.rim,
        metavar="A",
        help="opacity on the rim, as a part of the centre's (default %(default)s)",
    )
    shape.add_argument("--solid", action="store_true", help="three fans each, in the planes of all pairs of axes")


def shape_of(args: argparse.Namespace) -> FanShape:
    """Return the shape of the options.

    Raises
    ------
    InputError
        It is none.
    """
    shape = FanShape(args.sides, args.reach, args.rim, not args.solid)
    check_shape(shape)
    return shape


def load_gaussians(path: Path) -> Gaussians:
    """Read the Gaussians of a PLY, of a run's folder the one in it.

    Raises
    ------
    InputError
        There is no PLY of Gaussians, or none in it.
    """
    gaussians: Gaussians = load_ply(model_file(path))
    if len(gaussians.means) == 0:
        raise InputError(f"{path} holds no Gaussians: give a model that has been trained")
    return gaussians


def load_as_fans(path: Path, shape: FanShape) -> Fans:
    """Read fans as they are, or Gaussians and make fans of them, of a PLY or a run's folder.

    Raises
    ------
    InputError
        There is no PLY of either, or none in it.
    """
    file = model_file(path)
    if not is_fans(file):
        return convert_gaussians(load_gaussians(path), shape)
    fans = load_fans(file)
    if len(fans.means) == 0:
        raise InputError(f"{path} holds no fans: give a model that has been trained")
    return fans
