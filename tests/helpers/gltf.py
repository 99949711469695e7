"""A ``.glb`` read by hand: its JSON, and the numbers of an attribute."""

import json
import struct

import numpy as np

DTYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def glb_parts(content):
    """The JSON of a file, and its bytes."""
    magic, version, length = struct.unpack("<4sII", content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(content))
    n, kind = struct.unpack("<I4s", content[12:20])
    assert kind == b"JSON"
    n_body, kind = struct.unpack("<I4s", content[20 + n : 28 + n])
    assert kind == b"BIN\0" and 28 + n + n_body == length
    return json.loads(content[20 : 20 + n]), content[28 + n :]


def values(document, body, accessor):
    """The numbers of an accessor as they are stored, [count, columns]."""
    accessor = document["accessors"][accessor]
    view = document["bufferViews"][accessor["bufferView"]]
    n_columns = COLUMNS[accessor["type"]]
    offset = view["byteOffset"] + accessor.get("byteOffset", 0)
    numbers = np.frombuffer(body, DTYPES[accessor["componentType"]], accessor["count"] * n_columns, offset)
    return numbers.reshape(-1, n_columns)


def only_primitive(document):
    """The primitive of a file that has one, and its material."""
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    return primitive, document["materials"][primitive["material"]]
