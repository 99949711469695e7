"""The memory that this process uses, and its peak since a chosen moment."""

from pathlib import Path

import psutil

from minisplat_ref.errors import InputError


def forget_peak() -> str:
    """Reset the system's peak; return a note for the reader if that is impossible."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return "at least: counted beyond the peak of loading the kernels"
    return ""


def bytes_in_use() -> int:
    """Return the bytes of memory in use now."""
    return psutil.Process().memory_info().rss


def peak() -> int:
    """Return the most bytes in use since :func:`forget_peak`, or ever where that does not work."""
    from minisplat_ref.app.runs.run import peak_rss_mb

    megabytes = peak_rss_mb()
    if megabytes is None:
        raise InputError("this system does not say how much memory a process holds")
    return round(1e6 * megabytes)
