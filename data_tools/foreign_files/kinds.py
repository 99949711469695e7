"""Every kind of foreign file with its cases, and the table of how many are right."""

import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from data_tools.foreign_files import (
    cameras,
    dialects,
    folders,
    headers,
    leftovers,
    library,
    masks,
    meshes,
    names,
    outliers,
    photographs,
    places,
    ranges,
    recordings,
    relatives,
    spz_axes,
    terminals,
)
from minisplat_ref.interface.arguments import HelpFormatter, Parser
from minisplat_ref.interface.reporting import markdown_table

Case = Callable[[Path], None]

KINDS: Mapping[str, Mapping[str, Case]] = {
    "masks that leave nothing": masks.CASES,
    "size and place of the scene": places.CASES,
    "files that are not used": leftovers.CASES,
    "ranges of pixel values": ranges.CASES,
    "names": names.CASES,
    "Gaussians of other programs": dialects.CASES,
    "terminals and processes": terminals.CASES,
    "meshes as glTF": meshes.CASES,
    "axes of an SPZ": spz_axes.CASES,
    "suffixes of photographs": photographs.CASES,
    "Gaussians that 3DGS does not draw": relatives.CASES,
    "warnings of the library": library.CASES,
    "cameras of other programs": cameras.CASES,
    "headers, models, copies and videos": headers.CASES,
    "folders of other programs": folders.CASES,
    "Gaussians beyond a format": outliers.CASES,
    "rates and pixels of videos": recordings.CASES,
}
"""By what they are about; a case takes an empty folder and raises where something is wrong."""


def failures_of(cases: Mapping[str, Case]) -> dict[str, str]:
    """Run cases, each in a folder of its own; return what was wrong, by the names of those that failed."""
    failures = {}
    for name, case in cases.items():
        with tempfile.TemporaryDirectory(prefix="foreign-") as folder:
            try:
                case(Path(folder))
            except Exception:
                failures[name] = traceback.format_exc()
    return failures


def main() -> None:
    """Print the table, and on stderr what was wrong; exit with 1 if anything was."""
    parser = Parser(prog="python -m data_tools.foreign_files", description=__doc__, formatter_class=HelpFormatter)
    parser.add_argument("--kind", choices=tuple(KINDS), metavar="K", help="only this kind (default: all)")
    args = parser.parse_args()
    rows, is_wrong = [], False
    for kind, cases in KINDS.items():
        if args.kind not in (None, kind):
            continue
        failures = failures_of(cases)
        rows.append([kind, str(len(cases)), str(len(cases) - len(failures))])
        for name, failure in failures.items():
            is_wrong = True
            print(f"{kind}, {name}:\n{failure}", file=sys.stderr)
    print(markdown_table(["kind", "cases", "right"], rows))
    sys.exit(1 if is_wrong else 0)
