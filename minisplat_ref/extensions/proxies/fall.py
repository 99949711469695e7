"""The command ``minisplat-ref proxies fall``, which binds a scene to a mesh and lets it fall like cloth."""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.proxies.binding import add_reach, bind, check_bound, rebuild
from minisplat_ref.extensions.proxies.edit import are_in_box
from minisplat_ref.extensions.proxies.mass_spring import (
    Floor,
    Sheet,
    State,
    choose_stiffness,
    energies,
    integrate,
    longest_step,
    make_springs,
    vertex_masses,
)
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import orbits, viewpoints
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.images import write_image
from minisplat_ref.io.ply import save_ply
from minisplat_ref.mechanisms.editing.model_file import load_label, load_model
from minisplat_ref.mechanisms.meshes.mesh import Mesh, check_mesh, load_mesh, save_mesh
from minisplat_ref.rendering import render
from minisplat_ref.types import Bools, Camera, Floats

STEP_FRACTION = 0.2  # of the longest stable step; the study proxies/sheet measures its effect on the energy
FLOOR_DEPTH = 0.02  # how far the floor gives way under a sheet that lies on it, in mean edges
IMAGE_SIZE = (480, 360)  # pixels, without --cameras

DESCRIPTION = """\
Bind the Gaussians of a model to a mesh, let the mesh fall as a sheet of masses
and springs, and write to DIR the Gaussians (frame_000.ply) and the image
(frame_000.png) of every frame, the mesh at the end (mesh.ply), and where the
energy went (energy.json).

The default gravity points along y, which is down in most COLMAP scenes.
"""
EPILOG = """\
example:
  minisplat-ref proxies cage runs/banana sheet.ply --cells 20
  minisplat-ref proxies fall runs/banana sheet.ply --pin-top 0.02 --out fallen"""


class Setting(NamedTuple):
    """Forces and constraints on a mesh that falls."""

    gravity: Floats
    """[3] world units per second squared; not zero."""
    is_pinned: Bools
    """[P] True where a vertex does not move."""
    stretch: float
    """See :func:`~minisplat_ref.extensions.proxies.mass_spring.choose_stiffness`."""
    drag: float
    """1 / second."""
    drop: float | None
    """Distance of the floor below the lowest vertex, world units; None for no floor."""


def make_sheet(mesh: Mesh, setting: Setting) -> Sheet:
    """Return the mesh as a sheet at rest with mass 1 per unit of area."""
    g = float(np.linalg.norm(setting.gravity))
    masses = vertex_masses(mesh, 1.0)
    stiffness = choose_stiffness(mesh, float(masses.sum()) * g, setting.stretch)
    springs = make_springs(mesh, stiffness)
    floor = None
    if setting.drop is not None:
        height = float((mesh.vertices @ (-setting.gravity / g)).min()) - setting.drop
        k = float(masses.mean()) * g / (FLOOR_DEPTH * float(springs.rest_lengths.mean()))
        floor = Floor(height, k, drag=2 * float(np.sqrt(k / masses.mean())))  # critical: no vertex bounces alone
    return Sheet(masses, springs, setting.is_pinned, setting.gravity, setting.drag, floor)


