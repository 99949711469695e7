"""``mesh``: the surface of a run, fused from the depths that its training cameras show (after KinectFusion and 2DGS).

The cameras render the run; photographs are not needed. A first pass over them locates the surface, which determines the
size of the grid; a second fuses the depths (:mod:`minisplat_ref.mechanisms.fusion`).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.depth_maps import DepthKind, depth_map
from minisplat_ref.app.runs.scoring import Trained, load_trained
from minisplat_ref.app.runs.settings import load_frame, load_up
from minisplat_ref.constants import PROFILES
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io import viewpoints
from minisplat_ref.io.frames import place_camera
from minisplat_ref.io.orbits import nearest_to_axes
from minisplat_ref.io.upright import UNKNOWN, Up, choose_up
from minisplat_ref.io.viewpoints import Viewpoint
from minisplat_ref.mechanisms.fusion.extraction import ColoredMesh, extract, keep_largest, marching_cubes_package
from minisplat_ref.mechanisms.fusion.kernels import fuse
from minisplat_ref.mechanisms.fusion.volume import BOUND, Contraction, DepthMap, Grid, empty_volume
from minisplat_ref.reference.pinhole import pinhole_rays, with_principal_point
from minisplat_ref.types import Camera, Floats, Frame, view_from

N_VOXELS_MAX = 1 << 24  # of a grid that is proposed: 256 along each axis of a cube, 400 MB
TRUNCATION = 5  # voxels
BOX_SHARE = 0.02  # of the surface's points that may lie outside of the box on either side of an axis
MARGIN = 2 * TRUNCATION  # voxels around the box
POINTS_PER_VIEW = 4_000  # in the first pass


class MeshOptions(NamedTuple):
    """The options of the command line."""

    run: Path
    depth: DepthKind = DepthKind.MEDIAN
    voxel: float | None = None
    """In the unit of the scene's files, for a contracted grid of the part that is not contracted."""
    is_unbounded: bool = False
    min_views: int = 2
    """Views that must have seen each corner of a cell."""
    n_parts: int = 50
    """Connected parts that are kept, the largest."""


class Meshed(NamedTuple):
    """The surface, in the frame of the run's files, and the settings of its extraction."""

    mesh: ColoredMesh
    voxel: float
    """In the files' unit."""
    shape: tuple[int, int, int]
    n_views: int
    n_left_out: int
    """Triangles in smaller parts."""


class Opened(NamedTuple):
    """A run and its training cameras, in the frame in which it renders."""

    trained: Trained
    views: list[Viewpoint]
    frame: Frame
    up: Up = UNKNOWN
    """What is up."""

    def render_map(self, view: Viewpoint, kind: DepthKind) -> DepthMap:
        """Return the image and the depth map of a camera."""
        return depth_map(self.trained, view_from(view.camera, time=view.time), kind)

    def adapt_camera(self, view: Viewpoint) -> Camera:
        """Return the camera as the run's conventions see it."""
        return with_principal_point(view.camera, PROFILES[self.trained.profile])


def open_for_mesh(folder: Path, up: str | None = None) -> Opened:
    """Read a run and its training cameras.

    Parameters
    ----------
    folder : Path
        Of the run.
    up : str, optional
        As for :func:`.model_source.open_source`.

    Raises
    ------
    InputError
        The folder holds no run, its cameras cannot be read, or ``up`` makes no sense.
    """
    trained, frame = load_trained(folder), load_frame(folder)
    every = viewpoints.read(folder / run_folder.CAMERAS)
    every = [view._replace(camera=place_camera(view.camera, frame)) for view in every]
    found = choose_up(up, load_up(folder), every, trained.model.gaussians.means) or UNKNOWN
    return Opened(trained, [view for view in every if view.split != "test"] or every, frame, found)


