"""Find photographs of different focal lengths where nothing in the files tells them apart: a zoom without EXIF data.

Photographs of one size without EXIF data begin with one camera. If the lens was zoomed between them, that camera's
focal length fits none of them: 2.3 widths for 1.3 and 1.8, with a distortion that no lens has. The points know better.
In a bundle adjustment that gives each photograph its own camera, their focal lengths come apart into groups, which are
a percent or two wide.

Where hardly any photograph finds a place with one camera for all, the first cameras are estimated one for each.

Groups are believed if they are further apart than a tenth, and than several times their spread, and if one camera for
each explains the points clearly better than one for all. Where focal lengths differ without groups, as if each
photograph had its own, the photographs keep one camera, with a warning. Photographs whose EXIF data have a focal length
are left as they are.
"""

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from minisplat_ref.datasets.photo_files import enumerate_names
from minisplat_ref.datasets.sfm.features import opened
from minisplat_ref.datasets.sfm.photographs import Group, Photographs
from minisplat_ref.errors import InputWarning, one_line
from minisplat_ref.io.lens import import_quiet_pycolmap

# Numbers of ours, chosen on synthetic photographs with two and three focal lengths, and on scenes with one:
RATIO_MIN = 1.1  # of two neighbouring focal lengths of different groups; autofocus alone changes some percent
GROUP_MIN = 2  # photographs
SPREADS_MIN = 4.0  # between the means of two groups, in standard deviations of the wider one
ERROR_MAX = 0.9  # of the mean reprojection error with one camera, for more cameras to be believed
POINTS_MAX = 2000  # of the longest tracks, which are enough for focal lengths, in seconds
STEPS_MAX = 50  # of a bundle adjustment
RANGE_MAX = 1.3  # from the tenth to the ninetieth percentile of focal lengths without groups, before there is a warning

Groups = Mapping[Group, Sequence[str]]


def split_groups(model: Any, groups: Groups) -> dict[Group, list[str]]:
    """Return the groups of photographs with one camera each, those apart that were taken with different zooms.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Of the photographs, with a camera for each group; None counts as one that shows nothing.
    groups : mapping of Group to names
        Photographs that share a camera now.

    Warns
    -----
    InputWarning
        Focal lengths differ, but not in groups.
    """
    new: dict[Group, list[str]] = {}
    for group, names in groups.items():
        parts = [] if model is None or group.focal is not None or group.focal_35 is not None else _parts(model, names)
        if len(parts) < 2:
            new[group] = list(names)
            continue
        placed = {name for focals in parts for name in focals}
        for i, focals in enumerate(parts):
            widths = math.exp(np.mean(np.log(list(focals.values())))) / group.width
            rest = [name for name in names if name not in placed] if i == 0 else []  # one of which nothing is known
            new[group._replace(found=widths)] = [name for name in names if name in focals or name in rest]
    return new


def own_groups(groups: Groups) -> dict[Group, list[str]]:
    """Return groups in which each photograph without a known focal length has a camera to itself; empty if none has."""
    own: dict[Group, list[str]] = {}
    for group, names in groups.items():
        if group.focal is not None or group.focal_35 is not None or len(names) < 2 * GROUP_MIN:
            own[group] = list(names)
        else:
            own |= {group._replace(found=float(i)): [name] for i, name in enumerate(names)}
    return own if len(own) > len(groups) else {}


def _parts(model: Any, names: Sequence[str]) -> list[dict[str, float]]:
    """Return the focal lengths, pixels, of the photographs of a group by their names, one mapping for each zoom."""
    placed = {image.name for image in model.images.values() if image.has_pose} & set(names)
    if len(placed) < 2 * GROUP_MIN:
        return []
    each = _adjust(model, lambda name: name)
    focals = {image.name: image.camera.mean_focal_length() for image in each.images.values() if image.name in placed}
    parts = separate(focals)
    low, high = np.quantile(list(focals.values()), (0.1, 0.9))
    if len(parts) == 1 and high <= RANGE_MAX * low:
        return []
    one = _adjust(model, lambda name: "" if name in placed else name)
    numbers = {name: str(i) for i, part in enumerate(parts) for name in part}
    several = each if len(parts) == 1 else _adjust(model, lambda name: numbers.get(name, name))
    if several.compute_mean_reprojection_error() > ERROR_MAX * one.compute_mean_reprojection_error():
        return []
    if len(parts) == 1:
        shortest, longest = min(focals, key=focals.__getitem__), max(focals, key=focals.__getitem__)
        message = (
            f"the photographs seem to have focal lengths from {focals[shortest]:.0f} ({shortest}) to"
            f" {focals[longest]:.0f} pixels ({longest}) and share one camera, which fits none of them: give them their"
            " focal lengths in the EXIF data, or take them without zooming"
        )
        warnings.warn(one_line(message), InputWarning, stacklevel=4)
    return [{name: focals[name] for name in part} for part in parts]


