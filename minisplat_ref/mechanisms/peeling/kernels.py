"""Depth peeling of translucent triangles and its gradient, as kernels: the twins of ``mechanisms.peeling.reference``.

A row of eight pixels, as the plain kernels have, would be all but empty: the triangles of a fan are slivers of a few
pixels. Here each triangle writes down which pixels it covers, its *fragments*, and each pixel sorts its own::

    triangles, in parallel      by triangle  | 0: f f f | 1: f | 2: f f ... |   pixel, b_1, b_2, 1/t of each fragment
    a counting sort             by pixel     | 0: f f | 1: f f f | ...          the same, as indices
    pixels, in parallel         sorted, the nearest last; many of them by a heap, from which the nearest is taken,
                                blended, and put at the end of what is left

Backward, pixels give every fragment its derivative with respect to alpha, then triangles add up their own fragments.
Each number has one writer, and sums have one order, whatever the number of threads.

The plane of a triangle makes ``g_i = b_i / t`` and their sum ``s = 1 / t`` linear in the pixel. With
``M = [P_0 P_1 P_2]``, the rows of its inverse are, in the sides ``e_i = P_i - P_0``, which do not cancel,

    g_1 = (e_2 x P_0) . d / det M,   g_2 = (P_0 x e_1) . d / det M,   s = (e_1 x e_2) . d / det M,   g_0 = s - g_1 - g_2

and the gradient with respect to ``M`` is ``-M^-T v_g g^T``. They are written as a value and two slopes about an
*anchor*, the pixel nearest to the first corner, so that float32 loses nothing to the distance from the image's corner.
Which pixels a triangle covers is decided in float64 whatever the data: of two neighbours always by one of them.
"""

import math
from typing import NamedTuple

import numpy as np

from minisplat_ref.jit.compile import kernel, n_threads, prange, scalar
from minisplat_ref.jit.literals import ONE, ZERO
from minisplat_ref.jit.scheduling import dynamic_range, make_shared_counter
from minisplat_ref.mechanisms.peeling.layers import (
    ANGLE_MIN,
    Frame,
    Peeled,
    PeelGradient,
    TranslucentMesh,
    gradient_of,
)
from minisplat_ref.scalar.projection import cross, dot
from minisplat_ref.types import Floats, Ints

G_1, G_2, S = 0, 3, 6  # columns of a plane: each a value at the anchor, and the slopes along x and y, per pixel
N_COLUMNS = 9
SLACK = 1e-6  # px that boxes and rows are too large by
PIXELS_PER_CHUNK = 64
ROOM_MAX = 1 << 24  # pixels of all boxes, 270 MB in float32
FEW = 24  # fragments of a pixel that are sorted by insertion


class Pinhole(NamedTuple):
    """The camera that projects vertices, as float64 scalars."""

    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    min_angle: float
    width: int
    height: int


class Rays(NamedTuple):
    """The rays (u, v, 1) of the pixels, in float64."""

    u: Floats
    """[W] of each column."""
    v: Floats
    """[H] of each row."""
    per_slope: float
    """fx, pixels."""
    near: float


class Planes(NamedTuple):
    """Triangles as their pixels see them."""

    edges: Floats
    """[T, 3, 3] float64: the product of each row with d is positive on the inner side of an edge."""
    columns: Floats
    """[T, N_COLUMNS]."""
    anchors: Ints
    """[T, 2] int32 pixel x, y."""
    boxes: Ints
    """[T, 4] int32 half-open x0, y0, x1, y1; empty where the triangle is not rendered."""


class Fragments(NamedTuple):
    """The pixels that triangles cover."""

    offsets: Ints
    """[T + 1] int64; triangle n owns the fragments offsets[n]:offsets[n + 1]."""
    pixels: Ints
    """[F] int32 flat index."""
    places: Floats
    """[F, 3] b_1, b_2 and 1/t: on an edge they may be a rounding below 0."""


class Layers(NamedTuple):
    """The fragments of pixels."""

    offsets: Ints
    """[H W + 1] int64."""
    ids: Ints
    """[F] int64, of each pixel the nearest last once it has been blended."""


