"""Estimate cameras and sparse points from a folder of photographs, on the CPU: structure from motion by COLMAP.

Photographs are rotated upright and shrunk (:mod:`.photographs`), features are found and matched (:mod:`.features`), two
mappers estimate cameras and points (:mod:`.mapping`), once more if photographs turn out to have been zoomed
(:mod:`.zoom`), and the best result (:mod:`.judging`) is undistorted. The result is a COLMAP
scene with pinhole cameras: ``images/``, ``sparse/0/``, and ``masks/`` if there were masks. Photographs that could not
be placed are named and left out.
"""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from minisplat_ref.datasets.sfm.attempts import Part, reconstruct
from minisplat_ref.datasets.sfm.level import record_up
from minisplat_ref.datasets.sfm.mapping import Mapped
from minisplat_ref.datasets.sfm.photographs import Group, prepare_photos
from minisplat_ref.datasets.undistort import undistort_colmap
from minisplat_ref.datasets.video import is_video, keep_sharpest
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.colmap import colmap_photos
from minisplat_ref.io.upright import Up

PHOTOS_MIN, SHARE_MIN = 3, 0.25  # of the given ones; fewer placed photographs are no scene of them


class SfmResult(NamedTuple):
    """The result, for the report."""

    n_photos: int
    """Photographs that were given."""
    left_out: tuple[str, ...]
    """Names of those that could not be placed, in the folder of photographs."""
    n_points: int
    """Sparse points."""
    error: float
    """Mean reprojection error before undistortion, pixels."""
    kept: Mapped
    """The result that was kept, without its model."""
    others: tuple[Mapped, ...]
    """The other results, without their models: of the other mapper and of other features, if they were tried."""
    n_matches: int
    """Verified matches, with which the results were judged."""
    groups: Mapping[Group, list[str]]
    """Names of the photographs that share a camera; of those told apart by their focal length, the placed ones."""
    n_masks: int
    """Photographs with a mask."""
    sizes: tuple[tuple[int, int], ...]
    """Width and height of each photograph in the scene, pixels."""
    up: Up
    """What is up."""
    parts: tuple[Part, ...] = ()
    """The parts of the work, with their processor times."""


def default_matching(photos: Path) -> str:
    """Return the default matching: of the frames of a video neighbours, of photographs more where these fail."""
    return "sequential" if is_video(photos) else "auto"


def run_sfm(
    photos: Path,
    out: Path,
    *,
    long_side: int = 1600,
    matching: str | None = None,
    every: int | None = None,
    features: str = "auto",
    camera_model: str = "SIMPLE_RADIAL",
    up: str | None = None,
) -> SfmResult:
    """Make a COLMAP scene with pinhole cameras from photographs, complete or not at all.

    Parameters
    ----------
    photos : Path
        Folder of photographs, or a video.
    out : Path
        Folder to make.
    long_side : int
        Photographs with a longer side are shrunk to this, pixels.
    matching : str, optional
        "auto": neighbours in time, and every pair if that leaves photographs without a place. "exhaustive": every pair.
        "sequential": neighbours alone, for videos, whose default it is.
    every : int, optional
        Frames of a video of which the sharpest is kept; those of half a second by default.
    features : str
        "standard": COLMAP's own setting. "dense": more features, matched more thoroughly, which takes longer. "auto":
        standard, then dense if that leaves photographs without a place; the better result is kept.
    camera_model : str
        COLMAP model that is estimated, for each group of photographs with one size, camera and focal length.
    up : str, optional
        What is up (:func:`minisplat_ref.io.upright.given_up`), instead of what photographs and points show.

    Returns
    -------
    SfmResult

    Raises
    ------
    InputError
        If there are fewer than two photographs, one cannot be read, or hardly any finds a place.
    """
    if long_side < 1:
        raise InputError(f"--long-side is {long_side}; it must be positive")
    if every is not None and not is_video(photos):
        raise InputError(f"--every is for a video, which {photos} is not: leave it out")
    matching = matching or default_matching(photos)
    with making_folder(out) as folder, TemporaryDirectory(dir=folder) as temporary:
        work = Path(temporary)
        source = photos
        if is_video(photos):
            source = work / "frames"
            source.mkdir()
            keep_sharpest(photos, source, every)
        photographs = prepare_photos(source, work, long_side)
        n_photos = len(photographs.originals)
        if n_photos < 2:
            raise InputError(f"{photos}: 1 photograph, structure from motion needs at least 2 that overlap; take more")
        best, others, n_matches, groups, parts = reconstruct(photographs, work, matching, features, camera_model)
        _check_placed(best, n_photos, photos, matching)
        (work / "sparse" / "0").mkdir(parents=True)
        best.model.write(work / "sparse" / "0")
        written = undistort_colmap(work, colmap_photos(work), folder)
        upright = record_up(folder, photographs, up)
    placed = {image.name for image in best.model.images.values() if image.has_pose}
    return SfmResult(
        n_photos=n_photos,
        left_out=tuple(str(original) for name, original in photographs.originals.items() if name not in placed),
        n_points=best.n_points,
        error=best.model.compute_mean_reprojection_error(),
        kept=best._replace(model=None),
        others=tuple(other._replace(model=None) for other in others),
        n_matches=n_matches,
        groups={
            group: [name for name in names if group.found is None or name in placed] for group, names in groups.items()
        },
        n_masks=len(photographs.masked),
        sizes=tuple((photo.camera.width, photo.camera.height) for photo in written),
        up=upright,
        parts=parts,
    )


def _check_placed(best: Mapped, n_photos: int, photos: Path, matching: str) -> None:
    """Refuse a result that is no scene of the photographs."""
    if best.model is None:
        raise InputError(
            f"{photos}: no two photographs could be placed; take them with more overlap, of something with texture"
        )
    if best.n_placed < max(min(n_photos, PHOTOS_MIN), SHARE_MIN * n_photos):
        raise InputError(
            f"{photos}: {best.n_placed} of {n_photos} photographs ({best.n_placed / n_photos:.0%}) found a place, too"
            f" few for a scene; {advice(matching)}"
        )


def advice(matching: str) -> str:
    """Return the usual remedy for photographs that could not be placed after this kind of matching."""
    if matching == "sequential":
        return (
            "--matching sequential compares neighbours in the order of file names, which suits frames of a video; for"
            " other photographs use --matching exhaustive"
        )
    return (
        "what usually helps: more photographs between those that do not join, so that each shares most of its view with"
        " two others; sharp ones, with a step to the side between shots; a subject with texture that does not move"
    )
