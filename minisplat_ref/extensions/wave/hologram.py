"""The command ``minisplat-ref wave hologram``: a camera's view of a model, as the light that a display sends out.

A camera sees tens of degrees, a hologram with pixels of 8 um only two. So the scene is placed as in a display whose
eyepiece makes the angle: the camera's view becomes a box of the size of the hologram, without perspective, whose depth
is linear in 1 / Z. That map takes planes to planes. With rho metres for a pixel of the camera and Z the camera's depth

    x = rho (fx X / Z + cx - w / 2),   y likewise,   z = D (1 / Z - (a + b) / 2) / (a - b)

so that the nearest surface, 1 / Z = a, is at D / 2 and the farthest, b, at -D / 2. As in 3DGS a Gaussian is mapped by
the Jacobian J at its centre. Its spans ``S = [s_1 e_1, s_2 e_2]``, the two larger axes, become ``J S``. Its image
``A = (J S)_xy (J S)_xy^T`` gets the low-pass of the renderer, eps pixels^2 of the camera. Its plane keeps the slopes
``z = g . (x, y)`` of the mean depth at each place, which without the low-pass are those of its plane:

    B = A + eps rho^2 I,   g = B^-1 (J S)_xy (J S)_z^T

Both together give the new axes: the singular vectors of ``[B^1/2; g^T B^1/2]``, 3 x 2.

A Gaussian steeper than the light's own angle would shine as strongly along its mirrored direction. Slopes are therefore
held below half of that, ``|g| <= 1 / (2 tan(theta))`` with ``sin(theta) = lambda / (2 p)``.
"""

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import memory
from minisplat_ref.constants import GSPLAT_MAIN, Conventions
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.wave.blending import (
    Scene,
    blend_by_kernel,
    blend_silhouette_windows,
    blend_windows,
    front_to_back,
)
from minisplat_ref.extensions.wave.focus import Hologram, encode_phases, save_hologram
from minisplat_ref.extensions.wave.model import Complexes, Flats, Grid, check_sampling
from minisplat_ref.interface.arguments import HelpFormatter, list_of, positive
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import write_image
from minisplat_ref.io.frames import frame_of_means, place_camera, place_population
from minisplat_ref.io.label import warn_of_another
from minisplat_ref.io.ply import load_ply, read_label
from minisplat_ref.io.run_files import CAMERAS, model_file, read_cameras
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.mechanisms.meshes.fans import flatten
from minisplat_ref.reference.spherical_harmonics import sh_colors
from minisplat_ref.rendering import activate
from minisplat_ref.training.representation import WORLD_UNITS
from minisplat_ref.types import Bools, Camera, Floats, Gaussians

THICK = 0.5  # ratio of the least to the middle scale above which a Gaussian is no disc
DEPTH_SHARE = 0.01  # of the scene in view, by opacity and area, that is nearer or farther than the box, each

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


class Box(NamedTuple):
    """The placement of a camera's view in a hologram."""

    camera: Camera
    nearest: float
    """Depth Z of the front of the box, world units."""
    farthest: float
    """Depth Z of its back."""
    width: float
    """Of the hologram, metres."""
    thickness: float
    """D, metres."""

    @property
    def rho(self) -> float:
        """Metres for a pixel of the camera."""
        return self.width / self.camera.width

    def z_of(self, depths: Floats) -> Floats:
        """Return z, metres, of depths of the camera."""
        a, b = 1 / self.nearest, 1 / self.farthest
        return self.thickness * (1 / depths - (a + b) / 2) / (a - b)


class Placed(NamedTuple):
    """A scene in its box, with counts of the Gaussians that could not be kept."""

    scene: Scene
    box: Box
    n_thick: int
    """Gaussians that were no discs and have lost a third axis."""
    n_steep: int
    """Whose slopes were bounded."""


def place(
    gaussians: Gaussians, camera: Camera, width: float, thickness: float, steepest: float, conventions: Conventions
) -> Placed:
    """Return a camera's view of a model, in a box around a hologram.

    Parameters
    ----------
    gaussians : Gaussians
        Surfels, or any Gaussians: the thinnest axis is left out.
    camera : Camera
    width, thickness : float
        Of the box, metres.
    steepest : float
        Bound of |g|.
    conventions : Conventions
        Near plane, least alpha and low-pass of the renderer.

    Raises
    ------
    InputError
        The camera sees nothing, or everything at one depth.
    """
    g = Gaussians(*(field.astype(np.float64) for field in gaussians))
    opacities = activate(g).opacities
    in_camera = g.means @ camera.cam_from_world_R.T + camera.cam_from_world_t
    is_seen = _is_seen(in_camera, g, opacities, camera, conventions)
    if not is_seen.any():
        raise InputError(
            f"none of the {len(is_seen):,} Gaussians is in front of the camera and in its view: give another --camera"
        )
    seen, in_camera = Gaussians(*(field[is_seen] for field in g)), in_camera[is_seen]
    degree = math.isqrt(g.sh_rest.shape[1] + 1) - 1
    colors = sh_colors(
        seen.means, seen.sh_dc, seen.sh_rest, camera.astype(np.float64), degree, np.ones((len(in_camera), 2), int)
    )
    log_areas = seen.log_scales.sum(axis=1) - seen.log_scales.min(axis=1) - 2 * np.log(in_camera[:, 2])
    weights = opacities[is_seen] * np.exp(log_areas - log_areas.max())
    box = Box(camera, *_ends(in_camera[:, 2], weights), width, thickness)
    flats, n_steep = _place_flats(box, seen, in_camera, steepest, conventions.eps2d)
    ordered = np.sort(seen.log_scales, axis=1)
    n_thick = int(np.count_nonzero(ordered[:, 0] - ordered[:, 1] > math.log(THICK)))
    alphas = np.minimum(opacities[is_seen], conventions.alpha_max)
    return Placed(front_to_back(Scene(flats, alphas, colors)), box, n_thick, n_steep)


