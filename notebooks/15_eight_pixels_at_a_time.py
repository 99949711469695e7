# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     notebook_metadata_filter: -jupytext.text_representation.jupytext_version
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 15 Eight pixels at a time
#
# The textbook's renderer visits every pixel, and at each pixel every Gaussian of its tile. Most of these visits find
# nothing: the Gaussian does not reach the pixel, or the pixel is finished. This notebook shows how the kernels avoid
# them, and how they do what is left: a tile is 64 rows of eight pixels, a set of rows is one integer, and eight pixels
# are one number.
#
# The picture shows one Gaussian over one tile of 32 x 16 pixels. Where alpha reaches 1/255 there is a hit (yellow). The
# kernel computes how far the ellipse reaches up and down within each strip of eight columns, which gives the rows of
# eight that it has to visit (blue frames). The slanted ellipse becomes a staircase. A bounding box would visit the red
# frame.

# %%
import time

import matplotlib.pyplot as plt
import numba
import numpy as np
from matplotlib.patches import Rectangle

from figures import BLUE, GREY, RED, YELLOW, covariances2d, draw_ellipses
from minisplat_ref.bench.worked_rows import count_worked_rows
from minisplat_ref.bench.workloads import synth
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing.records import records_of
from minisplat_ref.cpu.compositing.tile_rows import find_reached_rows
from minisplat_ref.cpu.compositing.tile_state import N_ROWS, N_STRIPS, marked_rows
from minisplat_ref.cpu.tiling import TILE_HEIGHT, TILE_WIDTH
from minisplat_ref.jit.lanes import WIDTH, load, store
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.scalar.compositing import Frame, blend
from minisplat_ref.types import Projection, TileGrid


# %%
def footprint(mean, slant, sigmas, opacity):
    """Projection of one Gaussian: its ellipse has standard deviations ``sigmas`` and is turned by ``slant``."""
    turn = np.array([[np.cos(slant), -np.sin(slant)], [np.sin(slant), np.cos(slant)]])
    cov = turn @ np.diag(np.square(sigmas)) @ turn.T
    conic = np.linalg.inv(cov)
    reach = np.sqrt(2 * np.log(255 * opacity)) * np.sqrt(np.diag(cov))
    box = np.concatenate([np.floor(mean - reach), np.ceil(mean + reach)])
    box = np.clip(box, 0, [TILE_WIDTH, TILE_HEIGHT] * 2)
    return Projection(
        np.array([mean]),
        np.ones(1),
        conic[None, [0, 0, 1], [0, 1, 1]],
        np.array([opacity]),
        np.ones((1, 2), np.int32),
        box[None].astype(np.int32),
    )


GRID = TileGrid(TILE_WIDTH, TILE_HEIGHT, TILE_WIDTH, TILE_HEIGHT)


def reached(projection):
    """Rows that the kernel visits, as bits."""
    records = records_of(projection, np.zeros((1, 3)), GSPLAT_MAIN)
    return find_reached_rows(records, np.zeros(1, np.int32), 0, 0, 0)


slanted = footprint(np.array([15.3, 8.1]), 0.5, (5.5, 0.8), 0.8)
[hits] = tile_hits(slanted, REFERENCE.bin_gaussians(slanted, GRID, GSPLAT_MAIN), GSPLAT_MAIN)
alphas = np.zeros((TILE_HEIGHT, TILE_WIDTH))
alphas[hits.ys, hits.xs] = hits.alphas[0]
bits = reached(slanted)
n_rows = len(list(marked_rows(bits)))

