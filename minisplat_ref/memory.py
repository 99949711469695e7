"""Estimate the memory that a training or an image needs, and refuse before the system would kill the process.

The model of a training is the one that ``python -m data_tools.machine memory`` measures against: the parameters, their
gradient and Adam's two moments; the intermediate values of each Gaussian in a view; the images of an iteration, or of
an evaluation where this is more; 48 bytes for every pair (tile, Gaussian).
The program, its compiled kernels and the photographs are in memory already and are not counted. Photographs that are
read on demand, because all together would take too much, count as far as they will stay in memory.

Free is what psutil says of the system; on Linux less where a container or ``ulimit -v`` leaves less.
"""

import math
from pathlib import Path
from typing import NamedTuple

import psutil

from minisplat_ref.errors import InputError

PHOTOGRAPH_BYTES = 3  # per pixel
IMAGE_BYTES = 4 * (3 + 1 + 3)  # per pixel in an iteration: image, alpha, and the derivative with respect to the image
# Per pixel in an evaluation: image, alpha and the clipped image in float32, their differences in float64.
MEASURING_BYTES = 4 * (3 + 1 + 3) + 8 * 3
N_COPIES = 4  # of the population: parameters, gradient, two moments
# Per Gaussian in a view: activations, footprint, colour, and derivatives with respect to them. Measured: 75 of 200,000
# in two megapixels, 210 of 1,500,000 in twelve.
BYTES_PER_GAUSSIAN = 150
# Per pair: the 9 sums of its gradient, its indices in the tile's list and in the Gaussian's, and one spare number.
BYTES_PER_PAIR = 48
PAIRS_PER_GAUSSIAN = 3.0  # where no view has been rendered yet; in three small scenes 0.7 to 3.3
# Per pixel, at the peak of rendering an image and writing it; measured at 12 and 48 megapixels: 64.2 and 64.1, with
# depth 68.2 and 68.1.
RENDER_BYTES, DEPTH_RENDER_BYTES = 65, 69
SHELF_SHARE = 0.5  # share of the free memory that photographs may fill; Gaussians need the rest
READING_BYTES = 10  # per pixel of the file while it is decoded; measured with JPEG and PNG of 12 megapixels: 10.0
RESERVE = 0.95  # share of the free memory that may be planned with


class Needs(NamedTuple):
    """The memory that a training needs besides what the program and the photographs take already."""

    n_rows: int
    """Of the population."""
    population_bytes: int
    """Of the parameters."""
    n_pairs: float
    """Pairs (tile, Gaussian) of a view."""
    n_pixels: int
    """Of the largest photograph."""
    reading_bytes: float
    """For photographs that are read on demand; 0 where all are in memory."""
    kept_bytes: float = 0.0
    """For those of them that will stay in memory once they have been read."""

    @property
    def at_the_peak(self) -> float:
        """Bytes of an iteration, or of an evaluation, which needs no gradient and no pairs but more of the image."""
        iteration = IMAGE_BYTES * self.n_pixels + training_bytes(self.n_rows, self.population_bytes, self.n_pairs)
        measurement = MEASURING_BYTES * self.n_pixels + (N_COPIES - 1) * self.population_bytes
        return max(iteration, measurement) + self.reading_bytes + self.kept_bytes

    @property
    def to_come(self) -> float:
        """Bytes at the peak without the parameters and their moments, which are in memory already."""
        return self.at_the_peak - (N_COPIES - 1) * self.population_bytes


def reading_bytes(n_pixels: int, n_file_pixels: int) -> float:
    """Return the bytes that photographs take when they are read one by one: this one, the next one, and decoding it.

    Parameters
    ----------
    n_pixels : int
        Of the largest one, as it is trained on.
    n_file_pixels : int
        Of the largest one, as stored in its file.
    """
    return 2 * PHOTOGRAPH_BYTES * n_pixels + READING_BYTES * n_file_pixels


def training_bytes(n_rows: float, population_bytes: int, n_pairs: float) -> float:
    """Return the bytes of a training that grow with its population.

    Parameters
    ----------
    n_rows : float
        Of the population.
    population_bytes : int
        Of the parameters.
    n_pairs : float
        Pairs (tile, Gaussian) of a view.
    """
    return N_COPIES * population_bytes + BYTES_PER_GAUSSIAN * n_rows + BYTES_PER_PAIR * n_pairs


def rows_that_fit(n_rows: int, population_bytes: int, n_pairs: float, free: float) -> float:
    """Return how many rows a population may grow to.

    While rows are added, the new parameters and moments exist beside the old arrays; afterwards everything is larger in
    the same proportion.

    Parameters
    ----------
    n_rows : int
        Of the population now.
    population_bytes : int
        Of its parameters.
    n_pairs : float
        Pairs (tile, Gaussian) of the last view.
    free : float
        Bytes, besides what the population takes now.
    """
    if n_rows == 0:
        return math.inf
    now, row_bytes = training_bytes(n_rows, population_bytes, n_pairs), population_bytes / n_rows
    return min(n_rows * (1 + free / now), free / ((N_COPIES - 1) * row_bytes))


