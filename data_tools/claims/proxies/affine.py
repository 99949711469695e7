"""Claim ``proxies/affine`` (arXiv 2402.01459): how exact edits are, and what bending a sheet of Gaussians costs.

Affine edits are compared with the affine map itself, in float64: centres, covariances, colours towards rotated
directions and, where the map is a similarity, the image with that of a camera which was moved the other way.

Bending is not affine. A flat sheet of flat Gaussians is sheared and rolled onto a cylinder of radius r,

    phi(x, y, 0) = (r sin(u / r), y, r - r cos(u / r)),   u = x + y / 2

by a mesh of n x n cells whose vertices are moved exactly. The true centre of a Gaussian is phi at its centre, and the
true covariance is Sigma deformed by phi's derivative there. Both are compared with the result of the binding, once with
the whole gradient F of the triangle, and once with the frame of GaMeS, which is the normal, the direction from the
centroid to the first corner, and the Gram-Schmidt remainder of the second, with two lengths.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from data_tools.claims import kit
from data_tools.claims.kit.figures import set_ticks, show, subplots, table_of
from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.proxies.binding import Binding, bind, rebuild
from minisplat_ref.extensions.proxies.cage import grid
from minisplat_ref.extensions.proxies.edit import Affine, are_in_ball, edit_gaussians, make_affine, make_rotation
from minisplat_ref.interface.palette import BLUE, GREY, RED
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.mechanisms.editing.deformation import Deformation, deform, polar_rotations
from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Floats, Gaussians

MAPS = {
    "rotation": make_rotation((20.0, -50.0, 70.0)),
    "rotation and scale": 1.7 * make_rotation((20.0, -50.0, 70.0)),
    "reflection": np.diag([1.0, -1.0, 1.0]) @ make_rotation((5.0, 6.0, 7.0)),
    "stretch": np.diag([0.3, 1.0, 4.0]),
    "shear": np.array([[1.0, 0.8, -0.3], [0.0, 1.0, 0.5], [0.2, 0.0, 1.0]]),
}
SIMILAR = ("rotation", "rotation and scale", "reflection")
SHIFT = np.array([0.3, -0.2, 0.1])
N = 200  # Gaussians
CELLS = (2, 4, 8, 16, 32, 64)
RADIUS = 0.8  # of the cylinder; the sheet is 2 wide
SIZE = 160  # pixels a side
FRAMES = {"whole gradient": True, "two lengths": False}


class EditErrors(NamedTuple):
    """The largest errors of one map over all Gaussians and seeds."""

    centre: float
    """World units; the scene is about 2 wide."""
    covariance: float
    """Relative to the largest entry of each matrix."""
    color: float
    """On the scale from 0 to 1."""
    image: float | None
    """On the scale from 0 to 1; None where no camera sees the same image."""


def cloud(rng: np.random.Generator) -> Gaussians:
    """Return Gaussians of all shapes and colours of degree 3 around (0, 0, 4), in float64."""
    return Gaussians(
        means=np.array([0.0, 0, 4]) + 0.5 * rng.normal(size=(N, 3)),
        quats=rng.normal(size=(N, 4)),
        log_scales=np.log(0.12) + rng.uniform(-1.5, 0.5, size=(N, 3)),
        opacity_logits=1 + rng.normal(size=N),
        sh_dc=rng.normal(size=(N, 3)),
        sh_rest=0.3 * rng.normal(size=(N, 15, 3)),
    )


def camera() -> Camera:
    """Return a camera at the origin that looks along z."""
    return Camera(np.eye(3), np.zeros(3), SIZE, SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE)


def edit_errors(name: str, seed: int) -> EditErrors:
    """Return the errors of a map for one cloud."""
    A = MAPS[name]
    before = cloud(np.random.default_rng(seed))
    after = edit_gaussians(before, Affine(A, SHIFT), np.ones(N, bool))
    long_A = A.astype(np.longdouble)  # so that the truth is not rounded as the edit is
    expected = long_A @ _sigma(before) @ long_A.T  # [N, 3, 3]
    relative = np.abs(_sigma(after) - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    d = np.random.default_rng(seed).normal(size=(N, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    Q = polar_rotations(A[None])[0]
    color = np.abs(_colors(after, d @ Q.T) - _colors(before, d)).max()
    image = None
    if name in SIMILAR:
        difference = _image(after, _move_back(A, Q)) - _image(before, camera())
        image = float(np.abs(difference).max())
    centre = np.abs(after.means - (before.means @ long_A.T + SHIFT)).max()
    return EditErrors(float(centre), float(relative.max()), float(color), image)


def _move_back(A: Floats, Q: Floats) -> Camera:
    """Return the camera that sees ``A x + b`` as :func:`camera` sees x, for ``A = s Q``: R' = R Q^T, t' = s t - R' b.

    For a reflection the camera's rotation becomes a reflection, too, and so the image is mirrored; the formulas stay.
    """
    s = np.linalg.norm(A[:, 0])
    R = camera().cam_from_world_R @ Q.T
    return camera()._replace(cam_from_world_R=R, cam_from_world_t=s * camera().cam_from_world_t - R @ SHIFT)


def _sigma(gaussians: Gaussians) -> Floats:
    return covariances(gaussians.quats, np.exp(gaussians.log_scales))


def _colors(gaussians: Gaussians, directions: Floats) -> Floats:
    coefficients = np.concatenate([gaussians.sh_dc[:, None], gaussians.sh_rest], axis=1)
    return 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions, 3), coefficients)


def _image(gaussians: Gaussians, view: Camera) -> Floats:
    return render(gaussians, view, backend=CPU)[0].image


def flat_gaussians(rng: np.random.Generator) -> Gaussians:
    """Return checkered flat Gaussians with random axes in the square from -1 to 1 of the plane z = 0."""
    n = 40
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    angle = rng.uniform(0, np.pi, n * n)
    is_dark = (np.floor(3 * x) + np.floor(3 * y)) % 2 == 0
    colors = np.where(is_dark[:, None], [0.1, 0.25, 0.6], [0.95, 0.8, 0.35])
    return Gaussians(
        means=np.column_stack([x, y, np.zeros(n * n)]),
        quats=np.column_stack([np.cos(angle / 2), np.zeros((n * n, 2)), np.sin(angle / 2)]),
        log_scales=np.log(np.column_stack([rng.uniform(0.015, 0.03, (n * n, 2)), np.full(n * n, 1e-3)])),
        opacity_logits=np.full(n * n, 3.0),
        sh_dc=(colors - 0.5) / SH_C0,
        sh_rest=np.zeros((n * n, 0, 3)),
    )


def roll(points: Floats) -> Floats:
    """Return phi of points [N, 3] in the plane z = 0."""
    u = (points[:, 0] + points[:, 1] / 2) / RADIUS
    return np.column_stack([RADIUS * np.sin(u), points[:, 1], RADIUS - RADIUS * np.cos(u)])


def rolled_jacobian(points: Floats) -> Floats:
    """Return the derivative of phi [N, 3, 3], with the normal of the cylinder as its third column."""
    u = (points[:, 0] + points[:, 1] / 2) / RADIUS
    cos, sin, zero, one = np.cos(u), np.sin(u), np.zeros(len(u)), np.ones(len(u))
    columns = [(cos, zero, sin), (cos / 2, one, sin / 2), (-sin, zero, cos)]
    return np.moveaxis(np.array(columns), (0, 1, 2), (2, 1, 0))


def bend_by(cells: int, gaussians: Gaussians, is_whole: bool) -> Gaussians:
    """Return the sheet after a mesh of n x n cells has rolled it, by the whole gradient or by GaMeS's frame."""
    mesh = grid(np.array([-1.0, -1.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0, 0.0]), (cells, cells))
    binding, moved = bind(gaussians, mesh), Mesh(roll(mesh.vertices), mesh.faces)
    carried = rebuild(moved, binding)
    return carried if is_whole else _by_two_lengths(binding, moved, carried.means)


