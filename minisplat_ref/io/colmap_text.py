"""COLMAP models that pycolmap cannot read unchanged: byte order marks, names with spaces, no sparse points, no frames.

The files are copied without these parts, and pycolmap reads the copies; the names come from here.
"""

import codecs
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TEXT_FILES = ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt")
BYTE_ORDER_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
NO_POINTS = {"points3D.bin": bytes(8), "points3D.txt": b""}  # files without a point
N_BEFORE_NAME = 9  # numbers in a line of an image: its own, a quaternion, a translation, the camera's


@contextmanager
def readable(model: Path) -> Iterator[Path]:
    """Give a folder of the same model that pycolmap can read: itself, or a copy for as long as the context lasts."""
    files = {file.name: file for file in model.iterdir() if file.is_file()}
    texts = {name: text for name in TEXT_FILES if name in files and (text := _without_mark(files[name])) is not None}
    points = next((name for name in NO_POINTS if f"cameras{Path(name).suffix}" in files), "points3D.txt")
    if points not in files:
        texts[points] = NO_POINTS[points]
    halves = [suffix for suffix in (".bin", ".txt") if (f"rigs{suffix}" in files) != (f"frames{suffix}" in files)]
    for suffix in halves:  # pycolmap needs both; without either, each image has the pose in the file of images
        files = {name: file for name, file in files.items() if name not in (f"rigs{suffix}", f"frames{suffix}")}
    if not texts and not halves:
        yield model
        return
    with tempfile.TemporaryDirectory(prefix="model-") as temporary:
        for name, file in files.items():
            if name not in texts:
                (Path(temporary) / name).symlink_to(file.resolve())
        for name, content in texts.items():
            (Path(temporary) / name).write_bytes(content)
        yield Path(temporary)


def _encoding(file: Path) -> str | None:
    """Return the encoding that a text file's byte order mark names; None if it has none."""
    with file.open("rb") as opened:
        start = opened.read(4)
    return next((encoding for mark, encoding in BYTE_ORDER_MARKS if start.startswith(mark)), None)


def _without_mark(file: Path) -> bytes | None:
    """Return the content of a text file in UTF-8 without its byte order mark; None if it has none."""
    encoding = _encoding(file)
    return None if encoding is None else file.read_bytes().decode(encoding, errors="replace").encode()


def text_lines(file: Path) -> Iterator[str]:
    """Yield the lines of a text file without their ends; bytes that are no text become lone surrogates."""
    encoding = _encoding(file)
    errors = "surrogateescape" if encoding is None else "replace"
    with file.open(encoding=encoding or "utf-8", errors=errors) as opened:
        for line in opened:
            yield line.removesuffix("\n")


def text_names(file: Path) -> dict[int, str]:
    """Return the names in a text file of images by their numbers: all that follows the ninth number of a line.

    pycolmap ends a name at its first space, though COLMAP itself writes names with spaces. Every second line, of 2D
    features, is passed over.
    """
    names = {}
    lines = text_lines(file)
    for line in lines:
        words = line.split(maxsplit=N_BEFORE_NAME)
        if not words or words[0].startswith("#"):
            continue
        if len(words) > N_BEFORE_NAME and words[0].isdecimal():
            names[int(words[0])] = words[-1].rstrip()
        next(lines, None)
    return names
