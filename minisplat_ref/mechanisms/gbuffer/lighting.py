"""The environment of a model, and its replacement: relighting.

A model that was trained with an environment has it as the shared parameter ``log_environment``, the logarithm of linear
RGB in latitude and longitude, so that no training makes light negative. Another comes from a file: an image in sRGB, or
an ``.npy`` [H, 2 H, 3] of linear values, which may exceed 1. The upper row is up, along z of the world.
"""

from pathlib import Path

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import read_image
from minisplat_ref.io.srgb import decode_srgb
from minisplat_ref.mechanisms.gbuffer.prefilter import check_size
from minisplat_ref.types import Floats, Model

ENVIRONMENT = "log_environment"  # name of the shared parameter
RADIANCE_MIN = 1e-4  # of a file, whose black has no logarithm: a third of the darkest sRGB step above black


def relight(model: Model, path: Path) -> Model:
    """Return a model in the environment of a file.

    Raises
    ------
    InputError
        The model has no environment, or the file is none.
    """
    if ENVIRONMENT not in model.shared:
        raise InputError(f"--environment {path}: this model has no environment; train with --recipe reflective")
    environment = np.log(np.maximum(read_environment(path), RADIANCE_MIN))
    return model._replace(shared={**model.shared, ENVIRONMENT: environment.astype(np.float32)})


def read_environment(path: Path) -> Floats:
    """Return the environment of an image or an .npy file, linear RGB [H, 2 H, 3].

    Raises
    ------
    InputError
        It cannot be read, has another shape, or values that are negative or not finite.
    """
    if path.suffix == ".npy":
        try:
            found = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"{path}: not an array of NumPy ({error})") from None
    else:
        found = decode_srgb(read_image(path)[:, :, :3] / 255.0)
    if found.ndim != 3 or found.shape[2] != 3 or found.dtype.kind not in "fiu":
        raise InputError(f"{path}: an environment has the shape (H, 2 H, 3), not {found.shape}")
    try:
        check_size(*found.shape[:2])
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not np.isfinite(found).all() or found.min() < 0:
        raise InputError(f"{path}: an environment has finite values of at least 0; it holds light")
    return found.astype(np.float64)
