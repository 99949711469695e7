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
# # 20 A block of threads
#
# On a GPU a tile is a block of 256 threads, and each thread has one pixel. It is the loop of notebook 15 again, turned
# inside out: the processor's kernel takes one row of eight pixels through the whole list, a block takes all its pixels
# through the list together, in step.
#
# From left to right: the tile; how many hits each thread has; and at which Gaussian of the list each warp, 32 threads
# that run together, has nothing left to do. A pixel that is finished early waits for its warp, and a warp for its
# block.
#
# There is no GPU here: Numba's simulator runs the kernels as Python threads. On an H200, images are those of
# the reference, too ([the backend cuda](../docs/INTERNALS.md#the-backend-cuda)).

# %%
import os

os.environ["NUMBA_ENABLE_CUDASIM"] = "1"  # before Numba is imported

import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREY, RED, YELLOW, show, show_code
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.cpu.compositing import plain
from minisplat_ref.cuda.compositing import tiles
from minisplat_ref.cuda.compositing.forward import forward_kernel
from minisplat_ref.cuda.footprints import TILE
from minisplat_ref.cuda.target import WARP
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import REFERENCE, get_backend
from minisplat_ref.types import Projection, TileGrid

CUDA = get_backend("cuda")

# %%
rng = np.random.default_rng(3)
N = 20
means2d = rng.uniform(1, TILE - 1, (N, 2))
means2d[:8] = rng.normal((4, 5), 1.5, (8, 2))  # a crowd, behind which nothing is seen
sigmas = rng.uniform(1.0, 3.0, N)
sigmas[:8] = 3.0
opacities = np.where(np.arange(N) < 8, 0.97, rng.uniform(0.2, 0.7, N))
reach = np.sqrt(2 * np.log(255 * opacities)) * sigmas
boxes = np.clip(np.concatenate([means2d - reach[:, None], means2d + reach[:, None]], 1).round(), 0, TILE)
projection = Projection(
    means2d.astype(np.float32),
    np.linspace(1, 2, N).astype(np.float32),
    (sigmas[:, None] ** -2.0 * [1, 0, 1]),
    opacities.astype(np.float32),
    np.ones((N, 2), np.int32),
    boxes.astype(np.int32),
)
colors = rng.uniform(size=(N, 3)).astype(np.float32)
background = np.zeros(3, np.float32)
grid = TileGrid(TILE, TILE, TILE, TILE)
bins = CUDA.bin_gaussians(projection, grid, GSPLAT_MAIN)

[hits] = tile_hits(projection, bins, GSPLAT_MAIN)
is_hit = np.zeros((len(hits.ids), TILE, TILE), bool)
is_hit[:, hits.ys, hits.xs] = hits.alphas > 0
last = np.where(is_hit.any(0), len(is_hit) - np.argmax(is_hit[::-1], 0), 0)  # after which a thread has no hit
by_warp = last.reshape(-1, WARP).max(1)

figure, panels = plt.subplots(1, 3, figsize=(10, 3.4))
image = CUDA.composite(projection, colors, background, bins, GSPLAT_MAIN).image
show(panels[0], image, "the tile, by 256 threads")
shown = panels[1].imshow(is_hit.sum(0), cmap="YlOrBr")
panels[1].set(title="hits of each thread", xticks=[], yticks=[])
figure.colorbar(shown, ax=panels[1], shrink=0.8)
panels[2].barh(range(len(by_warp)), len(is_hit), color="#efebe4")
panels[2].barh(range(len(by_warp)), by_warp, color=BLUE)
panels[2].barh(range(len(by_warp)), last.reshape(-1, WARP).mean(1), color=YELLOW, height=0.35)
panels[2].set(title="last hit: of a warp (blue), mean (yellow)", xlabel="place in the list", ylabel="warp")
panels[2].invert_yaxis()

# %% [markdown]
# | file | what it holds |
# |---|---|
# | `minisplat_ref/cpu/compositing/plain.py` | the loop, for a processor: read it first |
# | `minisplat_ref/cuda/compositing/tiles.py` | a thread's pixel; reading the list; a hit |
# | `minisplat_ref/cuda/compositing/forward.py`, `backward.py` | the kernels of a block |
# | `minisplat_ref/scalar/compositing.py` | `blend` and the other formulas, which both call |
#
# **Frames and units:** pixels; x to the right, y down; the centre of the first pixel is (0.5, 0.5).
#
# ## Two loops, one formula
#
# Here is the processor's loop over the list, from `plain.py`, with everything that it returns to a tile.

# %%
show_code(plain.forward_kernel.__wrapped__)

# %% [markdown]
# And here is the block's. What has become of each part:
#
# | `plain.py`, one row of eight pixels | a block of 256 threads |
# |---|---|
# | `state`: transmittance and colour, eight numbers each | `T` and `color`: registers of a thread |
# | `for m in row.members`: the row's own list | `for j in range(n_listed)`: the tile's list, for all threads |
# | `hit_row(hit, primitives, n, row)` | `hit(batch, j, ...)`: records from shared memory, up to 256 at a time |
# | `blend(T, unclamped, frame)` | the same function |
# | `if not reduce_any(T > ZERO): break` | `syncthreads_count(T > 0) == 0`: nobody in the block is open |
#
# The loop has no branch for pixels that are finished: `blend` gives them weight 0. Threads of a warp would wait for
# each other anyway.

# %%
show_code(forward_kernel(np.dtype(np.float32), 3, False).function)

# %% [markdown]
# The picture shows all 256 threads from left to right, and the list from top to bottom: the block takes one line after
# the other. Orange is a hit. Everything else is a thread that computes an alpha and adds nothing.

