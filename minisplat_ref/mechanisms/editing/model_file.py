"""Reading the model that a command works on."""

import warnings
from pathlib import Path

from minisplat_ref.errors import InputWarning, one_line
from minisplat_ref.io.label import Label
from minisplat_ref.io.ply import further_properties, load_ply, read_label
from minisplat_ref.io.run_files import model_file
from minisplat_ref.types import Gaussians


def load_model(path: Path) -> Gaussians:
    """Read the Gaussians of a PLY, or of the PLY in a run's folder; warn of properties that are left out.

    Parameters
    ----------
    path : Path
        A PLY, or the folder of a run.

    Raises
    ------
    InputError
        There is no PLY of Gaussians.
    """
    file = model_file(path)
    gaussians: Gaussians = load_ply(file)
    further = further_properties(file)
    if further:
        message = f"{file}: {', '.join(further)} are left out: only the fields of 3DGS are known to move"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
    return gaussians


def load_label(path: Path) -> Label:
    """Return the label of an edited model: that of the model of :func:`load_model`.

    An extension whose fields are left out no longer renders it.

    Raises
    ------
    InputError
        The label cannot be read.
    """
    file = model_file(path)
    label = read_label(file)
    return label._replace(extension=None) if further_properties(file) else label
