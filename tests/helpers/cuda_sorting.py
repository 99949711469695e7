"""``python cuda_sorting.py OUT``: sums, sorts and lists in the simulator, whose blocks are small, so that many run."""

import pickle
import sys
from pathlib import Path

import numpy as np

from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.types import Projection, TileGrid

COUNTED = (0, 31, 32, 70)  # Gaussians; a block has 32
SORTED = (0, 1, 128, 300)  # keys; a block has 128, 64 of each warp
DEPTHS = (0.5, -2.0, 1e30, -0.0, -1e30, 0.0, -1e-30, 1e-30, -1.0, 3.0)
BITS = {np.int32: 17, np.int64: 36}
GRID = TileGrid(400, 340, 16, 16)  # 550 tiles: two digits


def make_keys(n, dtype):
    """Keys of so many bits, many of them equal in some digits or altogether."""
    rng = np.random.default_rng(n)
    return (rng.integers(0, 8, n) << (BITS[dtype] - 3) | rng.integers(0, 3, n) << 7).astype(dtype)


def make_projection(n, dtype=np.float32):
    """Footprints that touch no tile, one, or a few; some depths are equal."""
    rng = np.random.default_rng(n)
    corner, size = rng.integers(0, (400, 340), (n, 2)), rng.integers(0, 60, (n, 2)) * rng.integers(0, 2, (n, 1))
    boxes = np.concatenate([corner, np.minimum(corner + size, (400, 340))], axis=1).astype(np.int32)
    depths = rng.choice([0.5, 1.5, 2.5], n).astype(dtype)
    zeros, radii = np.zeros((n, 3), dtype), np.ones((n, 2), np.int32)
    return Projection(zeros[:, :2], depths, zeros.astype(float), zeros[:, 0], radii, boxes)


def deep_projection(dtype):
    """One tile with Gaussians of the depths above."""
    n = len(DEPTHS)
    projection = make_projection(n, dtype)
    return projection._replace(depths=np.array(DEPTHS, dtype), boxes=np.tile(np.int32([0, 0, 3, 3]), (n, 1)))


def make_ellipses(n=60):
    """Boxes, centres, conics and opacities of ellipses from dots to needles, each in its smallest box; float64."""
    rng = np.random.default_rng(n)
    angles, opacities = rng.uniform(0, np.pi, n), rng.uniform(0.05, 1, n)
    sigmas = np.exp(rng.uniform(np.log(0.5), np.log(40), (n, 2)))
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    both = (axes, axes[:, ::-1] * [-1, 1])
    covariance, inverse = (
        sum(np.einsum("ni,nj->nij", v, v) * s[:, None, None] ** power for v, s in zip(both, sigmas.T, strict=True))
        for power in (2, -2)
    )
    centers = rng.uniform(0, (GRID.width, GRID.height), (n, 2))
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    reach = np.sqrt(2 * np.log(opacities / GSPLAT_MAIN.alpha_min)[:, None] * variances)
    corners = np.concatenate([np.floor(centers - reach), np.ceil(centers + reach)], axis=1)
    boxes = np.clip(corners, 0, (GRID.width, GRID.height) * 2).astype(np.int32)
    return boxes, centers, np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1), opacities


def find_reached(boxes, centers, conics, opacities):
    """The sets of tiles that ellipses reach, and their numbers, by one thread."""
    from minisplat_ref.cuda.footprints import reached_tiles
    from minisplat_ref.cuda.target import cuda, gpu_kernel, launch

    @gpu_kernel
    def write_reached(boxes, centers, conics, opacities, alpha_min, found):
        for n in range(len(opacities)):
            box = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3]
            found[n, 0], found[n, 1] = reached_tiles(box, centers[n], conics[n], opacities[n], alpha_min)

    found, alpha_min = np.zeros((len(opacities), 2), np.int64), np.float64(GSPLAT_MAIN.alpha_min)
    arrays = [cuda.to_device(array) for array in (boxes, centers, conics, opacities, found)]
    launch(write_reached, 1, 1, *arrays[:4], alpha_min, arrays[4])
    return arrays[4].copy_to_host()