def separate(focals: Mapping[str, float]) -> list[list[str]]:
    """Return the names of photographs in groups of one focal length, the shortest first; one group if it is not clear.

    Parameters
    ----------
    focals : mapping of str to float
        Focal lengths by the names of photographs, in any unit.
    """
    ordered = sorted(focals, key=lambda name: (focals[name], name))
    logs = {name: math.log(focals[name]) for name in ordered}
    parts: list[list[str]] = []
    for name in ordered:
        if parts and logs[name] - logs[parts[-1][-1]] < math.log(RATIO_MIN):
            parts[-1].append(name)
        else:
            parts.append([name])
    parts = [part for part in parts if len(part) >= GROUP_MIN]
    if not parts:
        return [ordered]
    for name in ordered:  # a single one belongs to the nearest
        if not any(name in part for part in parts):
            min(parts, key=lambda part: abs(logs[name] - _mean(logs, part))).append(name)
    for one, other in pairwise(parts):
        spread = max(float(np.std([logs[name] for name in part])) for part in (one, other))
        if _mean(logs, other) - _mean(logs, one) < SPREADS_MIN * spread:
            return [ordered]
    return parts


def _mean(logs: Mapping[str, float], part: Iterable[str]) -> float:
    return float(np.mean([logs[name] for name in part]))


def _adjust(model: Any, camera_of: Callable[[str], str]) -> Any:
    """Return a model after a bundle adjustment in which photographs with equal keys, by their names, share a camera."""
    pycolmap = import_quiet_pycolmap()
    new = pycolmap.Reconstruction()
    camera_ids: dict[str, int] = {}
    for image_id, image in model.images.items():
        if not image.has_pose:
            continue
        key, camera = camera_of(image.name), image.camera
        if key not in camera_ids:
            camera_ids[key] = len(camera_ids) + 1
            size = {"width": camera.width, "height": camera.height}
            params = np.array(camera.params)
            new.add_camera_with_trivial_rig(
                pycolmap.Camera(camera_id=camera_ids[key], model=camera.model, params=params, **size)
            )
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        copy = pycolmap.Image(image_id=image_id, name=image.name, camera_id=camera_ids[key], keypoints=keypoints)
        new.add_image_with_trivial_frame(copy, image.cam_from_world())
    longest = sorted(model.points3D.items(), key=lambda item: (-item[1].track.length(), item[0]))
    for point_id, point in longest[:POINTS_MAX]:
        new.add_point3D_with_id(point_id, point)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in new.images:
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.THREE_POINTS)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.max_num_iterations = STEPS_MAX
    pycolmap.create_default_bundle_adjuster(options, config, new).solve()
    new.update_point_3d_errors()
    return new


def copy_database(old: Path, new: Path, photographs: Photographs, camera_model: str) -> None:
    """Write a database with the features and matches of another one, and a camera for each group.

    Parameters
    ----------
    old : Path
        Database of COLMAP.
    new : Path
        File to make.
    photographs : Photographs
        The same ones, in other groups.
    camera_model : str
        COLMAP model of the cameras.
    """
    pycolmap = import_quiet_pycolmap()
    with opened(new):
        pass  # which makes the file
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    for names in photographs.groups.values():
        pycolmap.import_images(new, photographs.images, pycolmap.CameraMode.SINGLE, names, reader)
    with opened(old) as source, opened(new) as target:
        new_ids = {image.name: image.image_id for image in target.read_all_images()}
        ids = {image.image_id: new_ids[image.name] for image in source.read_all_images()}
        for old_id, new_id in ids.items():
            target.write_keypoints(new_id, source.read_keypoints(old_id))
            target.write_descriptors(new_id, source.read_descriptors(old_id))
        for pair_id, matches in zip(*source.read_all_matches(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            target.write_matches(ids[a], ids[b], matches)
        for pair_id, geometry in zip(*source.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            target.write_two_view_geometry(ids[a], ids[b], geometry)


def describe_found(groups: Groups) -> str:
    """Return which photographs were found to have which focal length, empty if none were told apart."""
    found = {group: names for group, names in groups.items() if group.found is not None}
    parts = [f"{group.found:.2f} times the width: {enumerate_names(list(names))}" for group, names in found.items()]
    return "; ".join(parts)
