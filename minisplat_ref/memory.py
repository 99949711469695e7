"""What a training and a picture take of memory, and what there is: to say no in time, before the system kills.

The model of a training is the one that ``bench --memory`` measures against (README: 0.96 of it at the peak): the
parameters, their gradient and Adam's two moments; the images of an iteration; 48 bytes for every pair (tile, Gaussian).
What the program, its compiled kernels and the photographs take is there before and is not counted.

What is free is asked of Linux. Other systems do not say it in a file; nothing is refused there.
"""

import math
from pathlib import Path

from minisplat_ref.errors import InputError

N_COPIES = 4  # of the population: parameters, gradient, two moments
# The 9 sums of its gradient, its places in the tile's list and in the Gaussian's, and one number to spare.
BYTES_PER_PAIR = 48
PAIRS_PER_GAUSSIAN = 3.0  # where no view has been rendered yet; in three small scenes 0.7 to 3.3
# A pixel, at the peak of rendering a picture and writing it; measured at 12 and 48 megapixels: 64.2 and 64.1, with
# depth 68.2 and 68.1.
PICTURE_BYTES, DEPTH_PICTURE_BYTES = 65, 69
RESERVE = 0.95  # part of the free memory that may be planned with


def image_bytes(width: int, height: int) -> int:
    """Bytes of the photograph as it is kept and in float32, the image, its opacity, and the derivative by the image."""
    bytes_, floats = 3, 3 + 3 + 1 + 3
    return (bytes_ + 4 * floats) * width * height


def training_bytes(population_bytes: int, n_pairs: float) -> float:
    """Bytes of a training that grow with its population.

    Parameters
    ----------
    population_bytes : int
        Of the parameters.
    n_pairs : float
        Pairs (tile, Gaussian) of a view.
    """
    return N_COPIES * population_bytes + BYTES_PER_PAIR * n_pairs


def rows_that_fit(n_rows: int, population_bytes: int, n_pairs: float, free: float) -> float:
    """Return how large a population may become, rows.

    While rows are added, the new parameters and moments stand beside all that was there before; afterwards everything
    is larger in the same proportion.

    Parameters
    ----------
    n_rows : int
        Of the population as it is.
    population_bytes : int
        Of its parameters.
    n_pairs : float
        Pairs (tile, Gaussian) of the last view.
    free : float
        Bytes, beside what the population takes now.
    """
    if n_rows == 0:
        return math.inf
    now, row_bytes = training_bytes(population_bytes, n_pairs), population_bytes / n_rows
    return min(n_rows * (1 + free / now), free / ((N_COPIES - 1) * row_bytes))


def free_bytes() -> float:
    """Return how much memory this process can still get, by the system, its limits and those of its container."""
    return RESERVE * min(_of_the_system(), _of_the_control_group(), _of_the_address_space())


def _of_the_system() -> float:
    for line in _lines("/proc/meminfo"):
        if line.startswith("MemAvailable:"):
            return 1024.0 * int(line.split()[1])
    return math.inf


def _of_the_control_group(root: str = "/sys/fs/cgroup", own: str = "/proc/self/cgroup") -> float:
    """Least of what the limits of containers and batch systems leave; control groups of version 2 or 1."""
    free = math.inf
    for _, controllers, name in (line.split(":", 2) for line in _lines(own)):
        if controllers and "memory" not in controllers.split(","):
            continue
        of_limit, of_use, of_cache = _VERSION_1 if controllers else _VERSION_2
        folder = Path(root, "memory" if controllers else "", name.lstrip("/"))
        for group in (folder, *folder.parents):
            limit, used, stat = (_lines(str(group / file)) for file in (of_limit, of_use, "memory.stat"))
            if limit and used and limit[0] != "max":
                cached = sum(int(line.split()[1]) for line in stat if line.split()[0] == of_cache)  # given up on demand
                free = min(free, int(limit[0]) - int(used[0]) + cached)
    return free


_VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = ("memory.max", "memory.current", "inactive_file")


def _of_the_address_space() -> float:
    """What ``ulimit -v`` leaves."""
    try:
        import resource  # absent on Windows
    except ImportError:
        return math.inf
    limit, pages = resource.getrlimit(resource.RLIMIT_AS)[0], _lines("/proc/self/statm")
    if limit == resource.RLIM_INFINITY or not pages:
        return math.inf
    return limit - resource.getpagesize() * int(pages[0].split()[0])


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []


def check_start(n_rows: int, population_bytes: int, width: int, height: int) -> str:
    """Say what a training begins with and how far it may grow, in a line; nothing where the system does not say.

    Parameters
    ----------
    n_rows : int
        Of the population, whose parameters and moments are there already.
    population_bytes : int
        Of its parameters.
    width, height : int
        Of the largest photograph, pixels.

    Raises
    ------
    InputError
        It does not fit into memory.
    """
    free, n_pairs = free_bytes(), PAIRS_PER_GAUSSIAN * n_rows
    if math.isinf(free):
        return ""
    images, population = image_bytes(width, height), training_bytes(population_bytes, n_pairs)
    needed, has = images + population, (N_COPIES - 1) * population_bytes
    if needed - has > free:
        raise InputError(
            f"training begins with about {as_text(needed)} of memory, {as_text(free + has)} are free: give a larger"
            " --downscale"
        )
    rows = rows_that_fit(n_rows, population_bytes, n_pairs, free + has - needed)
    return (
        f"memory: about {as_text(needed)} for the first {n_rows:,} Gaussians, {as_text(free + has)} are free: room for"
        f" some {float(f'{max(rows, n_rows):.1g}'):,.0f}"
    )


def check_picture(width: int, height: int, with_depth: bool) -> None:
    """Refuse a picture that does not fit into memory.

    Raises
    ------
    InputError
        Names the largest one of these proportions that does.
    """
    needed, free = (DEPTH_PICTURE_BYTES if with_depth else PICTURE_BYTES) * width * height, free_bytes()
    if needed > free:
        shrink = math.sqrt(free / needed)
        fits = f"{max(1, int(width * shrink))}x{max(1, int(height * shrink))}"
        raise InputError(
            f"a picture of {width}x{height} takes about {as_text(needed)}, {as_text(free)} are free: {fits} fits"
        )


def check_photographs(source: str | Path, n_pixels: int, downscale: int) -> None:
    """Refuse photographs that do not fit into memory, which holds all of them.

    Parameters
    ----------
    source : str or Path
        The scene, for the message.
    n_pixels : int
        Of all photographs at full size.
    downscale : int
        Factor by which they are made smaller.

    Raises
    ------
    InputError
        Names a factor that would do.
    """
    needed, free = 3 * n_pixels / downscale**2, free_bytes()
    if needed > free:
        enough = math.ceil(math.sqrt(3 * n_pixels / free))
        raise InputError(
            f"{source}: its photographs take {as_text(needed)} of memory, {as_text(free)} are free: give --downscale"
            f" {max(enough, downscale + 1)}, or leave some out"
        )


def as_text(n_bytes: float) -> str:
    """Return an amount of memory in GB, MB or kB."""
    if n_bytes >= 1e9:
        return f"{n_bytes / 1e9:.1f} GB"
    return f"{n_bytes / 1e6:.0f} MB" if n_bytes >= 1e6 else f"{max(n_bytes, 0) / 1e3:.0f} kB"