class Tape(NamedTuple):
    """The values that the gradient needs again."""

    camera_vertices: Floats  # [P, 3] float64
    fragments: Fragments
    layers: Layers
    shades: Floats  # [F, 4] colour and alpha of each
    transmittances: Floats  # [F] in front of each; 0 for fragments that were not blended
    n_blended: Ints  # [H W] int64
    T_end: Floats  # [H W]


# --- one triangle ---


@scalar
def vertex(vertices, faces, n, i):
    """Return corner i of triangle n."""
    row = faces[n, i]
    return vertices[row, 0], vertices[row, 1], vertices[row, 2]


@scalar
def minus(a, b):
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@scalar
def inverse_rows(P_0, P_1, P_2):
    """Return the rows of g_1, g_2 and s before the division by det M, and det M."""
    e_1, e_2 = minus(P_1, P_0), minus(P_2, P_0)
    normal = cross(e_1, e_2)
    return cross(e_2, P_0), cross(P_0, e_1), normal, dot(normal, P_0)


@scalar
def is_first(a, b):
    """Whether a comes before b, by coordinates."""
    return a[0] < b[0] or (a[0] == b[0] and (a[1] < b[1] or (a[1] == b[1] and a[2] < b[2])))


@scalar
def edge_row(P, Q):
    """Return P x Q, for Q and P the same numbers with the other sign: a pixel is on one side of an edge, or the other.

    A compiler may round the two products of a cross product differently, and then they do not only change places.
    """
    if is_first(P, Q):
        return cross(P, Q)
    row = cross(Q, P)
    return -row[0], -row[1], -row[2]


@scalar
def grow_box(box, x, y):
    """Return the box with a point of the image in it."""
    return min(box[0], x), min(box[1], y), max(box[2], x), max(box[3], y)


@scalar
def grow_box_by_side(box, P, Q, pinhole):
    """Return the box with the first end of a side in it, and the point where the side meets the near plane."""
    if P[2] > pinhole.near:
        box = grow_box(box, pinhole.fx * P[0] / P[2] + pinhole.cx, pinhole.fy * P[1] / P[2] + pinhole.cy)
    if (P[2] > pinhole.near) != (Q[2] > pinhole.near):
        f = (pinhole.near - P[2]) / (Q[2] - P[2])
        x, y = P[0] + f * (Q[0] - P[0]), P[1] + f * (Q[1] - P[1])
        box = grow_box(box, pinhole.fx * x / pinhole.near + pinhole.cx, pinhole.fy * y / pinhole.near + pinhole.cy)
    return box


@scalar
def pixel_at(x, end):
    """Return the first pixel whose centre is not below x, in [0, end]."""
    return int(min(max(math.ceil(x - 0.5), 0.0), float(end)))


@kernel()
def _set_up(vertices, faces, pinhole, planes):
    edges, columns, anchors, boxes = planes
    for n in prange(faces.shape[0]):
        P_0, P_1, P_2 = vertex(vertices, faces, n, 0), vertex(vertices, faces, n, 1), vertex(vertices, faces, n, 2)
        row_1, row_2, normal, volume = inverse_rows(P_0, P_1, P_2)
        boxes[n, :] = 0
        # Written so that NaN is not rendered.
        if not abs(volume) > pinhole.min_angle * math.sqrt(dot(normal, normal)) * math.sqrt(dot(P_0, P_0)):
            continue
        box = np.inf, np.inf, -np.inf, -np.inf
        box = grow_box_by_side(box, P_0, P_1, pinhole)
        box = grow_box_by_side(box, P_1, P_2, pinhole)
        box = grow_box_by_side(box, P_2, P_0, pinhole)
        if not box[0] <= box[2]:  # nothing is in front of the near plane
            continue
        boxes[n, 0], boxes[n, 1] = pixel_at(box[0] - SLACK, pinhole.width), pixel_at(box[1] - SLACK, pinhole.height)
        boxes[n, 2], boxes[n, 3] = pixel_at(box[2] + SLACK, pinhole.width), pixel_at(box[3] + SLACK, pinhole.height)
        anchors[n, 0], anchors[n, 1] = pinhole.width // 2, pinhole.height // 2
        if P_0[2] > pinhole.near:
            anchors[n, 0] = min(
                pixel_at(pinhole.fx * P_0[0] / P_0[2] + pinhole.cx - 0.5, pinhole.width), pinhole.width - 1
            )
            anchors[n, 1] = min(
                pixel_at(pinhole.fy * P_0[1] / P_0[2] + pinhole.cy - 0.5, pinhole.height), pinhole.height - 1
            )
        x = (anchors[n, 0] + 0.5 - pinhole.cx) / pinhole.fx
        y = (anchors[n, 1] + 0.5 - pinhole.cy) / pinhole.fy
        sign = 1.0 if volume > 0 else -1.0
        opposite = edge_row(P_1, P_2), edge_row(P_2, P_0), edge_row(P_0, P_1)
        for i in range(3):
            for axis in range(3):
                edges[n, i, axis] = sign * opposite[i][axis]
        for column, row in ((G_1, row_1), (G_2, row_2), (S, normal)):
            columns[n, column] = (row[0] * x + row[1] * y + row[2]) / volume
            columns[n, column + 1] = row[0] / volume / pinhole.fx
            columns[n, column + 2] = row[1] / volume / pinhole.fy