def look_back():
    """The sum before block 3 where only block 0 has the sum of all blocks up to it, and what blocks have published.

    So it is on a card, where blocks run at once; the simulator runs one after another.
    """
    from minisplat_ref.cuda.scanning import ALL_SUMS, OWN_SUM, STATE_BITS, sum_before
    from minisplat_ref.cuda.target import cuda, gpu_kernel, launch

    @gpu_kernel
    def sum_blocks(counters, found):
        found[0] = sum_before(counters, 1, 2, 3, 1000)

    counters = np.zeros(9, np.int64)
    counters[1:7:2] = 5 << STATE_BITS | ALL_SUMS, 20 << STATE_BITS | OWN_SUM, 300 << STATE_BITS | OWN_SUM
    arrays = cuda.to_device(counters), cuda.to_device(np.zeros(1, np.int64))
    launch(sum_blocks, 1, 1, *arrays)
    counters, found = (array.copy_to_host() for array in arrays)
    return int(found[0]), (counters >> STATE_BITS).tolist(), int(counters[7] & ALL_SUMS) == ALL_SUMS


def sort(keys, n_bits):
    """The keys sorted by the kernels, and the order in which they were."""
    from minisplat_ref.cuda import sorting
    from minisplat_ref.cuda.target import cuda

    places = [1]

    def take(count):
        places.append(places[-1] + count)
        return places[-2]

    digits = sorting.plan_digits(take, 0, len(keys), n_bits)
    counters = np.zeros(places[-1], np.int64)
    counters[0] = len(keys)
    for digit in digits:
        found = np.bincount(keys >> digit.shift & 255, minlength=256)
        counters[digit.totals : digit.totals + 256] = found
    pair = cuda.to_device(keys.copy()), cuda.to_device(np.arange(len(keys), dtype=np.int32))
    spare = cuda.to_device(np.zeros_like(keys)), cuda.to_device(np.zeros(len(keys), np.int32))
    return tuple(x.copy_to_host() for x in sorting.sort_by_digits(pair, spare, digits, cuda.to_device(counters)))


def list_with_room_for(capacity):
    """The lists of 70 Gaussians, and what is written behind the arrays' capacity."""
    from minisplat_ref.cuda import tiling
    from minisplat_ref.cuda.arrays import to_device, to_host
    from minisplat_ref.cuda.target import launch_rows
    from minisplat_ref.cuda.workspace import Workspace

    projection = to_device(make_projection(70))
    workspace = Workspace()
    plan = tiling.plan_lists(70, capacity, GRID.n_tiles_x * GRID.n_tiles_y, 32)
    survey = tiling.start_survey(workspace, plan)
    launch_rows(tiling.survey_rows, 71, projection.boxes, projection.depths, survey, plan.survey)
    lists = tiling.list_pairs(workspace, plan, survey, projection.boxes, GRID)
    return tiling.count_pairs(survey), to_host(lists)


def main(path):
    """Write what the kernels return to a file."""
    from minisplat_ref.cuda import tiling

    pairs = {(dtype.__name__, n): sort(make_keys(n, dtype), BITS[dtype]) for dtype in BITS for n in SORTED}
    bins = {n: tiling.bin_gaussians(make_projection(n), GRID, GSPLAT_MAIN) for n in COUNTED}
    small = TileGrid(9, 7, 16, 16)
    orders = {
        t.__name__: tiling.bin_gaussians(deep_projection(t), small, GSPLAT_MAIN).gaussian_ids
        for t in (np.float32, np.float64)
    }
    n_pairs = len(bins[70].gaussian_ids)
    rooms = {room: list_with_room_for(room) for room in (n_pairs, n_pairs - 1)}
    Path(path).write_bytes(pickle.dumps((pairs, bins, orders, rooms, find_reached(*make_ellipses()), look_back())))


if __name__ == "__main__":
    main(sys.argv[1])