figure, axis = plt.subplots(figsize=(9.5, 4.4))
axis.imshow(
    np.ma.masked_equal(np.sqrt(alphas), 0), cmap="YlOrBr", vmin=-0.3, vmax=1, extent=(0, TILE_WIDTH, TILE_HEIGHT, 0)
)
for row in range(N_ROWS):
    corner = (row // TILE_HEIGHT * WIDTH, row % TILE_HEIGHT)
    axis.add_patch(Rectangle(corner, WIDTH, 1, fill=False, edgecolor="#e6e2dd", linewidth=0.7))
for row in marked_rows(bits):
    corner = (row // TILE_HEIGHT * WIDTH, row % TILE_HEIGHT)
    axis.add_patch(Rectangle(corner, WIDTH, 1, fill=False, edgecolor=BLUE, linewidth=1.6))
x0, y0, x1, y1 = slanted.boxes[0]
axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=RED, linewidth=1.6, linestyle="--"))
axis.set(
    xlim=(-0.3, TILE_WIDTH + 0.3),
    ylim=(TILE_HEIGHT + 0.3, -0.3),
    title=f"one tile: {np.count_nonzero(alphas)} hits, {n_rows} of its 64 rows of eight visited",
)
axis.set_aspect("equal")
print(f"the set of rows, strip by strip: {int(bits):064b}")

# %% [markdown]
# | file | what it holds |
# |---|---|
# | `minisplat_ref/jit/lanes.py` | eight numbers as one value |
# | `minisplat_ref/cpu/compositing/tile_state.py` | the state of a tile's pixels |
# | `minisplat_ref/cpu/compositing/tile_rows.py` | which rows of a tile a Gaussian reaches, and its alpha there |
# | `minisplat_ref/cpu/compositing/forward.py`, `backward.py` | the kernels |
#
# **Frames and units:** pixels; x to the right, y down; the centre of the first pixel is (0.5, 0.5).
#
# ## A tile is 64 rows, a set of rows is one integer
#
# `find_reached_rows` is the function that the kernel calls; here it ran as plain Python. Its result is one integer,
# printed above, with one bit per row. The rows in which some pixel still accepts hits are another such integer. The
# work for a Gaussian is the intersection of the two, a single `&`. So finished rows cost nothing, row by row and not
# only when the whole tile is finished.
#
# ## What is left to visit
#
# Here is a view of 20,000 Gaussians with the sizes of trained ones, 480 x 270 pixels. From left to right: what a loop
# over 16 x 16 tiles visits when it takes three standard deviations as the extent, as 3DGS does; all pixels under the
# tight boxes; what the kernel visits; the hits.

# %%
workload = synth(20_000)
gaussians = type(workload.gaussians)._make(field.astype(np.float32) for field in workload.gaussians)
output, tape = render(gaussians, workload.camera, with_stats=True)
projection, bins = tape.splats.projection, tape.splats.bins

