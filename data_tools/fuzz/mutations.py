"""Damage to files, of the kinds that disks, exporters and people do: each function changes one thing.

Where a format has a structure, damage keeps to it as a rule: a changed byte of a .npz only fails its checksum, and a
changed byte of JSON is no JSON. So JSON is changed value by value, an .npz array by array, text word by word. What is
changed, and how, is chosen by a function, which is NumPy's generator in the long runs and Hypothesis in the tests.
"""

import io
import json
import re
import struct
import warnings
import zipfile
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Choose = Callable[[int], int]
"""``choose(n)`` returns one of 0 ... n - 1."""

DEEP = "@deep@"  # stands for lists in lists, which json.dumps cannot write
N_DEEP = 100_000
NAMES = (
    *(
        "",
        " ",
        ".",
        "..",
        "/",
        "../../outside.png",
        "/nowhere/out.png",
        "a/../../../b.png",
        "C:\\a.png",
        "\\\\a\\b",
    ),
    *("x" * 300, "x/" * 3000, "a\0b", "\ud800", "é.png", "con", "images", "a\nb", "%s{0}"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 1.5, 2**31, 2**63, 2**64, -(2**63), 10**400, 10**4000, 1e308, 1e-320, 3),
    *(float("nan"), float("inf"), -float("inf"), [], {}, [[]], [1, 2], {"a": 1}, "1", "nan", "1e999", "3" * 5000, DEEP),
    *NAMES,
)
WORDS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e400",
        "1e300",
        "-1",
        "0",
        "1.5",
        "2147483648",
        "18446744073709551615",
        "9" * 400,
        "9" * 5000,
    ),
    *("1_0", "0x10", "٣", "e", "ascii", "list", "char", "double", "PINHOLE", "OPENCV", "#", "\x00", "\xff", *NAMES),
)
INTEGERS = (0, 1, 2, 3, 7, 0x7F, 0x80, 0xFF, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
FLOATS = (0.0, -1.0, 1e-40, 1e38, float("nan"), float("inf"), -float("inf"))
NUMBER = re.compile(r"[-+]?\d[\w.+-]*")


class Text(NamedTuple):
    """Text as words and what stands between them."""

    words: list[str]
    gaps: list[str]  # one more than words

    def join(self) -> bytes:
        """Return the text, with whatever could not be encoded."""
        pairs = (part for pair in zip(self.gaps, [*self.words, ""], strict=True) for part in pair)
        return "".join(pairs).encode("utf-8", errors="surrogatepass")


def damage(content: bytes, suffix: str, choose: Choose) -> bytes:
    """Return a file's content with one to three things changed.

    Parameters
    ----------
    content : bytes
        Of a file that is right.
    suffix : str
        Of its name, ``.json`` for one, which tells the format.
    choose : callable
        Decides what is changed.
    """
    change = OF_SUFFIX.get(suffix, change_bytes) if choose(4) else change_bytes
    for _ in range(1 + choose(3)):
        content = change(content, choose)
    return content


def one_of(values: Sequence[Any], choose: Choose) -> Any:
    """Return one of the values."""
    return values[choose(len(values))]


def change_bytes(content: bytes, choose: Choose) -> bytes:
    """Overwrite, cut, repeat, insert or remove some bytes."""
    start = choose(len(content) + 1)
    stop = min(len(content), start + 1 + choose(16))
    before, span, after = content[:start], content[start:stop], content[stop:]
    match choose(8):
        case 0:
            return before
        case 1:
            return before + after
        case 2:
            return before + span + span + after
        case 3:
            return before + bytes(choose(256) for _ in range(1 + choose(8))) + content[start:]
        case 4 if span:
            return before + bytes([span[0] ^ 1 << choose(8)]) + content[start + 1 :]
        case 5:
            dtype = one_of(("<d", "<f", ">f"), choose)
            packed = struct.pack(dtype, one_of(FLOATS, choose))
            return before + packed + content[start + len(packed) :]
        case _:
            n_bytes = one_of((1, 2, 4, 8), choose)
            number = one_of(INTEGERS, choose) % 256**n_bytes
            packed = number.to_bytes(n_bytes, one_of(("little", "little", "big"), choose))
            return before + packed + content[start + n_bytes :]


def change_text(content: bytes, choose: Choose) -> bytes:
    """Replace, remove, repeat or swap words or lines."""
    parts = re.split(r"(\s+)", content.decode("utf-8", errors="replace"))
    text = Text(parts[::2], ["", *parts[1::2], ""])
    words, i = text.words, choose(len(text.words))
    match choose(6):
        case 0:
            words[i] = ""
        case 1:
            words[i] = f"{words[i]} {words[i]}"
        case 2:
            j = choose(len(words))
            words[i], words[j] = words[j], words[i]
        case 3:
            lines = content.split(b"\n")
            line = choose(len(lines))
            return b"\n".join([*lines[:line], *lines[line : line + 1] * one_of((0, 2), choose), *lines[line + 1 :]])
        case 4:
            numbers = [j for j, word in enumerate(words) if NUMBER.fullmatch(word)] or [i]
            words[one_of(numbers, choose)] = one_of(WORDS, choose)
        case _:
            words[i] = one_of(WORDS, choose)
    return text.join()


def change_json(content: bytes, choose: Choose) -> bytes:
    """Replace, remove, rename or copy one value, at any depth."""
    try:
        root = [json.loads(content)]
    except (ValueError, RecursionError):  # already damaged
        return change_bytes(content, choose)
    places = _places(root)
    container, key = one_of(places, choose)
    match choose(6):
        case 0 if container is not root:
            del container[key]
        case 1 if isinstance(container, dict):
            container[one_of(NAMES, choose)] = container.pop(key)
        case 2:
            other, other_key = one_of(places, choose)
            container[key] = json.loads(json.dumps(other[other_key]))
        case 3:
            container[key] = [container[key]]
        case _:
            container[key] = one_of(VALUES, choose)
    text = json.dumps(root[0])
    deep = json.dumps(DEEP)
    return text.replace(deep, "[" * N_DEEP + "]" * N_DEEP).encode("utf-8", errors="surrogatepass")


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every value inside a value, as its container and its key or index."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    places = []
    for key, inner in items:
        places += [(value, key), *_places(inner)]
    return places


def change_npz(content: bytes, choose: Choose) -> bytes:
    """Remove, rename, repeat or swap arrays, or change one, its header or the JSON that it holds; checksums are right.

    The parts may be compressed, as numbers that repeat can be a thousand times.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            parts = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except zipfile.BadZipFile:  # already damaged
        parts = []
    if not parts:
        return change_bytes(content, choose)
    with_json = [j for j, (name, _) in enumerate(parts) if name == "header.npy"]
    i = with_json[0] if with_json and choose(2) else choose(len(parts))
    name, part = parts[i]
    match choose(8):
        case 0:
            del parts[i]
        case 1:
            parts[i] = one_of(("x.npy", "gaussians.means.npy", "means", "../x.npy"), choose), part
        case 2:
            j = choose(len(parts))
            parts[i], parts[j] = (name, parts[j][1]), (parts[j][0], part)
        case 3:
            parts[i] = name, part + bytes(1 << 20)
        case 4:
            parts[i] = name, change_bytes(part, choose)
        case _:
            parts[i] = name, (_change_stored_json if name == "header.npy" else _change_array_header)(part, choose)
    file = io.BytesIO()
    compression = one_of((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED), choose)
    with zipfile.ZipFile(file, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two parts of one name
        for name, part in parts:
            archive.writestr(zipfile.ZipInfo(name), part, compression)
    return file.getvalue()


def _change_array_header(part: bytes, choose: Choose) -> bytes:
    """Change the type or shape that an array of a .npz says it has."""
    n_header = 10 + int.from_bytes(part[8:10], "little")
    header = part[10:n_header].decode("latin-1")
    values = re.findall(r"'[<>|=]\w+'|\([^)]*\)|True|False", header)
    if not values:
        return change_bytes(part, choose)
    new = one_of(
        (
            *("'|O'", "'<f4'", "'<f8'", "'>f8'", "'<i4'", "'|S8'", "'<U4'", "'<M8[s]'", "True", "()", "(0,)", "(1,)"),
            *("(2000000000,)", "(-1,)", "(50, 0)", "(4294967296, 4294967296)", "(0, 4294967296)", "(1,) * 9", "'<f99'"),
        ),
        choose,
    )
    changed = header.replace(one_of(values, choose), new, 1).encode("latin-1")
    return part[:8] + len(changed).to_bytes(2, "little") + changed + part[n_header:]


def _change_stored_json(part: bytes, choose: Choose) -> bytes:
    """Change the JSON that an array of bytes holds."""
    n_header = 10 + int.from_bytes(part[8:10], "little")
    text = change_json(part[n_header:], choose)
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({len(text)},), }}\n".encode()
    return part[:8] + len(header).to_bytes(2, "little") + header + text


def change_ply(content: bytes, choose: Choose) -> bytes:
    """Change the header, which is text."""
    header, end, vertices = content.partition(b"end_header\n")
    return change_text(header, choose) + end + vertices


OF_SUFFIX = {".json": change_json, ".npz": change_npz, ".txt": change_text, ".ply": change_ply}
"""Damage by the format of the file; files of other formats are changed as bytes."""
