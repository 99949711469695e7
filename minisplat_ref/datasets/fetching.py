"""Fetch files whose hashes are known: what is there is kept, what arrives altered is not."""

import hashlib
import http.client
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from minisplat_ref.datasets.catalogue import File
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import Bar, progress_bar
from minisplat_ref.io.atomic import is_part, remove_parts, replacing, unwritable

CHUNK = 1 << 16  # bytes between two moves of the bar
TIMEOUT = 30.0  # seconds without an answer


def fetch(files: Sequence[File], out: Path, description: str) -> int:
    """Fetch files into a folder, which may hold some of them already, and return how many were fetched.

    A file appears under its name when all of it has arrived and its hash is right; then it stays, so that a second call
    after an interruption fetches only the others.

    Parameters
    ----------
    files : sequence of File
        What to fetch.
    out : Path
        A folder that is new, empty, or has at least one of the files.
    description : str
        For the progress bar.

    Raises
    ------
    InputError
        The folder holds other things, or a file of one of the names with other contents; an address does not answer,
        has no such file, or sends something else; the disk is full.
    """
    missing = [file for file in files if not _is_there(file, out)]
    if len(missing) == len(files) and out.exists() and not (out.is_dir() and all(map(is_part, out.iterdir()))):
        raise InputError(f"{out}: already there and not empty; choose another name or remove it first")
    total = sum(file.n_bytes for file in missing)
    with progress_bar(description, "MB", total, delay=0.0) as bar:
        for i, file in enumerate(missing):
            try:
                _fetch_one(file, out / file.path, bar)
            except InputError as error:
                n_there = len(files) - len(missing) + i
                kept = f" ({n_there} of {len(files)} files are in {out}, and are kept)" if n_there else ""
                raise InputError(f"{error}{kept}") from error
    return len(missing)


def _is_there(file: File, out: Path) -> bool:
    """Return whether a file is there.

    Raises
    ------
    InputError
        Another one is there under its name, which might be somebody's work.
    """
    path = out / file.path
    if not path.exists():
        return False
    if path.is_file() and path.stat().st_size == file.n_bytes:
        with open(path, "rb") as opened:
            if hashlib.file_digest(opened, "sha256").hexdigest() == file.sha256:
                return True
    raise InputError(f"{path} is another file than {file.url}: move it away, or choose another folder")


def _fetch_one(file: File, path: Path, bar: Bar) -> None:
    chunks = _chunks(file)
    first = next(chunks, b"")  # before there is a folder: without a network none is made
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_parts(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    with replacing(path) as part, open(part, "wb") as opened:
        digest, n_bytes = hashlib.sha256(), 0
        for chunk in chain([first], chunks):
            digest.update(chunk)
            n_bytes += len(chunk)
            opened.write(chunk)
            bar.update(len(chunk))
        if digest.hexdigest() != file.sha256:
            what = f"{n_bytes:,} bytes, not {file.n_bytes:,}" if n_bytes != file.n_bytes else "other bytes"
            raise InputError(
                f"{file.url} sent {what}: its hash is not that of the catalogue, and it was not kept; try again, and if"
                " it stays so, something on the way alters files"
            )


def _chunks(file: File) -> Iterator[bytes]:
    """Yield what an address sends, up to one byte more than it should."""
    left = file.n_bytes + 1
    try:
        with urllib.request.urlopen(file.url, timeout=TIMEOUT) as answer:
            while left and (chunk := answer.read(min(CHUNK, left))):
                left -= len(chunk)
                yield chunk
    except urllib.error.HTTPError as error:
        gone = "there is no such file any more" if error.code in (404, 410) else "try again later"
        raise InputError(f"{file.url}: the server answers {error.code} ({error.reason}): {gone}") from error
    except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise InputError(f"{file.url} cannot be reached ({reason}): is there a network? then try again") from error
