"""Renderers fetched in their versions into a cache folder: packages of npm, and repositories of GitHub at a commit."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

from minisplat_ref.errors import InputError


def install(packages: Sequence[str], cache: Path) -> None:
    """Fetch packages of npm, ``name@version`` each, into a folder, unless they are there.

    Raises
    ------
    InputError
        npm failed.
    """
    missing = [package for package in packages if not _has(package, cache)]
    if missing:
        cache.mkdir(parents=True, exist_ok=True)
        _run("npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(cache), *missing)


def clone(repository: str, commit: str, cache: Path) -> Path:
    """Return a folder with ``owner/name`` of GitHub at a commit, fetched unless it is there.

    Raises
    ------
    InputError
        git failed.
    """
    folder = repository_folder(repository, cache)
    if not folder.is_dir():
        made = folder.with_name(f"{folder.name}.part")
        _run("git", "clone", "--quiet", "--no-checkout", f"https://github.com/{repository}", str(made))
        _run("git", "-C", str(made), "checkout", "--quiet", commit)
        made.rename(folder)
    done = _run("git", "-C", str(folder), "rev-parse", "HEAD")
    if not done.startswith(commit):
        raise InputError(f"{folder} is at {done.strip()[:8]} in place of {commit}: delete it, and it is fetched again")
    return folder


def repository_folder(repository: str, cache: Path) -> Path:
    """Return where a repository lies, or will."""
    return cache / "repositories" / repository.rpartition("/")[2]


def _run(*command: str) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"{command[0]} is not installed: {error}") from error
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()
        raise InputError(f"{' '.join(command)} failed: {said[-1] if said else done.returncode}")
    return done.stdout


def _has(package: str, cache: Path) -> bool:
    name, _, version = package.rpartition("@")
    file = cache / "node_modules" / name / "package.json"
    return file.is_file() and f'"version": "{version}"' in file.read_text(encoding="utf-8")