@scalar
def is_within(edges, n, i, u, v):
    """Whether the ray (u, v, 1) passes an edge on its inner side; if exactly on it, whether one to the right does."""
    a, b = edges[n, i, 0], edges[n, i, 1]
    value = a * u + (b * v + edges[n, i, 2])
    return value > 0 or (value == 0 and (a > 0 or (a == 0 and b > 0)))


@scalar
def reciprocal_depth(planes, n, x, y):
    """Return s = 1 / t of a pixel in the plane of triangle n."""
    c = planes.columns
    as_data = c.dtype.type
    dx, dy = as_data(x - planes.anchors[n, 0]), as_data(y - planes.anchors[n, 1])
    return c[n, S] + c[n, S + 1] * dx + c[n, S + 2] * dy


@scalar
def covers(planes, n, x, y, rays):
    """Whether triangle n covers a pixel, and is beyond the near plane there."""
    u, v, edges = rays.u[x], rays.v[y], planes.edges
    if not (is_within(edges, n, 0, u, v) and is_within(edges, n, 1, u, v) and is_within(edges, n, 2, u, v)):
        return False
    s = reciprocal_depth(planes, n, x, y)
    return s > ZERO and rays.near * s < ONE


@scalar
def span(planes, n, y, rays):
    """Return the columns x0, x1 between which triangle n can cover pixels of a row; a slack on either side."""
    edges, first, last = planes.edges, planes.boxes[n, 0], planes.boxes[n, 2]
    low, high = float(first), float(last)
    for i in range(3):
        a, b = edges[n, i, 0], edges[n, i, 1]
        if abs(a) > SLACK * abs(b):  # an edge along the row bounds it nowhere, or by rounding
            # Where the row meets the edge, in pixels from the first one's centre.
            x = (-(b * rays.v[y] + edges[n, i, 2]) / a - rays.u[0]) * rays.per_slope
            if a > 0:
                low = max(low, x - SLACK)
            else:
                high = min(high, x + 1 + SLACK)
    return (math.ceil(low), math.ceil(high)) if low < high else (first, first)


@kernel()
def _count(planes, rays, counts):
    boxes = planes.boxes
    for n in prange(counts.size):
        counts[n] = 0
        for y in range(boxes[n, 1], boxes[n, 3]):
            x0, x1 = span(planes, n, y, rays)
            for x in range(x0, x1):
                counts[n] += covers(planes, n, x, y, rays)


@kernel()
def _list(planes, rays, rooms, counts):
    """Write the fragments of triangle n from ``rooms.offsets[n]`` on, and count them."""
    boxes, anchors, c = planes.boxes, planes.anchors, planes.columns
    offsets, pixels, places = rooms
    for n in prange(boxes.shape[0]):
        f = offsets[n]
        for y in range(boxes[n, 1], boxes[n, 3]):
            x0, x1 = span(planes, n, y, rays)
            for x in range(x0, x1):
                if not covers(planes, n, x, y, rays):
                    continue
                dx, dy = c.dtype.type(x - anchors[n, 0]), c.dtype.type(y - anchors[n, 1])
                s = reciprocal_depth(planes, n, x, y)
                pixels[f] = y * rays.u.size + x
                places[f, 0] = (c[n, G_1] + c[n, G_1 + 1] * dx + c[n, G_1 + 2] * dy) / s
                places[f, 1] = (c[n, G_2] + c[n, G_2 + 1] * dx + c[n, G_2 + 2] * dy) / s
                places[f, 2] = s
                f += 1
        counts[n] = f - offsets[n]


