"""``python -m data_tools.house [TREE ...]``: how large each folder of a worktree is, and how much of it is repeated.

A line counts as repeated if it lies in a run of six lines of code that occurs in two places or more; by shape, names,
numbers and strings may differ. Blank lines, comments, docstrings and imports are not code. Give two worktrees to set
the tree before a refactor beside the one after it.
"""

import argparse
import ast
import io
import keyword
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

from minisplat_ref.interface.reporting import markdown_table

RUN = 6  # lines; shorter runs are mostly calls with the same arguments
TOPS = ("minisplat_ref", "data_tools", "tests")
COLUMNS = ("files", "lines", "code", "repeated", "of one shape")
SKIPPED = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(source: str) -> list[tuple[str, str]]:
    """Return the lines of code of a file, each as it is and as its shape."""
    skipped: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and (is_docstring(node) or isinstance(node, ast.Import | ast.ImportFrom)):
            skipped.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    exact, shape = defaultdict(list), defaultdict(list)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        line = token.start[0]
        if token.type in SKIPPED or line in skipped:
            continue
        exact[line].append(token.string)
        is_free = token.type in (tokenize.NUMBER, tokenize.STRING) or (
            token.type == tokenize.NAME and not keyword.iskeyword(token.string)
        )
        shape[line].append("_" if is_free else token.string)
    return [(" ".join(exact[line]), " ".join(shape[line])) for line in sorted(exact)]


def is_docstring(node: ast.stmt) -> bool:
    """Return whether a statement is a string and nothing else."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def count_repeated(files: Iterable[list[str]]) -> list[int]:
    """Return for each file, given as its lines of code, how many lie in a run that stands in two places or more."""
    files = list(files)
    runs = [[tuple(lines[i : i + RUN]) for i in range(len(lines) - RUN + 1)] for lines in files]
    n_places = Counter(run for of_file in runs for run in of_file)
    return [len({i + k for i, run in enumerate(of_file) if n_places[run] > 1 for k in range(RUN)}) for of_file in runs]


def measure_tree(tree: Path) -> dict[str, list[int]]:
    """Return by folder how many files, lines and lines of code there are, and how many of these are repeated."""
    paths = [path for top in TOPS for path in sorted((tree / top).rglob("*.py"))]
    lines = [code_lines(path.read_text(encoding="utf-8")) for path in paths]
    exact = count_repeated([[line for line, _ in of_file] for of_file in lines])
    shape = count_repeated([[line for _, line in of_file] for of_file in lines])
    sums: dict[str, list[int]] = defaultdict(lambda: [0] * 5)
    for path, of_file, *repeated in zip(paths, lines, exact, shape, strict=True):
        n_lines = path.read_text(encoding="utf-8").count("\n")
        for folder in (folder_of(path.relative_to(tree)), path.relative_to(tree).parts[0]):
            sums[folder] = [a + b for a, b in zip(sums[folder], (1, n_lines, len(of_file), *repeated), strict=True)]
    return sums


def folder_of(path: Path) -> str:
    """Return the folder below the top that a file belongs to; the top's own files are one."""
    return "/".join(path.parts[:2]) if len(path.parts) > 2 else f"{path.parts[0]}/*.py"


def main() -> None:
    """Measure each tree and print one table."""
    parser = argparse.ArgumentParser(prog="python -m data_tools.house", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("trees", type=Path, nargs="*", metavar="TREE", help="worktrees (default: this one)")
    trees = [tree.resolve() for tree in parser.parse_args().trees] or [Path(__file__).resolve().parents[1]]
    found = [measure_tree(tree) for tree in trees]
    columns = [f"{name}{f', {tree.name}' if len(trees) > 1 else ''}" for tree in trees for name in COLUMNS]
    rows = [
        [folder, *(f"{number:,}" for of_tree in found for number in of_tree.get(folder, [0] * 5))]
        for folder in sorted(set().union(*found))
    ]
    print(markdown_table(["folder", *columns], rows))


if __name__ == "__main__":
    main()
