"""A ``.glb`` read by hand: its JSON, and the numbers of an attribute."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

DTYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def glb_parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON of a file, and its bytes."""
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    n, kind = struct.unpack("<I4s", content[12:20])
    assert kind == b"JSON"
    n_body, kind = struct.unpack("<I4s", content[20 + n : 28 + n])
    assert kind == b"BIN\0" and 28 + n + n_body == length
    return json.loads(content[20 : 20 + n]), content[28 + n :]


def values(document: Mapping[str, Any], body: bytes, accessor: int) -> NDArray:
    """Return the numbers of an accessor as they are stored, [count, columns]."""
    described = document["accessors"][accessor]
    view = document["bufferViews"][described["bufferView"]]
    n_columns = COLUMNS[described["type"]]
    offset = view["byteOffset"] + described.get("byteOffset", 0)
    numbers = np.frombuffer(body, DTYPES[described["componentType"]], described["count"] * n_columns, offset)
    return numbers.reshape(-1, n_columns)


def only_primitive(document: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the primitive of a file that has one, and its material."""
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    return primitive, document["materials"][primitive["material"]]
