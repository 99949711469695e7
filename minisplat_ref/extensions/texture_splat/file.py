"""The PLY of textured surfels: texels are further columns, which other readers skip."""

from pathlib import Path
from typing import Any

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.texture_splat.population import CHANNELS, texels_of
from minisplat_ref.io.ply import load_ply


def load(path: str | Path, population: Any) -> Any:
    """Read textured surfels; see :func:`minisplat_ref.io.ply.load_ply`.

    Raises
    ------
    InputError
        As there, or the columns of texels are not those of square textures of one size.
    """
    found = load_ply(path, population)
    single = {name: getattr(found, name)[:, None] for name in CHANNELS if getattr(found, name).ndim == 1}
    found = found._replace(**single)
    try:
        texels_of(found)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return found
