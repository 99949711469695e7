"""``python -m data_tools.mutation``: change the code in one place at a time, and see whether a test fails.

A change that no test notices, a *survivor*, is a line that could be wrong without anybody knowing; or the change makes
no difference, which only a reader can tell. cosmic-ray makes the changes, and keeps them with what came of them in a
session, which its own commands (``cr-report``, ``cr-html``) read, too. Which code is changed, and how, is in
``mutation.toml``. Compiled kernels are left out: their proof is the parity with the book and the planted errors of the
tests.

All changes would take days, so a part of them is drawn: first places, so that no operator with many alternatives comes
first, then one change for each. Each is tested by the test files that import the module, the nearest first, for a
bounded time. So a score is a lower bound: a survivor may be noticed by a test that was not run. A module that is the
base of many is best run for longer.

Changes are made in a copy of the working tree. It needs ``pip install '.[mutation]'``.
"""

import os
import random
import re
import shlex
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cosmic_ray.commands import init
from cosmic_ray.config import load_config
from cosmic_ray.modules import filter_paths, find_modules
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db

from data_tools.sources import Imports, annotations, copy_tree
from minisplat_ref.interface.arguments import HelpFormatter, Parser, integer
from minisplat_ref.interface.reporting import markdown_table

SETTINGS = "data_tools/mutation.toml"
TESTS = Path("tests")
FILES_MAX = 6  # of tests for a change; all are imported before the first runs


def draw_changes(modules: Sequence[Path], settings: Mapping[str, Any], n: int, rng: random.Random) -> list[Any]:
    """Return the work items of cosmic-ray for ``n`` changes, no two of them in one place."""
    unwanted = re.compile("|".join(settings["filters"]["operators-filter"]["exclude-operators"]))
    with TemporaryDirectory() as folder, use_db(Path(folder, "all.sqlite")) as db:
        init(modules, db, {})
        items = db.work_items
    types = {module: annotations(module.read_text()) for module in modules}
    places = defaultdict(list)
    for item in items:
        (change,) = item.mutations
        is_type = any(first <= change.start_pos < end for first, end in types[change.module_path])
        if not is_type and not unwanted.fullmatch(change.operator_name):
            places[str(change.module_path), change.start_pos, change.end_pos].append(item)
    chosen = rng.sample(sorted(places), min(n, len(places)))
    by_name = {place: sorted(places[place], key=lambda item: _order(item.mutations[0])) for place in chosen}
    print(f"{len(chosen):,} of {len(places):,} places where the code can be changed", flush=True)
    return [rng.choice(by_name[place]) for place in chosen]


def _order(change: Any) -> tuple[str, int]:
    return change.operator_name, change.occurrence


class Tests:
    """Test files, and whether a change is noticed by any."""

    def __init__(self, command: str, seconds: float, timeout: float) -> None:
        limit = f"-p data_tools.deadline --seconds {seconds}"
        self._command = shlex.split(f"{command.replace('python', sys.executable, 1)} {limit}")
        self._timeout = timeout
        self._is_sound: dict[str, bool] = {}

    def result_of(self, changes: Sequence[Any], paths: Iterable[Path]) -> Any:
        """Return cosmic-ray's result; test files that fail without a change have no say."""
        names = [str(path) for path in paths if self._is_sound.get(str(path), True)][:FILES_MAX]
        result = mutate_and_test(changes, shlex.join([*self._command, *names]), self._timeout)
        failed = re.findall(r"^(?:FAILED|ERROR) (\S+?\.py)", result.output or "", re.MULTILINE)
        for name in failed:
            if name not in self._is_sound:
                code = subprocess.run([*self._command, name], capture_output=True).returncode
                self._is_sound[name] = code == 0
                if code != 0:
                    print(f"{name} fails without a change and is left out", flush=True)
        return result if all(self._is_sound[name] for name in failed) else self.result_of(changes, paths)


def run(db: WorkDB, imports: Imports, settings: Mapping[str, Any], seconds: float, again: bool) -> None:
    """Test all changes of a session that have not been tested; ``again`` also those that survived."""
    tests = Tests(settings["test-command"], seconds, seconds + settings["timeout"])
    survivors = [item for item, result in db.completed_work_items if again and not result.is_killed]
    changes = [*db.pending_work_items, *survivors]
    pending = sorted(changes, key=lambda item: (str(item.mutations[0].module_path), item.job_id))
    for number, item in enumerate(pending, 1):
        (change,) = item.mutations
        paths = imports.tests_of(change.module_path)
        if not paths:
            sys.exit(f"{change.module_path}: no test imports it: leave it out in {SETTINGS}, or test it")
        result = tests.result_of(item.mutations, paths)
        db.set_result(item.job_id, result)
        outcome = "noticed" if result.is_killed else "survived"
        line = f"{number}/{len(pending)} {outcome} {change.module_path}:{change.start_pos[0]} {change.operator_name}"
        print(line, flush=True)


def report(db: WorkDB) -> Iterator[str]:
    """Yield the survivors as differences, then the score of every module."""
    outcomes: dict[str, Counter[bool]] = defaultdict(Counter)
    for item, result in sorted(db.completed_work_items, key=lambda pair: str(pair[0].mutations[0].module_path)):
        outcomes[str(item.mutations[0].module_path)][result.is_killed] += 1
        if not result.is_killed:
            yield result.diff.split("\n", 1)[1]
    rows = [(module, *_score(counts)) for module, counts in sorted(outcomes.items())]
    total: Counter[bool] = sum(outcomes.values(), Counter())
    if total:
        yield markdown_table(("module", "noticed", "survived", "score"), [*rows, ("all", *_score(total))])


def _score(counts: Counter[bool]) -> tuple[str, str, str]:
    return str(counts[True]), str(counts[False]), f"{counts[True] / counts.total():.0%}"


def main() -> None:
    """Draw, or continue a session; print what survived and the scores."""
    parser = Parser(
        prog="python -m data_tools.mutation",
        description="Change the code in one place at a time, and see whether a test fails.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("session", type=Path, help="file of the session; one that exists is continued")
    parser.add_argument("paths", nargs="*", metavar="PATH", help="modules or folders (default: as mutation.toml says)")
    parser.add_argument("--sample", type=integer(1), default=150, metavar="N", help="changes to draw (default 150)")
    parser.add_argument("--seed", type=integer(0), default=0, metavar="S", help="of the draw (default 0)")
    parser.add_argument(
        "--seconds", type=integer(1), default=120, metavar="T", help="of tests for a change (default 120)"
    )
    parser.add_argument("--again", action="store_true", help="test what survived once more, for a longer time perhaps")
    args = parser.parse_args()
    session, home = args.session.resolve(), Path.cwd()
    with TemporaryDirectory() as folder, use_db(session) as db:
        os.chdir(copy_tree(Path(folder)))
        os.environ["PYTHONPATH"] = os.getcwd()
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # a change of the same length in the same second would not be read
        settings = load_config(SETTINGS)
        every = sorted(find_modules(map(Path, settings["module-path"])))
        if db.num_work_items == 0:
            paths = find_modules(map(Path, args.paths or settings["module-path"]))
            modules = sorted(filter_paths(paths, settings["excluded-modules"]))
            db.add_work_items(draw_changes(modules, settings, args.sample, random.Random(args.seed)))
        run(db, Imports(every, sorted(TESTS.rglob("test_*.py"))), settings, args.seconds, args.again)
        print("\n".join(report(db)))
        os.chdir(home)


if __name__ == "__main__":
    main()
