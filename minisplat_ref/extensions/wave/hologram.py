"""The command ``minisplat-ref wave hologram``: a camera's view of a model, as the light that a display sends out."""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref import memory
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave import encoding, hologram_file, windows
from minisplat_ref.extensions.wave.blending import Scene, center_transmittances
from minisplat_ref.extensions.wave.hologram_file import Hologram
from minisplat_ref.extensions.wave.kernels import sum_spectra
from minisplat_ref.extensions.wave.placement import place, steepest_slope
from minisplat_ref.extensions.wave.reference import Complexes
from minisplat_ref.extensions.wave.sampling import Grid, check_sampling, field_from, grid_waves
from minisplat_ref.interface.arguments import HelpFormatter, list_of, positive
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import write_image
from minisplat_ref.io.frames import frame_of_means, place_camera, place_population
from minisplat_ref.io.label import warn_of_another
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.io.run_files import CAMERAS, model_file, read_cameras
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.training.representation import WORLD_UNITS

DESCRIPTION = """\
Compute a hologram of what a camera sees of a model: for red, green and blue
light the complex field in the plane of a display, from flat Gaussians in closed
form. Surfels are flat; of other Gaussians the thinnest axis is left out.

The scene becomes a box of the display's size, half before and half behind it.
Its depth is linear in 1 / Z, as an eyepiece shows it.

Blending, by --blending:
  exact       front to back, as in 3DGS, with waves for colours (default)
  fast        one transmittance for each Gaussian, one sum of closed forms
  silhouette  back to front, so that light also bends around what it passes
"""
EPILOG = """\
example:
  minisplat-ref wave hologram runs/fox --out fox.npz --phase fox_phase.png
  minisplat-ref wave focus fox.npz --depth 3.5 --out near.png
"""
WAVELENGTHS = (638.0, 520.0, 450.0)  # nm, of lasers in displays
PITCH, THICKNESS = 8.0, 4.0  # um, mm
BYTES = 16 * 8  # per pixel of the padded grid, at the peak: complex fields, spectra, transfer functions, frequencies

Blend = Callable[[Scene, Grid, float, int], Complexes]


def blend_fast(scene: Scene, grid: Grid, wavelength: float, channel: int) -> Complexes:
    """Return the hologram [H, W] of one channel by fast blending, by the kernel."""
    waves = grid_waves(grid, wavelength)
    weights = center_transmittances(scene) * scene.opacities * scene.amplitudes[:, channel]
    return field_from(sum_spectra(scene.flats, weights, waves), waves, grid)[: grid.height, : grid.width]


