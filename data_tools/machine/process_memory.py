"""The memory that this process uses, and its peak since a chosen moment."""

import os
from pathlib import Path

from minisplat_ref.errors import InputError


def forget_peak() -> str:
    """Reset the system's peak; return a note for the reader if that is impossible."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return "at least: counted beyond the peak of loading the kernels"
    return ""


def bytes_in_use() -> int:
    """Return the bytes of memory in use now; Linux only, like :func:`forget_peak`."""
    return _from_status("VmRSS") or 0


def peak() -> int:
    """Return the most bytes in use since :func:`forget_peak`, or ever where that does not work."""
    return _from_status("VmHWM") or _most_so_far()


def _from_status(key: str) -> int | None:
    """Read a line of Linux's status of this process."""
    if not os.path.exists("/proc/self/status"):
        return None
    lines = Path("/proc/self/status").read_text().splitlines()
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{key}:")), None)


def _most_so_far() -> int:
    from minisplat_ref.app.runs.run import peak_rss_mb

    megabytes = peak_rss_mb()
    if megabytes is None:
        raise InputError("this system does not say how much memory a process holds")
    return int(1e6 * megabytes)