def _by_two_lengths(binding: Binding, moved: Mesh, means: Floats) -> Gaussians:
    """Return the Gaussians with ``F = Q' diag(1, s2' / s2, s3' / s3) Q^T`` of the frames Q and lengths of GaMeS."""
    (Q, lengths), (moved_Q, moved_lengths) = _gram_schmidt(binding.mesh), _gram_schmidt(moved)
    F = (moved_Q * (moved_lengths / lengths)[:, None, :]) @ np.swapaxes(Q, 1, 2)
    return deform(binding.gaussians, means, Deformation(F, binding.faces))


def _gram_schmidt(mesh: Mesh) -> tuple[Floats, Floats]:
    """Return the axes [T, 3, 3] of triangles, as columns, and their lengths [T, 3], of which the first is 1."""
    corners = mesh.corners
    a, b = corners[:, 0] - corners.mean(axis=1), corners[:, 1] - corners.mean(axis=1)  # [T, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    s2 = np.linalg.norm(a, axis=1)
    r2 = a / s2[:, None]
    rest = b - np.sum(b * r2, axis=1, keepdims=True) * r2
    s3 = np.linalg.norm(rest, axis=1)
    return np.stack([normal, r2, rest / s3[:, None]], axis=2), np.column_stack([np.ones(len(s2)), s2, s3])