def _is_seen(
    in_camera: Floats, gaussians: Gaussians, opacities: Floats, camera: Camera, conventions: Conventions
) -> Bools:
    """Return which Gaussians are in front of the camera, not transparent, and within three deviations of its image."""
    X, Y, Z = in_camera.T
    is_seen: Bools = (conventions.near_plane < Z) & (opacities >= conventions.alpha_min)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        reach = 3 * np.exp(gaussians.log_scales.max(axis=1)) / Z
        u, v = X / Z, Y / Z
        is_seen &= (u + reach > -camera.cx / camera.fx) & (u - reach < (camera.width - camera.cx) / camera.fx)
        is_seen &= (v + reach > -camera.cy / camera.fy) & (v - reach < (camera.height - camera.cy) / camera.fy)
    # A Gaussian that the camera is almost inside of has no footprint that a Jacobian describes.
    return is_seen & (np.abs(u) < camera.width / camera.fx) & (np.abs(v) < camera.height / camera.fy)


def _ends(depths: Floats, weights: Floats) -> tuple[float, float]:
    """Return the depths between which all but a share of the weight is, at either end."""
    order = np.argsort(depths)
    below = np.cumsum(weights[order]) / np.sum(weights)
    nearest, farthest = depths[order][np.searchsorted(below, [DEPTH_SHARE, 1 - DEPTH_SHARE])].tolist()
    if not farthest > nearest:  # one depth: any range around it
        return 0.5 * nearest, 2 * nearest
    return nearest, farthest


def _place_flats(box: Box, seen: Gaussians, in_camera: Floats, steepest: float, eps2d: float) -> tuple[Flats, int]:
    """Return flat Gaussians in the box, and the number of those that were too steep."""
    camera, (X, Y, Z) = box.camera, in_camera.T
    z = np.clip(box.z_of(Z), -box.thickness / 2, box.thickness / 2)
    x = box.rho * (camera.fx * X / Z + camera.cx - camera.width / 2)
    y = box.rho * (camera.fy * Y / Z + camera.cy - camera.height / 2)
    J = np.zeros((len(Z), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = box.rho * camera.fx / Z, -box.rho * camera.fx * X / Z**2
    J[:, 1, 1], J[:, 1, 2] = box.rho * camera.fy / Z, -box.rho * camera.fy * Y / Z**2
    J[:, 2, 2] = -box.thickness / (1 / box.nearest - 1 / box.farthest) / Z**2
    spans = J @ (camera.cam_from_world_R @ flatten(seen.means, seen.quats, seen.log_scales).spans)  # [N, 3, 2]
    lateral, across = spans[:, :2], spans[:, 2:]
    B = lateral @ np.swapaxes(lateral, 1, 2) + eps2d * box.rho**2 * np.eye(2)
    slopes = np.linalg.solve(B, lateral @ np.swapaxes(across, 1, 2))[..., 0]  # [N, 2]
    lengths = np.linalg.norm(slopes, axis=1)
    slopes *= np.minimum(1, steepest / np.maximum(lengths, steepest))[:, None]
    roots = np.linalg.cholesky(B)
    mapped = np.concatenate([roots, slopes[:, None, :] @ roots], axis=1)  # [N, 3, 2]
    axes, scales, _ = np.linalg.svd(mapped)
    return Flats(np.column_stack([x, y, z]), axes, scales), int(np.count_nonzero(lengths > steepest))


def steepest_slope(wavelength: float, pitch: float) -> float:
    """Return the bound of |g|, ``1 / (2 tan(theta))``; 0 where the pitch is finer than half a wavelength."""
    sine = wavelength / (2 * pitch)
    return math.sqrt(1 - sine**2) / (2 * sine) if sine < 1 else 0.0


BLENDING: dict[str, Blend] = {
    "exact": blend_windows,
    "fast": blend_by_kernel,
    "silhouette": blend_silhouette_windows,
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
    """Read a model, place what the camera sees, blend it, and write the hologram.

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
    grid = _choose_grid(camera.width, camera.height, pitch, args.width)
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
    save_hologram(args.out, hologram)
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
    phases = np.stack([encode_phases(field)[0] for field in hologram.fields], axis=-1)
    return np.rint(phases / (2 * np.pi) * 256).astype(np.int64).astype(np.uint8)  # 2 pi is 0 again


def _choose_grid(width: int, height: int, pitch: float, millimetres: float | None) -> Grid:
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
