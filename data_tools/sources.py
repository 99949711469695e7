"""Sources for tools that change the code: a copy of it, the test files that import a module, the places of types."""

import ast
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


class Imports:
    """Which module of the package imports which, and which test file."""

    def __init__(self, modules: Iterable[Path], tests: Iterable[Path]) -> None:
        self._re_exports = {
            (module_name(path), alias.asname or alias.name): node.module or ""
            for path in modules
            if path.name == "__init__.py"
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        self._of_modules = {module_name(path): self._of(path) for path in modules}
        self._of_tests = {path: self._of(path) for path in tests}

    def tests_of(self, module: Path) -> list[Path]:
        """Return the test files that import a module, or what imports it if none does, and those of its command.

        Named like the module come first, then those that import most of its names and least besides.
        """
        name, wanted = module_name(module), {module_name(module)}
        stem = name.rpartition(".")[2]
        found = [path for path in self._of_tests if f'"{stem}"' in path.read_text()]
        n_before = 0
        while not (imported := [path for path, names in self._of_tests.items() if names.keys() & wanted]):
            if len(wanted) == n_before:
                break
            n_before = len(wanted)
            wanted |= {importer for importer, names in self._of_modules.items() if names.keys() & wanted}

        def rank(path: Path) -> tuple[bool, int, int, Path]:
            return stem not in path.stem, -self._of_tests[path][name], len(self._of_tests[path]), path

        return sorted({*found, *imported}, key=rank)

    def _of(self, path: Path) -> Counter[str]:
        """Return the modules that a file imports, each with the number of names that it takes from it.

        Of a package that is imported, those that its ``__init__`` imports are there with 0.
        """
        names: Counter[str] = Counter()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                names[node.module] += 1
                names.update(f"{node.module}.{alias.name}" for alias in node.names)  # which may be a module
                names.update(self._re_exports.get((node.module, alias.name), node.module) for alias in node.names)
                names.update({module: 0 for (package, _), module in self._re_exports.items() if package == node.module})
        return names


def module_name(path: Path) -> str:
    """Return the name by which a file is imported."""
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def annotations(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return from where to where type annotations reach, as (line, column); to change them changes nothing."""
    found: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            found.append(node.returns)
    return [
        ((node.lineno, node.col_offset), (node.end_lineno or 0, node.end_col_offset or 0)) for node in found if node
    ]


def copy_tree(folder: Path) -> Path:
    """Return a copy of the working tree as git sees it, beside the real scenes if they are there."""
    names = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in filter(None, names.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / "repo" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / "repo" / name)
    if (ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to(ROOT.parent / "shared")
    return folder / "repo"