conics = projection.conics[projection.radii[:, 0] > 0]
determinants = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
variances = (conics[:, 0] + conics[:, 2]) / (2 * determinants) + np.sqrt(
    np.maximum((conics[:, 0] - conics[:, 2]) ** 2 / 4 + conics[:, 1] ** 2, 0)
) / determinants
three_sigma = np.ceil(3 * np.sqrt(variances))
means = projection.means2d[projection.radii[:, 0] > 0]
size = np.array([workload.camera.width, workload.camera.height])
low = np.clip((means - three_sigma[:, None]) // 16, 0, -(-size // 16))
high = np.clip((means + three_sigma[:, None]) // 16 + 1, 0, -(-size // 16))
boxes = projection.boxes.astype(np.int64)
visited = {
    "16 x 16 tiles\nat 3 sigma": int((high - low).prod(axis=1).sum()) * 256,
    "tight boxes": int(((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).sum()),
    "the kernel's\nrows": count_worked_rows(projection, tape.splats.channels, bins) * WIDTH,
    "hits": int(output.stats.hit_count.sum()),
}
figure, axis = plt.subplots(figsize=(7.5, 3.0))
bars = axis.bar(list(visited), [n / 1e6 for n in visited.values()], color=[GREY, RED, BLUE, YELLOW], width=0.6)
axis.bar_label(bars, fmt="%.1f M", padding=2)
axis.set(ylabel="million (pixel, Gaussian) pairs")
plt.show()

# %% [markdown]
# ## Eight numbers are one value
#
# A formula that consists of `+ - * /`, comparisons and `select` works for one number and for eight. In Python the eight
# are an array. Compiled, they are one register of the processor, and each operation is one instruction.
#
# Below, one Gaussian after the other is blended onto a row of pixels, twice: by the kernels' `blend`, eight pixels at a
# time, and by the same rules as a loop over pixels with branches. A pixel is finished where little light is left.


# %% tags=["clock"]
@numba.njit
def by_eights(alphas, colors, frame, light, image):
    """Blend hits [G, P] onto pixels that remember their transmittance, negative once they are finished."""
    for g in range(colors.size):
        for i in range(0, light.size, WIDTH):
            after, weight = blend(load(light, i), load(alphas[g], i), frame)
            store(light, i, after)
            store(image, i, load(image, i) + weight * colors[g])


@numba.njit
def one_by_one(alphas, colors, frame, light, image):
    """Blend them pixel by pixel."""
    for g in range(colors.size):
        for i in range(light.size):
            alpha = min(alphas[g, i], frame.alpha_max)
            if alpha >= frame.alpha_min and light[i] > 0:
                after = light[i] * (np.float32(1) - alpha)
                if after >= frame.transmittance_min:
                    image[i] += light[i] * alpha * colors[g]
                    light[i] = after
                else:
                    light[i] = -light[i]


rng = np.random.default_rng(0)
G, P = 60, 512
frame = Frame(P, 1, *(np.float32(x) for x in (1 / 255, 0.999, 1e-4, np.inf, np.inf)))
centres = rng.uniform(0, P, (G, 1))
opacities = (0.9 * np.exp(-(((np.arange(P) - centres) / 40) ** 2))).astype(np.float32)
colors = rng.random(G).astype(np.float32)
lights, rows, least = {}, {}, {}
for function in (by_eights, one_by_one):
    times = []
    for _ in range(30):
        light, image = np.ones(P, np.float32), np.zeros(P, np.float32)
        start = time.perf_counter()
        function(opacities, colors, frame, light, image)
        times.append(time.perf_counter() - start)
    lights[function.__name__], rows[function.__name__], least[function.__name__] = light, image, min(times)
for name, seconds in least.items():
    print(f"{name:12s} {1e9 * seconds / (G * P):6.2f} ns a pixel and Gaussian")
print(f"eight at a time take {least['by_eights'] / least['one_by_one']:.2f} of the time")

figure, axis = plt.subplots(figsize=(7.5, 2.6))
axis.plot(rows["by_eights"], color=BLUE, linewidth=2, label="eight at a time")
axis.plot(np.arange(0, P, 12), rows["one_by_one"][::12], "o", color=YELLOW, markersize=4, label="one by one")
axis.fill_between(np.arange(P), 0, 1, where=lights["by_eights"] < 0, color=GREY, alpha=0.15, label="finished")
axis.set(xlabel="pixel", ylabel="colour", xlim=(0, P), ylim=(0, 1))
axis.legend(ncols=3)
plt.show()

# %% [markdown]
# Why not leave this to the compiler? It vectorises a loop if it can prove that no store overlaps a load and that no
# step depends on the previous one. Otherwise it silently does not, and the loop takes several times as long. Here the
# code says what happens. There are no branches either: a processor executes past a branch before it knows which way it
# goes, and a misprediction discards that work.
#
# ## What it costs in digits
#
# It costs none: the arithmetic is that of the formulas, in the order in which they are written.

# %%
exact, _ = render(workload.gaussians, workload.camera, backend=REFERENCE)
double, _ = render(workload.gaussians, workload.camera, backend=CPU)
error = {
    "float64": np.abs(double.image - exact.image).max(),
    "float32": np.median(np.abs(output.image - exact.image).max(axis=2)),
}
print(f"float64: largest error {error['float64']:.1e};  float32: median over pixels {error['float32']:.1e}")

# %% [markdown]
# ## Play
#
# Move, turn and resize the Gaussian. What to look for:
#
# * `slant`: at 0 and at 90 degrees the staircase is the box. Where is the gain largest?
# * `opacity`: at 1/255 and below no row is left.
# * `mean`: move it out of the tile. Which rows remain?

# %%
mean, slant, sigmas, opacity = np.array([22.0, 6.0]), np.radians(-40), (7.0, 0.7), 0.5

mine = footprint(mean, slant, sigmas, opacity)
figure, axis = plt.subplots(figsize=(6.5, 3.2))
axis.set(xlim=(-0.3, TILE_WIDTH + 0.3), ylim=(TILE_HEIGHT + 0.3, -0.3), aspect="equal")
draw_ellipses(axis, mean, covariances2d(mine)[0], np.sqrt(2 * np.log(max(255 * opacity, 1))), color=RED)
for row in marked_rows(reached(mine)):
    corner = (row // TILE_HEIGHT * WIDTH, row % TILE_HEIGHT)
    axis.add_patch(Rectangle(corner, WIDTH, 1, facecolor=BLUE, alpha=0.3, edgecolor="white"))
axis.set(title=f"{len(list(marked_rows(reached(mine))))} of 64 rows", xticks=range(0, 33, 8), yticks=range(0, 17, 4))
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Row $r$ of a tile is bit $r$, counted down the first strip, then down the next. Which integer is the set of all
# rows that contain the pixel column 20?
#
# <details>
# <summary>Solution</summary>
#
# Column 20 lies in strip $\lfloor 20 / 8 \rfloor = 2$, which holds the rows 32 to 47: sixteen ones, shifted by 32.
#
# ```python
# column_20 = ((1 << 16) - 1) << 32
# assert all(row // TILE_HEIGHT == 2 for row in marked_rows(np.uint64(column_20)))
# assert len(list(marked_rows(np.uint64(column_20)))) == TILE_HEIGHT
# ```
#
# </details>
#
# **2.** `blend` has no branches and yet skips hits below 1/255. How can a hit be skipped without an `if`? Write it with
# `np.where` for eight pixels that are not finished, and compare with `blend`.
#
# <details>
# <summary>Solution</summary>
#
# Set its alpha to zero: then its weight is zero and the transmittance is multiplied by one. The work is done and has
# no effect. A pixel that stops keeps its transmittance with a minus sign.
#
# ```python
# light, alpha = np.linspace(0.001, 1, WIDTH, dtype=np.float32), opacities[3, 200 : 200 + WIDTH]
# alpha_used = np.where(alpha >= frame.alpha_min, np.minimum(alpha, frame.alpha_max), np.float32(0))
# next_light = light * (1 - alpha_used)
# is_over = next_light < frame.transmittance_min
# expected_light = np.where(is_over, -light, next_light)
# expected_weight = np.where(is_over, 0, light * alpha_used)
# light_after, weight = blend(light, alpha, frame)
# np.testing.assert_allclose(light_after, expected_light, rtol=1e-6)
# np.testing.assert_allclose(weight, expected_weight, rtol=1e-6)
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
looked = np.zeros((TILE_HEIGHT, TILE_WIDTH), bool)
for row in marked_rows(bits):
    x = row // TILE_HEIGHT * WIDTH
    looked[row % TILE_HEIGHT, x : x + WIDTH] = True
assert looked[alphas > 0].all() and (alphas > 0).sum() > 50  # no hit is missed
assert looked.sum() < 0.8 * (x1 - x0) * (y1 - y0)  # and the staircase is smaller than the box
everywhere = footprint(np.array([16.0, 8.0]), 0.0, (60.0, 60.0), 0.9)
nowhere = footprint(np.array([16.0, 60.0]), 0.0, (2.0, 2.0), 0.9)
assert int(reached(everywhere)) == 2**N_ROWS - 1 and int(reached(nowhere)) == 0 and N_STRIPS * WIDTH == TILE_WIDTH

counts = list(visited.values())
assert counts == sorted(counts, reverse=True) and counts[2] < 3 * counts[3]

np.testing.assert_allclose(rows["by_eights"], rows["one_by_one"], rtol=0, atol=1e-6)
np.testing.assert_array_equal(lights["by_eights"] < 0, lights["one_by_one"] < 0)
assert 0.1 < (lights["by_eights"] < 0).mean() < 0.99  # some pixels finish and some do not
in_python, _ = blend(np.ones(WIDTH, np.float32), opacities[0, :WIDTH], frame)
np.testing.assert_allclose(in_python, 1 - np.where(opacities[0, :WIDTH] < 1 / 255, 0, opacities[0, :WIDTH]), rtol=1e-6)

assert error["float64"] < 1e-12 and error["float32"] < 1e-6
