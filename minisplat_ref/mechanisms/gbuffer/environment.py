"""Light from infinitely far away: an image in latitude and longitude, read along directions.

The unit direction d = (x, y, z), world frame, has the polar angle theta from the z axis and the azimuth phi, and reads
an image of H rows and W columns at::

    theta = atan2(rho, z),   phi = atan2(y, x),   rho = sqrt(x^2 + y^2)
    row = theta H / pi - 1/2,   column = (phi / (2 pi) + 1/2) W - 1/2

bilinearly between the centres of four texels. Columns go around; beyond the first and the last row the colour stays.
"""

from typing import NamedTuple

import numpy as np

from minisplat_ref.types import Floats, Ints


class Places(NamedTuple):
    """The places at which P directions read an image of H x W texels."""

    texels: Ints
    """[4, P] indices i W + j of the texels: upper left, upper right, lower left, lower right."""
    down: Floats
    """[P] share of the lower ones."""
    right: Floats
    """[P] share of the right ones."""
    v_row: Floats
    """[P, 3] derivative of the row with respect to d; 0 beyond the outer rows, and at the poles."""
    v_column: Floats
    """[P, 3] derivative of the column."""


def texel_directions(height: int, width: int) -> tuple[Floats, Floats]:
    """Return the directions [H, W, 3] of the texels' centres and their solid angles [H, W], which add up to 4 pi."""
    edges = np.pi * np.arange(height + 1) / height
    theta, phi = np.pi * (np.arange(height) + 0.5) / height, 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sine = np.sin(theta)[:, None]
    directions = np.stack(
        [sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(np.cos(theta)[:, None], (height, width))], axis=2
    )
    rings = (np.cos(edges[:-1]) - np.cos(edges[1:])) * 2 * np.pi / width  # [H]
    return directions, np.repeat(rings[:, None], width, axis=1)


def locate(directions: Floats, height: int, width: int) -> Places:
    """Return the places at which unit directions [P, 3] read an image of ``height`` x ``width`` texels."""
    x, y, z = directions.T
    rho2 = x * x + y * y
    rho = np.sqrt(rho2)
    row = np.arctan2(rho, z) * (height / np.pi) - 0.5
    column = (np.arctan2(y, x) / (2 * np.pi) + 0.5) * width - 0.5
    is_between = (row > 0) & (row < height - 1) & (rho > 0)
    row = np.clip(row, 0, height - 1)
    upper = np.minimum(row.astype(np.int64), max(height - 2, 0))
    left = np.floor(column).astype(np.int64)
    rows = upper * width, np.minimum(upper + 1, height - 1) * width
    columns = left % width, (left + 1) % width
    texels = np.stack([rows[0] + columns[0], rows[0] + columns[1], rows[1] + columns[0], rows[1] + columns[1]])
    safe, safe2 = np.where(rho > 0, rho, 1), np.where(rho > 0, rho2, 1)
    of_theta = np.stack([z * x / safe, z * y / safe, -rho], axis=1) * (height / np.pi)
    of_phi = np.stack([-y / safe2, x / safe2, np.zeros_like(x)], axis=1) * (width / (2 * np.pi))
    v_column = np.where((rho > 0)[:, None], of_phi, 0)
    return Places(texels, row - upper, column - left, np.where(is_between[:, None], of_theta, 0), v_column)


def read(image: Floats, places: Places) -> Floats:
    """Return the colours [P, 3] of an image [H, W, 3] at places."""
    upper_left, upper_right, lower_left, lower_right = image.reshape(-1, 3)[places.texels]
    a, b = places.right[:, None], places.down[:, None]
    return (1 - b) * ((1 - a) * upper_left + a * upper_right) + b * ((1 - a) * lower_left + a * lower_right)


def read_vjp(image: Floats, places: Places, v_colors: Floats) -> tuple[Floats, Floats]:
    """Gradient of :func:`read` with respect to the texels [H, W, 3], in float64, and to the directions [P, 3].

    ::

        v_texel = sum of its shares times v_c        v_row = v_c . dc/drow,  v_d = v_row drow/dd + v_col dcol/dd
    """
    upper_left, upper_right, lower_left, lower_right = image.reshape(-1, 3)[places.texels]
    a, b = places.right[:, None], places.down[:, None]
    shares = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    weighted = np.stack([share * v_colors for share in shares]).reshape(-1, 3)
    n_texels, texels = image.shape[0] * image.shape[1], places.texels.ravel()
    v_image = np.empty((n_texels, 3))
    for k in range(3):
        v_image[:, k] = np.bincount(texels, weighted[:, k], n_texels)
    along_row = (1 - a) * (lower_left - upper_left) + a * (lower_right - upper_right)
    along_column = (1 - b) * (upper_right - upper_left) + b * (lower_right - lower_left)
    v_row = np.sum(v_colors * along_row, axis=1, keepdims=True)
    v_column = np.sum(v_colors * along_column, axis=1, keepdims=True)
    return v_image.reshape(image.shape), v_row * places.v_row + v_column * places.v_column
