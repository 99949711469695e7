"""The label of a file of Gaussians: the extension that renders it, and the parts of its run that it lacks.

The numbers of a file do not tell which renderer they were trained for: 3DGS renders traced, filtered or integrated
Gaussians without complaint, and worse. Nor does a file hold parts other than Gaussians that every view shows, such as a
sky. So a file names the extension that renders it, and what it lacks of its run:

- a PLY in comments of its header: ``comment minisplat_ref extension NAME``, ``comment minisplat_ref set NAME=VALUE``
  for a setting of its renderer, and ``comment minisplat_ref lacks PART``;
- a compact format of ours in its own header (:class:`minisplat_ref.io.formats.Format`);
- a compact format of others in a sidecar, ``FILE.json``, an object with the key ``minisplat_ref``. It has the SHA-256
  of its file, so that it does not apply to another one that replaces it.

Other programs ignore all three. A file that 3DGS renders and that lacks nothing has no label: any program can use it.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.errors import InputError, InputWarning, one_line
from minisplat_ref.io.atomic import replacing
from minisplat_ref.io.json_file import parse_json, read_json

MARK = "minisplat_ref"  # the first word of our comments, and the key of our sidecars
NAME = re.compile(r"[^\s/\\]+")  # of an extension or a part
SETTING = re.compile(r"[^\s=]+=[^\s=]+")
WAY_OUT = "write the file again with minisplat-ref convert"


class Label(NamedTuple):
    """The renderer of a file."""

    extension: str | None = None
    """Name of the extension that renders it; None for 3DGS."""
    lacks: tuple[str, ...] = ()
    """Names of the shared parameters that its run is rendered with, and that the file does not hold."""
    set: tuple[str, ...] = ()
    """Settings of the extension's renderer, each as ``NAME=VALUE``, that are not its own."""


NO_LABEL = Label()
"""The label of a file that any program can render."""


def to_comments(label: Label) -> list[str]:
    """Return the comments that a PLY has in its header, without the word ``comment``."""
    extension = [] if label.extension is None else [f"{MARK} extension {label.extension}"]
    settings = [f"{MARK} set {setting}" for setting in label.set]
    return [*extension, *settings, *(f"{MARK} lacks {part}" for part in label.lacks)]


def from_comments(comments: Iterable[str], source: str | Path) -> Label:
    """Return the label that comments of a PLY make; those of other programs do not matter.

    Raises
    ------
    InputError
        They name no extension where one should be, or two.
    """
    values: dict[str, list[str]] = {"extension": [], "set": [], "lacks": []}
    for comment in comments:
        mark, _, rest = comment.partition(" ")
        key, _, value = rest.partition(" ")
        if mark == MARK and key in values:
            values[key].append(value)
    names = set(values["extension"])
    if len(names) > 1:
        raise InputError(
            f"{source}: damaged, its comments name the extensions {' and '.join(sorted(names))}; {WAY_OUT}"
        )
    return from_json({**values, "extension": next(iter(names), None)}, source)


def to_json(label: Label) -> dict[str, Any]:
    """Return the label as JSON holds it."""
    return {"extension": label.extension, "set": list(label.set), "lacks": list(label.lacks)}


def from_json(value: Any, source: str | Path) -> Label:
    """Return the label that :func:`to_json` made, ``NO_LABEL`` of None.

    Raises
    ------
    InputError
        It is none.
    """
    if value is None:
        return NO_LABEL
    if not isinstance(value, Mapping):
        raise InputError(f"{source}: damaged, it says {value!r} where it should say what draws it; {WAY_OUT}")
    extension, lacks, settings = value.get("extension"), value.get("lacks", []), value.get("set", [])
    names = [] if extension is None else [extension]
    for name in (*names, *(lacks if isinstance(lacks, list) else [None])):
        if not isinstance(name, str) or not NAME.fullmatch(name):
            raise InputError(f"{source}: damaged, it names what draws it, or what it lacks, as {name!r}; {WAY_OUT}")
    for setting in settings if isinstance(settings, list) else [None]:
        if not isinstance(setting, str) or not SETTING.fullmatch(setting) or extension is None:
            raise InputError(f"{source}: damaged, it sets {setting!r} of what draws it; {WAY_OUT}")
    return Label(extension, tuple(dict.fromkeys(lacks)), tuple(dict.fromkeys(settings)))


def warn_of_another(path: Path, label: Label, extension: str, why: str) -> None:
    """Warn if a file is labelled with another extension than the one that renders it now; ``why`` names its origin."""
    if label.extension not in (None, extension):
        message = f"{path} says that extension {label.extension} draws it: {why} draws it otherwise"
        warnings.warn(one_line(message), InputWarning, stacklevel=3)


def sidecar_path(path: Path) -> Path:
    """Return the path of the label of a file that has no place for it."""
    return path.with_name(f"{path.name}.json")


def read_sidecar(path: Path, content: bytes) -> Label:
    """Return the label stored next to a file; a JSON file of another program is none.

    Parameters
    ----------
    path : Path
        The file itself.
    content : bytes
        What is in it; a label of other bytes is left out, with a warning.

    Raises
    ------
    InputError
        The sidecar cannot be read or is damaged.
    """
    sidecar = sidecar_path(path)
    if not sidecar.is_file():
        return NO_LABEL
    ours = _ours(read_json(sidecar, f"mend or remove it, it says how {path.name} is drawn"))
    if ours is None:
        return NO_LABEL
    label = from_json(ours, sidecar)
    if not isinstance(ours, Mapping) or ours.get("sha256") != hashlib.sha256(content).hexdigest():
        message = f"{sidecar} is of another {path.name}, and is left out: remove it"
        warnings.warn(one_line(message), InputWarning, stacklevel=2)
        return NO_LABEL
    return label


def write_sidecar(path: Path, written: Path, label: Label) -> None:
    """Write the label beside a file, or remove that of an earlier file.

    Parameters
    ----------
    path : Path
        Where the file will be.
    written : Path
        Where its content is now.
    label : Label

    Raises
    ------
    InputError
        Another program's file has the sidecar's name, or it cannot be written.
    """
    sidecar = sidecar_path(path)
    is_ours = sidecar.is_file() and _is_ours(sidecar)
    if label == NO_LABEL:
        if is_ours:
            sidecar.unlink()
        return
    if sidecar.exists() and not is_ours:
        raise InputError(
            f"{sidecar} is not of this program, and is where it says how {path.name} is drawn: rename one of them"
        )
    with written.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    with replacing(sidecar) as temporary:
        text = json.dumps({MARK: {**to_json(label), "sha256": digest}}, indent=2)
        temporary.write_text(text + "\n", encoding="utf-8")


def _ours(value: Any) -> Any:
    return value.get(MARK) if isinstance(value, dict) else None


def _is_ours(sidecar: Path) -> bool:
    try:
        return _ours(parse_json(sidecar.read_bytes(), sidecar, "")) is not None
    except (InputError, OSError):
        return False