def bytes_to_double(n_rows: int, population_bytes: int, n_pairs: float) -> float:
    """Return the free memory that a population needs to double: see :func:`rows_that_fit`."""
    return max(training_bytes(n_rows, population_bytes, n_pairs), 2 * (N_COPIES - 1) * population_bytes)


def free_bytes() -> float:
    """Return how many bytes this process can still get from the system, within its limits and its container's."""
    return RESERVE * min(psutil.virtual_memory().available, _of_the_control_group(), _of_the_address_space())


def _of_the_control_group(root: str = "/sys/fs/cgroup", own: str = "/proc/self/cgroup") -> float:
    """Return the least that the limits of containers and batch systems leave (control groups, version 2 or 1)."""
    free = math.inf
    for _, controllers, name in (line.split(":", 2) for line in _lines(own)):
        if controllers and "memory" not in controllers.split(","):
            continue
        of_limit, of_use, of_cache = _VERSION_1 if controllers else _VERSION_2
        folder = Path(root, "memory" if controllers else "", name.lstrip("/"))
        for group in (folder, *folder.parents):
            limit, used, stat = (_lines(str(group / file)) for file in (of_limit, of_use, "memory.stat"))
            if limit and used and limit[0] != "max":
                cached = sum(int(line.split()[1]) for line in stat if line.split()[0] == of_cache)  # freed on demand
                free = min(free, int(limit[0]) - int(used[0]) + cached)
    return free


_VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = ("memory.max", "memory.current", "inactive_file")


def _of_the_address_space() -> float:
    """Return what ``ulimit -v`` leaves."""
    if not psutil.LINUX:
        return math.inf
    process = psutil.Process()
    limit, _ = process.rlimit(psutil.RLIMIT_AS)
    return math.inf if limit == psutil.RLIM_INFINITY else limit - process.memory_info().vms


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def check_start(needs: Needs) -> str:
    """Return a line that says what a training starts with and how far it may grow.

    The parameters and their moments are in memory already.

    Raises
    ------
    InputError
        It does not fit into memory.
    """
    free, needed, has = free_bytes(), needs.at_the_peak, needs.at_the_peak - needs.to_come
    if needs.to_come > free:
        raise InputError(
            f"training begins with about {as_text(needed)} of memory, {as_text(free + has)} are free: give a larger"
            " --downscale"
        )
    rows = rows_that_fit(needs.n_rows, needs.population_bytes, needs.n_pairs, free - needs.to_come)
    reading = "; photographs are read from disk again and again" if needs.reading_bytes else ""
    return (
        f"memory: about {as_text(needed)} for the first {needs.n_rows:,} Gaussians, {as_text(free + has)} are free:"
        f" room for some {float(f'{max(rows, needs.n_rows):.1g}'):,.0f}{reading}"
    )


def check_render_size(width: int, height: int, with_depth: bool) -> None:
    """Refuse an image that does not fit into memory.

    Raises
    ------
    InputError
        Names the largest one of the same proportions that does.
    """
    needed, free = (DEPTH_RENDER_BYTES if with_depth else RENDER_BYTES) * width * height, free_bytes()
    if needed > free:
        shrink = math.sqrt(free / needed)
        fits = f"{max(1, int(width * shrink))}x{max(1, int(height * shrink))}"
        raise InputError(
            f"an image of {width}x{height} takes about {as_text(needed)}, {as_text(free)} are free: {fits} fits"
        )


def shelf_bytes(n_bytes: float) -> float | None:
    """Return how many bytes of a scene's photographs may stay in memory; None if all of them may.

    Parameters
    ----------
    n_bytes : float
        Size of all of them.
    """
    most = SHELF_SHARE * free_bytes()
    return None if n_bytes <= most else most


def check_photograph(source: str | Path, n_pixels: int, downscale: int) -> None:
    """Refuse a photograph that is too large to be read.

    Parameters
    ----------
    source : str or Path
        The scene, for the message.
    n_pixels : int
        Of the largest photograph at full size.
    downscale : int
        Factor by which it is reduced once it has been read.

    Raises
    ------
    InputError
        It does not fit into memory.
    """
    needed, free = reading_bytes(n_pixels // downscale**2, n_pixels), free_bytes()
    if needed > free:
        raise InputError(
            f"{source}: to read a photograph of {n_pixels / 1e6:.1f} megapixels takes {as_text(needed)} of memory,"
            f" {as_text(free)} are free: make the photographs smaller with `minisplat-ref downscale`"
        )


def as_text(n_bytes: float) -> str:
    """Return an amount of memory in GB, MB or kB."""
    if n_bytes >= 1e9:
        return f"{n_bytes / 1e9:.1f} GB"
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes >= 1e6 else f"{max(n_bytes, 0) / 1e3:.0f} kB"