def mesh_run(opened: Opened, options: MeshOptions) -> Meshed:
    """Return the surface of a run.

    Raises
    ------
    InputError
        No view shows a surface, the grid does not fit into memory, the renderer has no such depth, or scikit-image is
        not installed.
    """
    marching_cubes_package()
    unit = opened.frame.unit
    places = _find_surface(opened, options.depth)
    if len(places.points) == 0:
        raise InputError(
            f"{options.run}: no training view shows a surface that hides half of what is behind: train more"
        )
    grid = _choose_grid(opened, places, options)
    volume = empty_volume(grid)
    truncation = TRUNCATION * grid.voxel * (1.0 if grid.contraction is None else grid.contraction.radius)
    for view in with_progress(opened.views, "fusing depths", "views"):
        fuse(volume, grid, opened.adapt_camera(view), opened.render_map(view, options.depth), truncation)
    try:
        whole = extract(volume, grid, options.min_views)
    except InputError as error:
        raise InputError(f"{options.run}: {error}; lower --min-views or give a larger --voxel") from None
    mesh = keep_largest(whole, options.n_parts)
    voxel = truncation / TRUNCATION * unit
    vertices = np.array(opened.frame.origin) + unit * mesh.vertices
    n_left_out = len(whole.faces) - len(mesh.faces)
    return Meshed(mesh._replace(vertices=vertices), voxel, grid.shape, len(opened.views), n_left_out)


class _Places(NamedTuple):
    """Points of the surface, from all views."""

    points: Floats
    """[P, 3] world frame."""
    footprints: Floats
    """[P] size of their pixels, world units."""


def _find_surface(opened: Opened, kind: DepthKind) -> _Places:
    points: list[Floats] = [np.zeros((0, 3))]
    footprints: list[Floats] = [np.zeros(0)]
    for view in with_progress(opened.views, "looking for the surface", "views"):
        depth, camera = opened.render_map(view, kind).depth, opened.adapt_camera(view)
        ids = np.flatnonzero(depth > 0)
        ids = ids[:: max(1, -(-len(ids) // POINTS_PER_VIEW))]
        z = depth.ravel()[ids]
        rays = pinhole_rays(ids % camera.width + 0.5, ids // camera.width + 0.5, camera)
        points.append((z[:, None] * rays - camera.cam_from_world_t) @ camera.cam_from_world_R)
        footprints.append(z / camera.fx)
    return _Places(np.concatenate(points), np.concatenate(footprints))


def _choose_grid(opened: Opened, places: _Places, options: MeshOptions) -> Grid:
    """Return the grid: voxels as large as the pixels of the surface, or as many as ``N_VOXELS_MAX``.

    Without bounds, the space nearer to the point that the cameras face than the nearest camera is not contracted.
    """
    footprint = float(np.median(places.footprints))
    given = None if options.voxel is None else options.voxel / opened.frame.unit
    if options.is_unbounded:
        cameras = [view.camera for view in opened.views]
        centers = np.array([camera.center for camera in cameras])
        focus = nearest_to_axes(centers, np.array([camera.cam_from_world_R[2] for camera in cameras]))
        radius = float(np.linalg.norm(centers - focus, axis=1).min())
        x, y, z = focus.tolist()
        voxel = (given or max(footprint, 2 * BOUND * radius / round(N_VOXELS_MAX ** (1 / 3)))) / radius
        n = int(2 * BOUND / voxel) + 1
        return Grid((-voxel * (n - 1) / 2,) * 3, voxel, (n, n, n), Contraction((x, y, z), radius))
    low, high = np.quantile(places.points, [BOX_SHARE, 1 - BOX_SHARE], axis=0)
    voxel = given or max(footprint, float(np.prod(np.maximum(high - low, footprint)) / N_VOXELS_MAX) ** (1 / 3))
    x, y, z = (low - MARGIN * voxel).tolist()
    n_x, n_y, n_z = (np.ceil((high - low) / voxel).astype(int) + 2 * MARGIN + 1).tolist()
    return Grid((x, y, z), voxel, (n_x, n_y, n_z))