@kernel()
def _move_together(rooms, fragments):
    """Move the written part of each triangle's room to its final place."""
    starts, room_pixels, room_places = rooms
    offsets, pixels, places = fragments
    for n in prange(offsets.size - 1):
        start, first = starts[n], offsets[n]
        for i in range(offsets[n + 1] - first):
            pixels[first + i] = room_pixels[start + i]
            for k in range(3):
                places[first + i, k] = room_places[start + i, k]


def _fragments_of(planes: Planes, rays: Rays, dtype: np.dtype) -> Fragments:
    """Return the fragments of all triangles, in the order of these.

    A triangle gets as much room as its box has pixels, is rasterised into it once, and its fragments are then moved
    together. Where all boxes would take too much memory, fragments are counted before.
    """
    extents = planes.boxes[:, 2:] - planes.boxes[:, :2]
    sizes = np.prod(extents, axis=1, dtype=np.int64)
    if sizes.sum() > ROOM_MAX:
        _count(planes, rays, sizes)
    rooms, counts = _empty_fragments(sizes, dtype), np.empty_like(sizes)
    _list(planes, rays, rooms, counts)
    fragments = _empty_fragments(counts, dtype)
    _move_together(rooms, fragments)
    return fragments


def _empty_fragments(counts: Ints, dtype: np.dtype) -> Fragments:
    offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    return Fragments(offsets, np.empty(offsets[-1], np.int32), np.empty((offsets[-1], 3), dtype))


@kernel(parallel=False)
def _sort_by_pixel(pixels, offsets, ids):
    """Group fragments by their pixels, in their order; ``offsets`` begins with zeros."""
    for f in range(pixels.size):
        offsets[pixels[f] + 1] += 1
    for p in range(offsets.size - 1):
        offsets[p + 1] += offsets[p]
    ends = offsets[:-1].copy()
    for f in range(pixels.size):
        ids[ends[pixels[f]]] = f
        ends[pixels[f]] += 1


# --- one pixel ---


@scalar
def is_nearer(places, a, b):
    """Whether fragment a is in front of fragment b; of equally distant ones the first triangle's."""
    return places[a, 2] > places[b, 2] or (places[a, 2] == places[b, 2] and a < b)


@scalar
def sift_down(ids, i, n, places):
    """Make a heap of ``ids[:n]`` whose nearest is first, where all but position i are in order."""
    while 2 * i + 1 < n:
        child = 2 * i + 1
        if child + 1 < n and is_nearer(places, ids[child + 1], ids[child]):
            child += 1
        if not is_nearer(places, ids[child], ids[i]):
            break
        ids[i], ids[child] = ids[child], ids[i]
        i = child


@scalar
def sort_few(ids, places):
    """Sort the fragments of a pixel by insertion, the nearest last."""
    for i in range(1, ids.size):
        f, j = ids[i], i
        while j > 0 and is_nearer(places, ids[j - 1], f):
            ids[j] = ids[j - 1]
            j -= 1
        ids[j] = f


@kernel()
def _shade(fragments, faces, rgba, shades):
    """Interpolate colours and alphas."""
    offsets, places = fragments.offsets, fragments.places
    for n in prange(faces.shape[0]):
        for f in range(offsets[n], offsets[n + 1]):
            b_1, b_2 = places[f, 0], places[f, 1]
            for k in range(4):
                at_0, at_1, at_2 = rgba[faces[n, 0], k], rgba[faces[n, 1], k], rgba[faces[n, 2], k]
                shades[f, k] = (ONE - b_1 - b_2) * at_0 + b_1 * at_1 + b_2 * at_2