def add_parser(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "fall",
        help="let a scene fall like cloth, bound to a mesh",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="PLY of Gaussians, or a run's folder")
    parser.add_argument("mesh", type=Path, metavar="MESH", help="PLY of a mesh that fits the model")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder for the results")
    add_reach(parser)
    parser.add_argument(
        "--frames", type=int, default=12, metavar="N", help="frames; the first is the model (default 12)"
    )
    parser.add_argument("--seconds", type=float, default=1.0, metavar="T", help="time of the last frame (default 1)")
    parser.add_argument("--cameras", type=Path, metavar="JSON", help="draw from the first camera of a cameras.json")
    physics = parser.add_argument_group("physics")
    physics.add_argument(
        "--gravity",
        type=float,
        nargs=3,
        default=(0.0, 9.81, 0.0),
        metavar=("X", "Y", "Z"),
        help="world units / s^2 (default 0 9.81 0)",
    )
    physics.add_argument(
        "--pin-top", type=float, default=0.0, metavar="F", help="hold the highest fraction F of the mesh"
    )
    physics.add_argument(
        "--pin-box", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help="hold the vertices inside"
    )
    physics.add_argument("--floor", type=float, metavar="D", help="put a floor D below the mesh's lowest vertex")
    physics.add_argument(
        "--stretch", type=float, default=0.02, metavar="F", help="stretch by the sheet's own weight (default 0.02)"
    )
    physics.add_argument("--drag", type=float, default=0.5, metavar="C", help="drag of the air, 1 / s (default 0.5)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Bind, then for each frame simulate, rebuild, render and write."""
    _check(args)
    gaussians, mesh, label = load_model(args.model), load_mesh(args.mesh), load_label(args.model)
    setting = Setting(np.array(args.gravity), _select_pinned(args, mesh), args.stretch, args.drag, args.floor)
    camera = _choose_camera(args.cameras, gaussians.means)
    sheet = make_sheet(mesh, setting)
    n_steps = max(1, int(np.ceil(args.seconds / (args.frames - 1) / (STEP_FRACTION * longest_step(sheet)))))
    step = args.seconds / (args.frames - 1) / n_steps
    state = State(mesh.vertices, np.zeros_like(mesh.vertices))
    records = []
    with making_folder(args.out) as folder:
        binding = bind(
            gaussians, mesh, args.reach, partial(with_progress, description="nearest triangles", unit="parts")
        )
        check_bound(binding, args.reach, args.model)
        for frame in with_progress(range(args.frames), "falling", "frames"):
            if frame > 0:
                state = integrate(state, sheet, step, n_steps)
            now = Mesh(state.positions, mesh.faces)
            check_mesh(now, f"frame {frame}, folded flat: give a smaller --stretch or more --drag")
            moved = rebuild(now, binding)
            save_ply(folder / f"frame_{frame:03d}.ply", moved, label)
            write_image(folder / f"frame_{frame:03d}.png", render(moved, camera)[0].image)
            at = energies(state, sheet)
            records.append({"time": frame * n_steps * step, **at._asdict(), "total": at.total})
        save_mesh(folder / "mesh.ply", now)
        swing = max(abs(record["total"] - records[0]["total"]) for record in records)
        moved_energy = max(record["kinetic"] + record["dissipated"] for record in records)
        result = {"step": step, "n_steps": (args.frames - 1) * n_steps, "frames": records}
        (folder / "energy.json").write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    share = f", energy conserved to {swing / moved_energy:.1e} of what moved" if moved_energy > 0 else ""
    print(f"{args.frames} frames of {binding.n_bound:,} Gaussians that fall{share}, in {args.out}")
    return 0


def _check(args: argparse.Namespace) -> None:
    """Refuse numbers out of range before anything is read."""
    if args.frames < 2:
        raise InputError(f"--frames is {args.frames}: give at least 2, since the first is the model as it is")
    numbers = {"--seconds": args.seconds, "--stretch": args.stretch}
    for name, number in numbers.items():
        if not 0 < number < np.inf:
            raise InputError(f"{name} is {number:g}: give a number above 0")
    if not (np.isfinite(args.gravity).all() and any(args.gravity)):
        raise InputError("--gravity is 0 or not finite, with which nothing falls: give another vector")
    for name, number in (("--drag", args.drag), ("--floor", args.floor or 0.0), ("--pin-top", args.pin_top)):
        if not 0 <= number < np.inf:
            raise InputError(f"{name} is {number:g}: give a number that is not negative")


def _select_pinned(args: argparse.Namespace, mesh: Mesh) -> Bools:
    """Return which vertices [P] are held."""
    heights = -mesh.vertices @ np.array(args.gravity)
    is_pinned = np.zeros(len(heights), bool)
    if args.pin_top > 0:
        is_pinned |= heights >= heights.max() - args.pin_top * np.ptp(heights)
    if args.pin_box is not None:
        is_pinned |= are_in_box(mesh.vertices, np.array(args.pin_box[:3]), np.array(args.pin_box[3:]))
        if not is_pinned.any():
            raise InputError("--pin-box holds no vertex of the mesh: give a larger one")
    if is_pinned.all():
        raise InputError("every vertex of the mesh is held, so nothing falls: give a smaller --pin-top or --pin-box")
    return is_pinned


def _choose_camera(cameras: Path | None, means: Floats) -> Camera:
    """Return the first camera of a file, or one that sees the whole scene."""
    if cameras is not None:
        return viewpoints.read(cameras)[0].camera
    return orbits.orbit(means, [], 1, *IMAGE_SIZE)[0].camera
