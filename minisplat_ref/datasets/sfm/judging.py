"""Choose among the models of several mappers and features.

A wrong model may place all photographs, have more points than a right one and a smaller reprojection error: the global
mapper gave one of 50 photographs of a fox before a wallpaper that repeats, with half of the cameras far off. The
matches contradict it: features that two photographs share lie off each other's epipolar lines if a pose is wrong. So
the matches are counted that a model explains; for all models the same ones, of the densest features that were tried. A
photograph without a place explains none. Among models that explain nearly as many, the one with more points is better.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.datasets.sfm.features import MATCHES_MIN, opened
from minisplat_ref.datasets.sfm.mapping import Mapped
from minisplat_ref.io.lens import import_quiet_pycolmap
from minisplat_ref.types import Floats

DISTANCE_MAX = 4.0  # pixels from the epipolar line, of a match that fits; COLMAP's threshold when it verifies a pair
GOOD = 0.95  # of the matches: right models of scenes that stand still explain 96 % and more, a wrong one 91 %
SAME = 0.99  # models that explain this share of the most matches are equally good


class Matches(NamedTuple):
    """Verified matches between two photographs."""

    names: tuple[str, str]
    first: Floats
    """[M, 2] in the first photograph, pixels."""
    second: Floats
    """[M, 2] in the second one, pixels."""


def read_matches(database: Path) -> list[Matches]:
    """Return the verified matches of all pairs that overlap."""
    pycolmap = import_quiet_pycolmap()
    with opened(database) as content:
        names = {image.image_id: image.name for image in content.read_all_images()}
        keypoints = {image_id: np.asarray(content.read_keypoints(image_id), np.float64)[:, :2] for image_id in names}
        pair_ids, geometries = content.read_two_view_geometries()
    pairs = []
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        rows = np.asarray(geometry.inlier_matches)  # [M, 2]
        if len(rows) >= MATCHES_MIN:
            pairs.append(Matches((names[a], names[b]), keypoints[a][rows[:, 0]], keypoints[b][rows[:, 1]]))
    return pairs


def count_explained(model: Any, pairs: Sequence[Matches]) -> int:
    """Return the number of matches within DISTANCE_MAX of the epipolar lines of a model's cameras.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    pairs : sequence of Matches
        A match with a photograph that has no place counts as not explained.
    """
    pycolmap = import_quiet_pycolmap()
    images = {image.name: image for image in model.images.values() if image.has_pose}
    n_explained = 0
    for matches in pairs:
        if not images.keys() >= set(matches.names):
            continue
        a, b = (images[name] for name in matches.names)
        b_from_a = b.cam_from_world() * a.cam_from_world().inverse()
        squared = pycolmap.compute_squared_sampson_error(
            a.camera.cam_from_img(matches.first),
            b.camera.cam_from_img(matches.second),
            pycolmap.essential_matrix_from_pose(b_from_a),
        )
        focal = 0.5 * (a.camera.mean_focal_length() + b.camera.mean_focal_length())
        n_explained += int((np.sqrt(squared) * focal <= DISTANCE_MAX).sum())
    return n_explained


def is_good(result: Mapped, pairs: Sequence[Matches], n_photos: int) -> bool:
    """Return whether a result leaves nothing to be found by another mapper: it places all, and explains GOOD of them.

    Parameters
    ----------
    result : Mapped
    pairs : sequence of Matches
    n_photos : int
        Photographs that were given.
    """
    n_matches = sum(len(matches.first) for matches in pairs)
    return result.n_placed == n_photos and n_matches > 0 and count_explained(result.model, pairs) >= GOOD * n_matches


def choose(results: Sequence[Mapped], pairs: Sequence[Matches]) -> tuple[Mapped, list[Mapped]]:
    """Return the best result, and the others; all of them with the number of matches that they explain.

    Parameters
    ----------
    results : sequence of Mapped
        At least one.
    pairs : sequence of Matches
        Of the densest features.
    """
    judged = [
        result if result.model is None else result._replace(n_explained=count_explained(result.model, pairs))
        for result in results
    ]
    most = max(result.n_explained for result in judged)
    best = max((result for result in judged if result.n_explained >= SAME * most), key=lambda result: result.n_points)
    return best, [result for result in judged if result is not best]