@kernel()
def _blend(layers, places, shades, background, max_layers, n_threads, out):
    taken, n_pixels = make_shared_counter(), layers.offsets.size - 1
    for _ in prange(n_threads):
        image, T_end, transmittances, n_blended = out
        for chunk in dynamic_range(taken, (n_pixels + PIXELS_PER_CHUNK - 1) // PIXELS_PER_CHUNK):
            for p in range(chunk * PIXELS_PER_CHUNK, min((chunk + 1) * PIXELS_PER_CHUNK, n_pixels)):
                ids = layers.ids[layers.offsets[p] : layers.offsets[p + 1]]
                is_sorted = ids.size <= FEW
                if is_sorted:
                    sort_few(ids, places)
                else:
                    for i in range(ids.size // 2 - 1, -1, -1):
                        sift_down(ids, i, ids.size, places)
                T, n_left = shades.dtype.type(1), ids.size
                image[p, :] = ZERO
                while n_left > max(ids.size - max_layers, 0):
                    n_left -= 1
                    if not is_sorted:
                        ids[0], ids[n_left] = ids[n_left], ids[0]
                        sift_down(ids, 0, n_left, places)
                    f = ids[n_left]
                    for k in range(3):
                        image[p, k] += shades[f, 3] * T * shades[f, k]
                    transmittances[f] = T
                    T *= ONE - shades[f, 3]
                for k in range(3):
                    image[p, k] += T * background[k]
                T_end[p], n_blended[p] = T, ids.size - n_left


@kernel()
def _blend_vjp(layers, shades, n_blended, transmittances, background, v_output, n_threads, v_shades):
    """Give every blended fragment the derivatives of its colour and alpha, from a pixel's last to its first."""
    taken, n_pixels = make_shared_counter(), n_blended.size
    for _ in prange(n_threads):
        v, v_alpha = v_output
        for chunk in dynamic_range(taken, (n_pixels + PIXELS_PER_CHUNK - 1) // PIXELS_PER_CHUNK):
            for p in range(chunk * PIXELS_PER_CHUNK, min((chunk + 1) * PIXELS_PER_CHUNK, n_pixels)):
                ids = layers.ids[layers.offsets[p] : layers.offsets[p + 1]]
                behind = v[p, 0] * background[0] + v[p, 1] * background[1] + v[p, 2] * background[2]
                for i in range(ids.size - n_blended[p], ids.size):
                    f = ids[i]
                    alpha, T = shades[f, 3], transmittances[f]
                    v_dot_c = v_alpha[p]
                    for k in range(3):
                        v_dot_c += v[p, k] * shades[f, k]
                        v_shades[f, k] = alpha * T * v[p, k]
                    v_shades[f, 3] = T * (v_dot_c - behind)
                    behind = alpha * v_dot_c + (ONE - alpha) * behind


@kernel()
def _triangles_vjp(vertices, faces, rgba, fragments, v_shades, v_corners, v_corner_rgba):
    """Add up the fragments of each triangle in float64, and carry the sum of ``v_g g^T`` on to its corners."""
    offsets, _, places = fragments
    for n in prange(faces.shape[0]):
        if offsets[n] == offsets[n + 1]:
            continue
        sums = np.zeros((3, 3), np.float64)
        for f in range(offsets[n], offsets[n + 1]):
            b_1, b_2 = np.float64(places[f, 0]), np.float64(places[f, 1])
            b = 1.0 - b_1 - b_2, b_1, b_2
            v_0 = v_1 = v_2 = 0.0
            for k in range(4):
                v = np.float64(v_shades[f, k])
                v_0 += v * rgba[faces[n, 0], k]
                v_1 += v * rgba[faces[n, 1], k]
                v_2 += v * rgba[faces[n, 2], k]
                for i in range(3):
                    v_corner_rgba[n, i, k] += v * b[i]
            mean = b[0] * v_0 + b_1 * v_1 + b_2 * v_2  # v_g_i = (v_b_i - mean) / s, and g_i = b_i s
            for i in range(3):
                sums[0, i] += (v_0 - mean) * b[i]
                sums[1, i] += (v_1 - v_0) * b[i]
                sums[2, i] += (v_2 - v_0) * b[i]
        P_0, P_1, P_2 = vertex(vertices, faces, n, 0), vertex(vertices, faces, n, 1), vertex(vertices, faces, n, 2)
        row_1, row_2, normal, volume = inverse_rows(P_0, P_1, P_2)
        for i in range(3):
            for axis in range(3):
                total = normal[axis] * sums[0, i] + row_1[axis] * sums[1, i] + row_2[axis] * sums[2, i]
                v_corners[n, i, axis] = -total / volume


# --- the functions of the reference ---


def peel(mesh: TranslucentMesh, frame: Frame, background: Floats) -> Peeled:
    """Render a mesh; see ``mechanisms.peeling.reference.peel``."""
    camera, dtype = frame.camera, mesh.vertices.dtype
    R, t = camera.cam_from_world_R.astype(np.float64), camera.cam_from_world_t.astype(np.float64)
    vertices = mesh.vertices.astype(np.float64) @ R.T + t
    n, n_pixels, size = len(mesh.faces), camera.width * camera.height, (camera.height, camera.width)
    planes = Planes(
        np.zeros((n, 3, 3)), np.zeros((n, N_COLUMNS), dtype), np.zeros((n, 2), np.int32), np.zeros((n, 4), np.int32)
    )
    fx, fy, cx, cy = map(float, (camera.fx, camera.fy, camera.cx, camera.cy))
    pinhole = Pinhole(fx, fy, cx, cy, float(frame.near), ANGLE_MIN, camera.width, camera.height)
    _set_up(vertices, mesh.faces, pinhole, planes)
    rays = Rays((np.arange(size[1]) + 0.5 - cx) / fx, (np.arange(size[0]) + 0.5 - cy) / fy, fx, pinhole.near)
    fragments = _fragments_of(planes, rays, dtype)
    n_fragments = len(fragments.pixels)
    layers = Layers(np.zeros(n_pixels + 1, np.int64), np.empty(n_fragments, np.int64))
    _sort_by_pixel(fragments.pixels, layers.offsets, layers.ids)

    shades = np.empty((n_fragments, 4), dtype)
    _shade(fragments, mesh.faces, mesh.rgba, shades)
    image, T_end = np.empty((n_pixels, 3), dtype), np.empty(n_pixels, dtype)
    transmittances, n_blended = np.zeros(n_fragments, dtype), np.empty(n_pixels, np.int64)
    out = image, T_end, transmittances, n_blended
    _blend(layers, fragments.places, shades, background.astype(dtype), frame.max_layers, n_threads(), out)
    return Peeled(
        image.reshape(*size, 3),
        (1 - T_end).reshape(size),
        np.diff(layers.offsets).reshape(size),
        np.diff(fragments.offsets) > 0,
        Tape(vertices, fragments, layers, shades, transmittances, n_blended, T_end),
    )


def peel_vjp(
    mesh: TranslucentMesh, frame: Frame, background: Floats, peeled: Peeled, v_image: Floats, v_alpha: Floats
) -> PeelGradient:
    """Gradient of :func:`peel`; see ``mechanisms.peeling.reference.peel_vjp``."""
    tape: Tape = peeled.tape
    dtype, n = mesh.vertices.dtype, len(mesh.faces)
    v = np.ascontiguousarray(v_image, dtype).reshape(-1, 3)
    v_output = v, np.ascontiguousarray(v_alpha, dtype).ravel()
    v_shades = np.zeros_like(tape.shades)
    _blend_vjp(
        tape.layers,
        tape.shades,
        tape.n_blended,
        tape.transmittances,
        background.astype(dtype),
        v_output,
        n_threads(),
        v_shades,
    )
    v_corners, v_corner_rgba = np.zeros((n, 3, 3)), np.zeros((n, 3, 4))
    _triangles_vjp(tape.camera_vertices, mesh.faces, mesh.rgba, tape.fragments, v_shades, v_corners, v_corner_rgba)
    v_camera, v_rgba = (_by_vertex(mesh, v) for v in (v_corners, v_corner_rgba))
    return gradient_of(mesh, frame, v_camera, v_rgba, tape.T_end.astype(np.float64) @ v)


def _by_vertex(mesh: TranslucentMesh, v_corners: Floats) -> Floats:
    """Return the sums [P, k], over the corners that are a vertex, of ``v_corners`` [T, 3, k]."""
    rows, n, columns = mesh.faces.ravel(), len(mesh.vertices), np.moveaxis(v_corners, 2, 0)
    return np.stack([np.bincount(rows, column.ravel(), minlength=n) for column in columns], axis=1)
