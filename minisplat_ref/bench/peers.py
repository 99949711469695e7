"""Other people's renderers, timed in the same run if the user has them.

gsplat's functions in plain PyTorch do not list the hits of a pixel; gsplat does that in CUDA. The adapter takes the
list from the reference, in NumPy, and that is part of its time.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from minisplat_ref.bench.contenders import Contender
from minisplat_ref.bench.opensplat import check_program
from minisplat_ref.constants import GSPLAT_1_5
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.peers.gsplat_torch import gsplat_torch

GSPLAT_TORCH, OPENSPLAT = "gsplat-torch", "opensplat"


def make_peers(names: Sequence[str]) -> tuple[list[Contender], Path | None]:
    """Make contenders of the peers.

    Parameters
    ----------
    names : sequence of str
        ``gsplat-torch`` or ``opensplat=PATH``.

    Returns
    -------
    contenders : list of Contender
        Those that render the workloads.
    opensplat : Path or None
        OpenSplat's executable, which only trains.

    Raises
    ------
    InputError
        A name is unknown, or its renderer is not installed.
    """
    contenders: list[Contender] = []
    program = None
    for name in names:
        if name == GSPLAT_TORCH:
            contenders.append(Contender(GSPLAT_TORCH, gsplat_torch(), np.float32, conventions=GSPLAT_1_5))
        elif name.startswith(f"{OPENSPLAT}="):
            program = Path(name.removeprefix(f"{OPENSPLAT}="))
            check_program(program)
        else:
            raise InputError(f"peer {name!r} is unknown; choose from {GSPLAT_TORCH}, {OPENSPLAT}=PATH")
    return contenders, program