BLENDING: dict[str, Blend] = {
    "exact": windows.blend_windows,
    "fast": blend_fast,
    "silhouette": windows.blend_silhouette_windows,
}


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "hologram",
        help="compute a hologram of a run or a PLY",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=HelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="RUN|PLY", help="folder of a run, or a PLY of Gaussians")
    parser.add_argument("--out", type=Path, required=True, metavar="NPZ", help="file to write")
    parser.add_argument("--camera", metavar="NAME", help="of the image (default: the first test view)")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="cameras.json (default: beside the PLY)")
    parser.add_argument("--pitch", type=positive, default=PITCH, metavar="UM", help="of the display, um (default 8)")
    parser.add_argument(
        "--width", type=positive, metavar="MM", help="of the display, mm (default: a pixel per camera pixel)"
    )
    parser.add_argument(
        "--thickness", type=positive, default=THICKNESS, metavar="MM", help="depth of the box, mm (default 4)"
    )
    parser.add_argument(
        "--wavelengths", type=list_of(positive), default=WAVELENGTHS, metavar="R,G,B", help="nm (default 638,520,450)"
    )
    parser.add_argument("--blending", choices=tuple(BLENDING), default="exact", metavar="B", help="see above")
    parser.add_argument("--phase", type=Path, metavar="PNG", help="also phases for a display, 0 to 255 is 0 to 2 pi")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, place, blend, write.

    Raises
    ------
    InputError
        The model or the camera cannot be used, nothing is in front of it, or the pitch aliases.
    """
    if len(args.wavelengths) != 3:
        raise InputError(f"--wavelengths has {len(args.wavelengths)}: give three in nm, of red, green and blue light")
    file = model_file(args.model)
    gaussians, label = load_ply(file), read_label(file)
    if label.extension != "surfels":  # which are flat as they are
        warn_of_another(file, label, "wave", "wave hologram")
    camera = _choose_camera(args, file).camera
    wavelengths, pitch = np.array(args.wavelengths) * 1e-9, args.pitch * 1e-6
    grid = _grid_of(camera.width, camera.height, pitch, args.width)
    thickness, width = args.thickness * 1e-3, pitch * camera.width if args.width is None else args.width * 1e-3
    frame = frame_of_means(gaussians.means)
    placed = place(
        place_population(gaussians, WORLD_UNITS, frame),
        place_camera(camera, frame),
        width=width,
        thickness=thickness,
        steepest=steepest_slope(float(wavelengths.max()), pitch),
        conventions=GSPLAT_MAIN,
    )
    check_sampling(placed.scene.flats, grid, wavelengths, thickness / 2)
    fields = [
        BLENDING[args.blending](placed.scene, grid, wavelength, channel)
        for channel, wavelength in enumerate(with_progress(wavelengths, "blending", "colours"))
    ]
    depths = frame.unit * np.array([placed.box.nearest, placed.box.farthest])
    hologram = Hologram(np.stack(fields), wavelengths, pitch, depths, thickness)
    hologram_file.save(args.out, hologram)
    if args.phase is not None:
        write_image(args.phase, phase_image(hologram))
    n, grid_text = len(placed.scene.opacities), f"{grid.width} x {grid.height} pixels of {args.pitch:g} um"
    print(f"{n:,} flat Gaussians on {grid_text}, depths {depths[0]:.3g} to {depths[1]:.3g}: {args.out}")
    if label.extension != "surfels":
        print(f"flattened along their thinnest axes; {placed.n_thick:,} of them were no discs")
    if placed.n_steep:
        print(f"{placed.n_steep:,} were steeper than half of the light's own angle and have been tilted back")
    return 0


def phase_image(hologram: Hologram) -> Any:
    """Return the double-phase encoding of a hologram as an image [H, W, 3] of bytes."""
    phases = np.stack([encoding.encode(field)[0] for field in hologram.fields], axis=-1)
    return np.rint(phases / (2 * np.pi) * 256).astype(np.int64).astype(np.uint8)  # 2 pi is 0 again


def _grid_of(width: int, height: int, pitch: float, millimetres: float | None) -> Grid:
    """Return the pixels of the display, in the proportions of the camera's image.

    Raises
    ------
    InputError
        They do not fit into memory, or there is none.
    """
    columns = width if millimetres is None else round(millimetres * 1e-3 / pitch)
    rows = round(columns * height / width)
    if min(columns, rows) < 1:
        raise InputError(f"--width {millimetres:g} mm is less than a pixel of {pitch * 1e6:g} um: give more")
    needed, free = BYTES * 4 * columns * rows, memory.free_bytes()
    if needed > free:
        fits = math.floor(1e3 * pitch * columns * math.sqrt(free / needed) * 100) / 100
        raise InputError(
            f"a hologram of {columns:,} x {rows:,} pixels takes about {memory.as_text(needed)}, {memory.as_text(free)}"
            f" are free: --width {fits:g} fits"
        )
    return Grid(columns, rows, pitch)


def _choose_camera(args: argparse.Namespace, file: Path) -> Viewpoint:
    """Return the camera of that name, or the first test view, or the first.

    Raises
    ------
    InputError
        There are no cameras, or none of that name.
    """
    known = read_cameras(file, args.cameras)
    if args.camera is None:
        return next((view for view in known if view.split == "test"), known[0])
    found = [view for view in known if view.name == args.camera]
    if not found:
        names = ", ".join(view.name for view in known[:5])
        path = args.cameras or file.parent / CAMERAS
        raise InputError(f"{path} has no camera {args.camera!r}: choose from {names}{', ...' * (len(known) > 5)}")
    return found[0]
