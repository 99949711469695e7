"""Find the photographs in a folder, and leave out files that programs have put next to them.

Cameras, phones and file managers leave previews and hidden copies (``._0001.jpg`` of macOS, ``@eaDir`` of a network
disk, ``.thumbnails``). A scene has masks and smaller copies (``masks/``, ``images_2/``). They end like photographs, but
are none.
"""

import re
import warnings
from collections import Counter
from pathlib import Path

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.images import BY_PRODUCT, HEIF_SUFFIXES, UNREAD_SUFFIXES, readable_suffixes

BEGINNINGS = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"GIF8", b"II*\0", b"MM\0*", b"\0\0\0\x0cjP  ")
"""First bytes of images of the usual formats."""
MASKS = "masks"
"""Folder of masks next to the photographs."""
SMALLER = re.compile(r"images_\d+")  # folder of smaller copies, if there is images/ beside it
NAMED_MAX = 20  # files that a message names


def list_images(folder: Path) -> list[Path]:
    """Return the photographs in a folder and below, sorted by name; masks are none.

    Warns of photographs in formats that are not read, and of image files that are hidden or by-products.

    Raises
    ------
    InputError
        If there is no such folder, or no photograph in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder with photographs")
    found = sorted(file.relative_to(folder) for file in folder.rglob("*") if file.is_file())
    found = [file for file in found if MASKS not in file.parent.parts]
    sorted_out = [(file, _by_product(folder, file)) for file in found]
    photos = [file for file, by_product in sorted_out if by_product is None]
    by_products = [(file, by_product) for file, by_product in sorted_out if by_product is not None]
    suffixes = readable_suffixes()
    files = [folder / file for file in photos if file.suffix.lower() in suffixes]
    others = [str(file) for file in photos if file.suffix.lower() in UNREAD_SUFFIXES]
    problems = []
    heif = [str(file) for file in photos if file.suffix.lower() in set(HEIF_SUFFIXES) - set(suffixes)]
    if heif:
        problems.append(f"{len(heif)} HEIC photographs ({enumerate_names(heif)}): pip install 'minisplat_ref[heic]'")
    if others:
        problems.append(
            f"{len(others)} photographs of formats that are not read ({enumerate_names(others)}): convert them to JPEG"
        )
    strange = [str(file) for file in photos if _is_image_of_another_name(folder / file)]
    if strange:
        problems.append(
            f"{len(strange)} images whose names do not end like one ({enumerate_names(strange)}): rename them"
        )
    left_out = Counter(by_product for file, by_product in by_products if file.suffix.lower() in suffixes)
    if left_out:
        names = enumerate_names([name if n == 1 else f"{name} with {n} images" for name, n in left_out.items()])
        problems.append(f"what is hidden or a by-product of other programs ({names})")
    if not files:
        instead = f", but {' and '.join(problems)}" if problems else ""
        raise InputError(f"{folder}: no images in it (looked for {' '.join(suffixes[:6])} and others){instead}")
    for problem in problems:
        warnings.warn(one_line(f"{folder}: leaving out {problem}"), InputWarning, stacklevel=2)
    return files


def _is_image_of_another_name(file: Path) -> bool:
    """Return whether a file begins like an image, though its suffix is not that of one."""
    if file.suffix.lower() in (*readable_suffixes(), *UNREAD_SUFFIXES, *HEIF_SUFFIXES):
        return False
    try:
        with file.open("rb") as opened:
            begin = opened.read(16)
    except OSError:
        return False
    return begin.startswith(BEGINNINGS) or (begin[:4] == b"RIFF" and begin[8:12] == b"WEBP")


def _by_product(folder: Path, file: Path) -> str | None:
    """Return the path to the first part that is hidden or a by-product; None if there is none."""
    for i, part in enumerate(file.parts, 1):
        path = Path(*file.parts[:i])
        is_smaller = SMALLER.fullmatch(part) and (folder / path).with_name("images").is_dir()
        if is_smaller or BY_PRODUCT.fullmatch(part):
            return path.as_posix() + ("/" if i < len(file.parts) else "")
    return None


def enumerate_names(names: list[str]) -> str:
    """Return names between commas, the first NAMED_MAX of them."""
    rest = f" and {len(names) - NAMED_MAX} more" if len(names) > NAMED_MAX else ""
    return f"{', '.join(names[:NAMED_MAX])}{rest}"
