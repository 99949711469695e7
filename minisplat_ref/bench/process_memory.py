"""How much memory this process holds, and the most that it has held since a moment that can be chosen."""

import os
from pathlib import Path

from minisplat_ref.errors import InputError


def forget_peak() -> str:
    """Make the system count the peak anew; return what a reader must know where it cannot."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return "at least: counted beyond the peak of loading the kernels"
    return ""


def held() -> int:
    """Bytes of memory in use now; Linux only, like :func:`forget_peak`."""
    return _from_status("VmRSS") or 0


def peak() -> int:
    """Most bytes in use since :func:`forget_peak`, or ever where that does not work."""
    return _from_status("VmHWM") or _most_so_far()


def _from_status(key: str) -> int | None:
    """Read a line of what Linux says of this process."""
    if not os.path.exists("/proc/self/status"):
        return None
    lines = Path("/proc/self/status").read_text().splitlines()
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{key}:")), None)


def _most_so_far() -> int:
    from minisplat_ref.experiments.run import peak_rss_mb

    megabytes = peak_rss_mb()
    if megabytes is None:
        raise InputError("this system does not say how much memory a process holds")
    return int(1e6 * megabytes)
