"""Readers that do what none may do, for tests of the fuzzing itself; its own module, for processes to import."""

import os
import time
import warnings

import numpy as np

from data_tools.fuzz.readers import Reader
from minisplat_ref.errors import InputError

CONTENT = bytes(range(100))


def write(folder):
    (folder / "a.bin").write_bytes(CONTENT)


def is_whole(file):
    return file.read_bytes() == CONTENT


def good(folder, file):
    if not is_whole(file):
        raise InputError(f"{file}: damaged; copy it again")


def other_exception(folder, file):
    if not is_whole(file):
        raise KeyError(file)


def no_name(folder, file):
    if not is_whole(file):
        raise InputError("damaged")


def two_lines(folder, file):
    if not is_whole(file):
        error = InputError("")
        error.args = (f"{file}: damaged;\ncopy it again",)
        raise error


def raw_warning(folder, file):
    if not is_whole(file):
        warnings.warn("damaged", RuntimeWarning, stacklevel=1)


def much_memory(folder, file):
    if not is_whole(file):
        np.zeros(100_000_000, np.uint8)


def hidden_memory(folder, file):
    if not is_whole(file):
        try:
            np.zeros(1 << 60, np.uint8)
        except MemoryError:
            raise InputError(f"{file}: damaged; copy it again") from None


def dies(folder, file):
    if not is_whole(file):
        os._exit(7)


def hangs(folder, file):
    if not is_whole(file):
        time.sleep(1000)


def reader(read):
    return Reader(write, read, ("*.bin",))