def bend_errors(gaussians: Gaussians) -> dict[str, Any]:
    """Return the largest errors of centres and, for each frame, of covariances, by number of cells."""
    J = rolled_jacobian(gaussians.means)
    truth = J @ _sigma(gaussians) @ np.swapaxes(J, 1, 2)
    size = np.abs(truth).max(axis=(1, 2))
    result: dict[str, Any] = {"cells": [], "centre": [], "covariance": {name: [] for name in FRAMES}}
    for cells in kit.with_progress(CELLS, "bending"):
        result["cells"].append(cells)
        for name, is_whole in FRAMES.items():
            carried = bend_by(cells, gaussians, is_whole)
            relative = np.abs(_sigma(carried) - truth).max(axis=(1, 2)) / size
            result["covariance"][name].append(float(relative.max()))
        result["centre"].append(float(np.linalg.norm(carried.means - roll(gaussians.means), axis=1).max()))
    return result


def run(args: argparse.Namespace) -> kit.Report:
    """Compare edits with the affine maps themselves, and a rolled sheet with the cylinder."""
    edits = {}
    for name in kit.with_progress(MAPS, "edits"):
        rows = [edit_errors(name, seed)._asdict() for seed in range(args.seeds)]
        edits[name] = {key: None if rows[0][key] is None else max(row[key] for row in rows) for key in rows[0]}
    bend = bend_errors(flat_gaussians(np.random.default_rng(0)))
    columns = (bend["cells"], bend["centre"], *bend["covariance"].values())
    lines = [[str(n), *(f"{e:.1e}" for e in row)] for n, *row in zip(*columns, strict=True)]
    heading = ["cells a side", "centre", *(f"covariance, {name}" for name in bend["covariance"])]
    text = f"largest error of an affine edit, in float64\n\n{table_of('map', edits)}\n\n"
    text += "largest error of a sheet that a mesh shears and rolls onto a cylinder\n\n" + markdown_table(heading, lines)
    return kit.Report({"seeds": args.seeds, "edits": edits, "bend": bend}, draw(bend, seed=0), text)


def draw(bend: dict[str, Any], seed: int) -> Figure:
    """Draw a sheet, an edit of its middle, the rolled sheet, and the errors of rolling."""
    figure, panels = subplots((9.0, 2.6), 1, 4, gridspec_kw={"width_ratios": [1, 1, 1, 1.5]})
    sheet, centre = flat_gaussians(np.random.default_rng(seed)), np.zeros(3)
    raised = make_affine(make_rotation((0.0, 0.0, 45.0)), centre, np.array([0.0, 0.0, -0.4]))
    images = {
        "a sheet": sheet,
        "its middle rotated\nby 45° and raised": edit_gaussians(sheet, raised, are_in_ball(sheet.means, centre, 0.6)),
        f"sheared and rolled\nby {CELLS[3]} x {CELLS[3]} cells": bend_by(CELLS[3], sheet, True),
    }
    for axes, (title, gaussians) in zip(panels, images.items(), strict=False):
        image = render(_before_the_camera(gaussians), camera(), background=np.ones(3))[0].image
        show(axes, image, title)
    axes = panels[3]
    axes.loglog(bend["cells"], bend["centre"], "o-", color=GREY, label="centre (the sheet is 2 wide)")
    for (name, errors), color in zip(bend["covariance"].items(), (BLUE, RED), strict=True):
        axes.loglog(bend["cells"], errors, "o-", color=color, label=f"covariance, {name}")
    set_ticks(axes, bend["cells"], [str(n) for n in bend["cells"]])
    axes.set_xlabel("cells a side", fontsize=8)
    axes.set_title("largest error of the rolled sheet", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
    return figure


def _before_the_camera(sheet: Gaussians) -> Gaussians:
    """Return the sheet tilted and moved so that the camera sees it obliquely from above."""
    tilted = Affine(make_rotation((-50.0, 0.0, 0.0)), np.array([0.0, -0.1, 3.2]))
    return edit_gaussians(sheet, tilted, np.ones(len(sheet.means), bool))