# %%
steps = is_hit.reshape(len(is_hit), -1)
figure, axis = plt.subplots(figsize=(9.5, 2.6))
axis.imshow(steps, cmap="YlOrBr", vmin=-0.2, vmax=2.2, aspect="auto")
for warp in range(1, len(by_warp)):
    axis.axvline(warp * WARP - 0.5, color=BLUE, linewidth=1)
axis.set(xlabel="thread; blue lines part the warps", ylabel="place in the list", title=f"{steps.mean():.0%} are hits")
plt.show()

# %% [markdown]
# `read_batch` is why a block is worth it. Its threads copy a batch of records together, wait until all have, and then
# read each record 256 times from memory that is as near as registers.

# %%
show_code(tiles.read_batch.fn if hasattr(tiles.read_batch, "fn") else tiles.read_batch)

# %% [markdown]
# ## Sums in a fixed order
#
# Backward, a Gaussian's gradient is a sum over the threads of many blocks. The quick way is an atomic addition: every
# block adds to the Gaussian's sum when it happens to get there. In float32 the order decides the last digits, so two
# runs of one training drift apart. The kernels add in a fixed order instead: a tree over the 32 threads of a warp, then
# the warps in order, then the tiles in order. The picture shows one sum of 512 blocks: in a thousand random orders, and
# in the fixed one.

# %% tags=["rounding"]
parts = rng.normal(size=512).astype(np.float32)
exact = parts.astype(np.float64).sum()


def in_order(values):
    """Add float32 numbers one after the other."""
    return np.cumsum(values, dtype=np.float32)[-1]


errors = np.array([in_order(rng.permutation(parts)) - exact for _ in range(1000)])
fixed = in_order(parts) - exact
figure, axis = plt.subplots(figsize=(7.5, 2.8))
axis.hist(1e6 * errors, bins=40, color=GREY)
axis.axvline(1e6 * fixed, color=RED, linewidth=2)
axis.set(
    xlabel="error of the sum, millionths", ylabel="of 1000 orders", title="any order (grey), the fixed order (red)"
)
plt.show()

# %% [markdown]
# The fixed order is not more exact. It is the same in every run, so that a difference between two runs is a difference
# between two programs. `--backend cuda-atomic` is the quick way.
#
# ## Against the reference
#
# Both backends blend the same tile, and chain the same gradient.

# %% tags=["rounding"]
truth = REFERENCE.composite(projection, colors, background, bins, GSPLAT_MAIN)
v_image, v_alpha = rng.normal(size=(TILE, TILE, 3)).astype(np.float32), np.zeros((TILE, TILE), np.float32)
output = CUDA.composite(projection, colors, background, bins, GSPLAT_MAIN)
arguments = projection, colors, background, bins, GSPLAT_MAIN
v = CUDA.composite_vjp(*arguments, output, v_image, v_alpha)
v_truth = REFERENCE.composite_vjp(*arguments, truth, v_image, v_alpha)
image_error = np.abs(output.image - truth.image).max()
gradient_error = max(np.abs(a - b).max() / np.abs(b).max() for a, b in zip(v[:4], v_truth[:4], strict=True))
print(f"image: {image_error:.0e}, gradients: {gradient_error:.0e} of the largest")
figure, axis = plt.subplots(figsize=(7.5, 2.6))
largest = np.abs(v_truth.colors).max()
axis.plot(v_truth.colors.ravel() / largest, "o", color=GREY, markersize=7, label="reference, float64")
axis.plot(v.colors.ravel() / largest, ".", color=RED, markersize=4, label="a block of threads, float32")
axis.set(xlabel="Gaussian and channel", ylabel="gradient of the colour")
axis.legend()
plt.show()

# %% [markdown]
# ## Play
#
# Change `N`, or move the crowd into a corner, and run the notebook again: the fewer warps see it, the more threads wait
# for the others.

# %%
waiting = 1 - last.mean() / by_warp.mean()
print(f"{waiting:.0%} of the threads' steps are spent waiting for the warp")

# %% [markdown]
# ## Exercises
#
# **1.** A warp is 32 pixels: two lines of the tile. Would squarer warps, 8 x 4 pixels, wait less here?
#
# <details><summary>Solution</summary>
#
# Neighbours finish together, and a square has nearer neighbours than a strip. Here the sums say by how much.
#
# ```python
# squares = last.reshape(4, 4, 2, 8).transpose(0, 2, 1, 3).reshape(-1, WARP).max(1)
# print(by_warp.mean(), squares.mean())
# assert squares.mean() <= by_warp.mean()
# ```
#
# </details>
#
# **2.** How many numbers does a block read from far memory for a list of 64 Gaussians with three colours, and how many
# would 256 threads read that each fetch the records for themselves?
#
# <details><summary>Solution</summary>
#
# A record has ten numbers and the colours.
#
# ```python
# together = 64 * (10 + 3)
# each_alone = TILE * TILE * together
# assert together == 832 and each_alone // together == 256
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
assert CUDA.residence.is_simulated and TILE * TILE == 8 * WARP
assert image_error < 2e-6 and gradient_error < 1e-5
assert np.ptp(errors) > 0 and in_order(parts) - exact == fixed  # orders differ, the fixed one repeats
again = CUDA.composite_vjp(*arguments, output, v_image, v_alpha)
assert all(np.array_equal(a, b) for a, b in zip(v, again, strict=True))  # the same bytes
assert by_warp.min() < len(is_hit)  # some warps have nothing to do at the end of the list
assert 0 < waiting < 1
