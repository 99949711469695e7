"""The command ``minisplat-ref wave focus``: the view of a hologram by an eye or a camera focused on a depth."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave import encoding, hologram_file
from minisplat_ref.extensions.wave.hologram_file import Hologram
from minisplat_ref.extensions.wave.sampling import finest_pitch, propagate
from minisplat_ref.interface.arguments import HelpFormatter, positive
from minisplat_ref.io import write_image
from minisplat_ref.types import Floats

EPILOG = """\
examples:
  minisplat-ref wave focus fox.npz --depth 3.5 --out near.png
  minisplat-ref wave focus fox.npz --depth 9 --phase-only --out far.png
"""


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "focus",
        help="look at a hologram, focused on a depth",
        description="Propagate a hologram to the plane of a depth, and write what is there.",
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("hologram", type=Path, metavar="HOLOGRAM", help="file of wave hologram")
    parser.add_argument("--depth", type=positive, required=True, metavar="Z", help="of the camera, world units")
    parser.add_argument("--out", type=Path, required=True, metavar="PNG", help="image to write")
    parser.add_argument(
        "--phase-only", action="store_true", help="of a display of phases alone, double-phase encoded, with an aperture"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, propagate, write.

    Raises
    ------
    InputError
        The file is no hologram, or the depth is too far from it.
    """
    hologram = hologram_file.load(args.hologram)
    z = hologram.z_of(args.depth)
    least = finest_pitch(float(hologram.wavelengths.max()), abs(z), float(hologram.grid.size.min()))
    if hologram.pitch < least:
        near, far = hologram.depths
        raise InputError(
            f"--depth {args.depth:g} is {abs(z) * 1e3:.3g} mm from the display, where light wraps around: the scene is"
            f" between {near:.3g} and {far:.3g}"
        )
    write_image(args.out, reconstruct(hologram, z, is_phase_only=args.phase_only))
    print(f"focused on {args.depth:g}, {z * 1e3:+.3g} mm from the display: {args.out}")
    return 0


def reconstruct(hologram: Hologram, z: float, *, is_phase_only: bool = False) -> Floats:
    """Return the image [H, W, 3] in the plane z, metres: amplitudes, as an image stores them."""
    grid, image = hologram.grid, []
    for field, wavelength in zip(hologram.fields, hologram.wavelengths, strict=True):
        shown = encoding.decode(*encoding.encode(field), grid, float(wavelength)) if is_phase_only else field
        image.append(np.abs(propagate(shown, grid, float(wavelength), z)))
    return np.stack(image, axis=-1)
