"""Claims of papers, measured: ``python -m data_tools.claims NAME ...``, in a clone of the repository.

Each module or folder beside ``kit`` has the claims of one paper, which its first lines name, or of one decision of
ours, listed in ``CLAIMS``. NAME is that of the module, followed by that of the claim where a module has several:
``folds``, ``textured/limb``. Nothing that is installed imports them: a claim that has been decided keeps its figures in
``docs``, and its script stays here, so that anyone can repeat it.
"""

from importlib import import_module
from pkgutil import iter_modules

from data_tools.claims.kit.claim import Claim
from minisplat_ref.errors import InputError


def papers() -> list[str]:
    """Return the names of the modules with claims."""
    return [
        module.name.replace("_", "-") for module in iter_modules(__path__) if module.name not in ("kit", "__main__")
    ]


def claims_of(paper: str) -> dict[str, Claim]:
    """Return the claims of a module by the names that users type."""
    claims: tuple[Claim, ...] = import_module(f"{__name__}.{paper.replace('-', '_')}").CLAIMS
    if [claim.name for claim in claims] == [paper]:
        return {paper: claims[0]}
    return {f"{paper}/{claim.name}": claim for claim in claims}


def all_claims() -> dict[str, Claim]:
    """Return all claims by the names that users type."""
    return {name: claim for paper in papers() for name, claim in claims_of(paper).items()}


def find_claim(name: str) -> Claim:
    """Return a claim by the name that users type.

    Raises
    ------
    InputError
        There is none of that name.
    """
    paper = name.partition("/")[0]
    if paper not in papers():
        raise InputError(f"there is no claim {name!r}: choose from {', '.join(papers())}")
    found = claims_of(paper)
    if name not in found:
        raise InputError(f"there is no claim {name!r}: choose from {', '.join(found)}")
    return found[name]
