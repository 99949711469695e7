"""Other people's renderers, timed in the same run where the user has them."""

from collections.abc import Sequence
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.bench.contenders import Contender
from minisplat_ref.oracle.bench.opensplat import check_program

GSPLAT_TORCH, OPENSPLAT = "gsplat-torch", "opensplat"


def peers_of(names: Sequence[str]) -> tuple[list[Contender], Path | None]:
    """Make contenders of the peers.

    Parameters
    ----------
    names : sequence of str
        ``gsplat-torch`` or ``opensplat=PATH``.

    Returns
    -------
    contenders : list of Contender
        Those that draw the workloads.
    opensplat : Path or None
        OpenSplat's executable, which only trains.

    Raises
    ------
    InputError
        A name is unknown, or what it needs is missing.
    """
    contenders: list[Contender] = []
    program = None
    for name in names:
        if name == GSPLAT_TORCH:
            raise InputError("gsplat-torch cannot be timed yet")
        elif name.startswith(f"{OPENSPLAT}="):
            program = Path(name.removeprefix(f"{OPENSPLAT}="))
            check_program(program)
        else:
            raise InputError(f"peer {name!r} is unknown; choose from {GSPLAT_TORCH}, {OPENSPLAT}=PATH")
    return contenders, program
