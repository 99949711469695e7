"""File names: those read from a scene's files must stay inside the scene, and those written must be valid.

*Reading.* COLMAP names its images relative to ``images/`` and never climbs out of it, so no exception is needed. A
transforms.json names files relative to itself: nerfstudio's lie below it, instant-ngp's sometimes in the folder next to
it (``../images/0001.jpg``), some exporters write absolute paths of the same places. Those are read, and nothing further
away. The check applies to the name, before any link is followed: a link inside the scene may lead anywhere, because the
owner of the disk put it there.

*Writing.* A name from a file never becomes a path: :func:`file_names` turns each into one file name.
"""

import os
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import PHOTOGRAPHS

CHARACTERS_MAX = 100  # in a file name without suffix; characters take up to four bytes, and file systems allow 255
BYTES_MAX = 200
RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # devices, not files, on Windows


def is_file(path: Path) -> bool:
    """Return whether a file exists; False for a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a zero byte
        return False


def spelled_on_disk(folder: Path, name: str) -> str:
    """Return the name by which a file is there: as given, or as another system would take it for the same.

    Windows and macOS take ``a.JPG`` for ``a.jpg``, Windows writes backslashes, macOS may decompose accents, and some
    exporters write names as in addresses, ``a%20b.jpg``.
    """
    suffix = Path(name).suffix
    stem = name[: len(name) - len(suffix)]
    forms = [name, stem + suffix.lower(), stem + suffix.upper(), name.replace("\\", "/")]
    forms += [unquote(name), *(unicodedata.normalize(form, name) for form in ("NFC", "NFD"))]
    return next((form for form in forms if ".." not in Path(form).parts and is_file(folder / form)), name)


def with_any_suffix(folder: Path, name: str) -> str:
    """Return the name of an image's copy in a folder: as given, or of the same stem in another format if that is alone.

    Programs that make photographs smaller also convert them; ``images_2/0001.jpg`` is then ``images_2/0001.png``.
    """
    given = spelled_on_disk(folder, name)
    path = folder / given
    if is_file(path) or not path.parent.is_dir():
        return given
    others = [file for file in path.parent.iterdir() if file.stem == path.stem and file.suffix.lower() in PHOTOGRAPHS]
    return others[0].relative_to(folder).as_posix() if len(others) == 1 else given


def name_inside(name: str, source: str | Path) -> str:
    """Return a name that a file gives relative to a folder, if it stays inside.

    Raises
    ------
    InputError
        If it is absolute, empty or climbs with ``..``; the message begins with ``source``.
    """
    path = Path(name)
    if not path.parts or path.is_absolute() or path.drive or ".." in path.parts or "\0" in name:
        raise InputError(
            f"{source}: the image name '{name}' leads out of images/; put the image there and name it relative to it"
        )
    return name


def nearby_path(file: Path, name: str) -> Path:
    """Return the path that a file gives relative to itself, if it stays in the file's folder or a folder next to it.

    Parameters
    ----------
    file : Path
        File that holds the name.
    name : str
        Relative, with slashes or backslashes; or absolute.

    Returns
    -------
    Path
        Without ``..`` except for one at its beginning, so that it means the same whether links are followed or not.

    Raises
    ------
    InputError
        If it leads elsewhere; the way out is a link.
    """
    folder = file.parent
    path = os.path.normpath(name.replace("\\", "/"))  # some exporters run on Windows
    if os.path.isabs(path):
        for form in (os.path.abspath, os.path.realpath):  # the folder as named, and with links resolved
            if Path(path).is_relative_to(Path(form(folder)).parent):
                return Path(path)
    elif Path(path).parts[:2] != ("..", "..") and not Path(path).drive:
        return folder / path
    raise InputError(
        f"{file}: '{name}' lies neither in the folder of this file nor in one next to it; move it there, or make a"
        " link there to its folder and name it through that link"
    )


def file_names(names: Sequence[str]) -> list[str]:
    """Return one file name, without suffix, for each name, whatever characters it contains.

    Letters, digits, ``.``, ``-`` and ``_`` stay, others become ``_``. If the results would not differ, even on file
    systems that ignore case, or one of them would be invalid, all are prefixed with their number.
    """
    stems = [_shorten(re.sub(r"[^\w.-]", "_", name)) for name in names]
    is_unique = len({stem.casefold() for stem in stems}) == len(stems)
    is_usable = all(stem.strip("._") and not RESERVED.fullmatch(stem) for stem in stems)
    return stems if is_unique and is_usable else [f"{index:04d}_{stem}" for index, stem in enumerate(stems)]


def _shorten(stem: str) -> str:
    """Return the last characters of a name that is too long, because numbers are usually at the end."""
    return stem[-CHARACTERS_MAX:].encode()[-BYTES_MAX:].decode(errors="ignore")
