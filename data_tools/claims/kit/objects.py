"""Objects of the synthetic room by their labels, and how well labels of pixels agree with them."""

import numpy as np

from minisplat_ref.types import Ints

OBJECTS = ((37,), (38,), (26,), (6, 7))  # primitives of the room: crate, ball, globe, picture; labels are 1, 2, 3, 4


def object_ids(primitives: Ints) -> Ints:
    """Return the labels [H, W] of an image of primitives."""
    ids = np.zeros(primitives.shape, np.int64)
    for label, own in enumerate(OBJECTS, start=1):
        ids[np.isin(primitives, own)] = label
    return ids


def mean_iou(drawn: list[Ints], truth: list[Ints]) -> float:
    """Return intersection over union of each object over all views together, and of these the mean."""
    found, true = np.stack(drawn), np.stack(truth)
    shares = []
    for label in range(1, 1 + len(OBJECTS)):
        either = np.count_nonzero((found == label) | (true == label))
        shares.append(np.count_nonzero((found == label) & (true == label)) / either if either else 1.0)
    return float(np.mean(shares))
