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
# # 03 Compositing
#
# Every pixel looks through a stack of translucent ellipses, the nearest first. Each of them contributes its colour to
# the light that those in front of it let through. This notebook follows that stack through one pixel, then through a
# whole image: tiles, depth order, depth maps, and the statistics on which Mini-Splatting is built.
#
# Below are five long Gaussians, 2 m to 4 m away, which all cross the marked pixel. The first bar chart shows how opaque
# each is in that pixel, the second how much light reaches it, and the third, the product, how much of it is seen.

# %%
import inspect

import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREEN, GREY, PLUM, RED, YELLOW, show_code, show_pixels
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.tracer import pixel_rays
from minisplat_ref.reference.compositing import blend_tile, composite, composite_all_pairs
from minisplat_ref.reference.depth import expected_depth
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.projection import project
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Gaussians, TileGrid

# %%
camera = Camera(np.eye(3), np.zeros(3), 80.0, 80.0, 40.0, 30.0, 80, 60)
depths = np.array([2.0, 2.5, 3.0, 3.5, 4.0])
half_turns = np.radians([0, 18, 36, 54, 72])
means = np.column_stack([np.full(5, 0.03), np.full(5, 0.02), np.ones(5)]) * depths[:, None]  # one ray holds them all
quats = np.column_stack([np.cos(half_turns), np.zeros(5), np.zeros(5), np.sin(half_turns)])  # turned about z
scales = np.array([[0.15, 0.035, 0.02]]) * depths[:, None]
opacities = np.array([0.35, 0.60, 0.50, 0.80, 0.95])
names = ("red", "blue", "yellow", "green", "plum")
colors = np.array([[int(code[i : i + 2], 16) / 255 for i in (1, 3, 5)] for code in (RED, BLUE, YELLOW, GREEN, PLUM)])
background = np.array([0.97, 0.96, 0.94])

projection = project(means, quats, scales, opacities, camera, GSPLAT_MAIN)
grid = TileGrid(width=80, height=60, tile_width=16, tile_height=16)
bins = bin_gaussians(projection, grid, GSPLAT_MAIN)
output = composite(projection, colors, background, bins, GSPLAT_MAIN, with_stats=True)

pixel_x, pixel_y = 42, 31
for tile in tile_hits(projection, bins, GSPLAT_MAIN):  # the tile that holds the pixel, and the pixel in it
    column = np.flatnonzero((tile.xs == pixel_x) & (tile.ys == pixel_y))
    if len(column):
        ids, alphas, transmittances = tile.ids, tile.alphas[:, column[0]], tile.transmittances[:, column[0]]
weights = alphas * transmittances[:-1]

figure = plt.figure(figsize=(10.5, 3.4))
panels = figure.subplots(1, 4, width_ratios=(1.7, 1, 1, 1))
show_pixels(panels[0], output.image, "five Gaussians and one pixel")
panels[0].plot(pixel_x + 0.5, pixel_y + 0.5, "s", color="black", fillstyle="none", markersize=6)
labels = [f"{projection.depths[i]:.1f}" for i in ids] + ["bg"]
hit_colors = [*colors[ids], background]
for axes, values, title in (
    (panels[1], [*alphas, 1.0], r"alpha $\alpha_i$"),
    (panels[2], transmittances, "transmittance $T_i$"),
    (panels[3], [*weights, transmittances[-1]], r"weight $\alpha_i T_i$"),
):
    bars = axes.bar(range(6), values, color=hit_colors, edgecolor="black", linewidth=0.5)
    axes.bar_label(bars, fmt="%.2f", fontsize=7)
    axes.set(title=title, ylim=(0, 1.12), xlabel="depth [m]; bg: background")
    axes.set_xticks(range(6), labels)
plt.show()

# %% [markdown]
# ## The stack behind one pixel
#
# With the alphas $\alpha_i$ of the hits from front to back,
#
# $$C = \sum_i c_i\,\alpha_i\,T_i + T_\text{end}\,c_\text{background}, \qquad
# T_i = \prod_{j<i} (1 - \alpha_j) \qquad \text{3DGS (3)}$$
#
# $$\alpha_i = \min\bigl(0.99,\; o_i\,e^{-\frac12 d^\top \Sigma'^{-1} d}\bigr) \qquad \text{3DGS (4), on the image}$$
#
# $T_i$ is the *transmittance*: the share of the background's light that the hits in front let through. $\alpha_i T_i$
# is the *weight* of hit $i$. The weights and what is left for the background add up to one, so the pixel's colour is a
# weighted mean. In the package, with hits along the rows and the pixels of a tile along the columns, these are five
# lines:

# %%
lines = [line.strip() for line in inspect.getsource(blend_tile).splitlines()]
starts = "T, T_end =", "weights =", "light = weights", "image =", "alpha ="
blending = [line for line in lines if line.startswith(starts)]
print(*blending, sep="\n")

# %% [markdown]
# | file | what it holds | equation |
# |---|---|---|
# | `minisplat_ref/reference/tiling.py` | which ellipses a tile has to blend, in which order | 3DGS sec. 6 |
# | `minisplat_ref/reference/hits.py` | alpha of a hit, transmittance in front of it | 3DGS (3), (4) |
# | `minisplat_ref/reference/compositing.py` | image, alpha and their gradient | 3DGS (3) |
# | `minisplat_ref/reference/blend_stats.py` | median depth, blend statistics | |
#
# *3DGS* is Kerbl et al. 2023. **Frames and units:** image coordinates are pixels, x right, y down; the centre of the
# top-left pixel is (0.5, 0.5). Depth is camera z, here in metres.
#
# ## Three thresholds
#
# Alpha is clamped at 0.99, so one Gaussian can never make the transmittance exactly zero. A hit below 1/255 is skipped,
# because it would not change an 8-bit image. And a pixel is finished when the next hit would leave no more than
# $10^{-4}$ of the light; that hit is not drawn. Left: alpha along a row of pixels through a single Gaussian, for three
# opacities. Right: the transmittance in the middle of thirty equal Gaussians, one behind the other.

# %%
row_camera = Camera(np.eye(3), np.zeros(3), 80.0, 80.0, 40.0, 0.5, 80, 1)
row_grid = TileGrid(80, 1, 16, 16)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2))
profile = {}
for o, color in ((1.0, RED), (0.3, YELLOW), (0.02, BLUE)):
    one = project(np.array([[0.0, 0.0, 2.0]]), quats[:1], np.full((1, 3), 0.2), np.array([o]), row_camera, GSPLAT_MAIN)
    row = composite(one, np.ones((1, 1)), np.zeros(1), bin_gaussians(one, row_grid, GSPLAT_MAIN), GSPLAT_MAIN)
    profile[o] = row.alpha[0]
    left.step(np.arange(80) + 0.5, np.where(profile[o] > 0, profile[o], np.nan), where="mid", color=color, label=f"{o}")
left.axhline(GSPLAT_MAIN.alpha_max, color=GREY, linewidth=0.8, linestyle="--")
left.axhline(GSPLAT_MAIN.alpha_min, color=GREY, linewidth=0.8, linestyle="--")
left.set(yscale="log", xlabel="x [px]", ylabel="alpha", title="clamped at 0.99, skipped below 1/255", ylim=(2e-3, 1.5))
left.legend(title="opacity", fontsize=8, loc="upper right")

n_layers = 30
stack_means = np.column_stack([np.zeros((n_layers, 2)), np.linspace(2, 3, n_layers)])
n_blended, T_end = {}, {}
for o, color in ((0.2, BLUE), (0.5, YELLOW), (0.85, RED)):
    stack = project(
        stack_means,
        np.tile(quats[0], (n_layers, 1)),
        np.full((n_layers, 3), 0.3),
        np.full(n_layers, o),
        row_camera,
        GSPLAT_MAIN,
    )
    for tile in tile_hits(stack, bin_gaussians(stack, row_grid, GSPLAT_MAIN), GSPLAT_MAIN):
        if 40 in tile.xs:
            middle = np.flatnonzero(tile.xs == 40)[0]
            n_blended[o] = np.count_nonzero(tile.alphas[:, middle])
            T = tile.transmittances[:, middle]
            T_end[o] = T[-1]
    right.semilogy(T, ".-", color=color, label=f"{o}: {n_blended[o]} of {n_layers} drawn")
right.axhline(GSPLAT_MAIN.transmittance_min, color=GREY, linewidth=0.8, linestyle="--")
right.set(xlabel="hits", ylabel="transmittance after so many hits", title="a pixel stops at $10^{-4}$")
right.legend(title="opacity", fontsize=8)
plt.show()

# %% [markdown]
# ## A picture made of surface points
#
# The rest of the notebook needs a picture. The ray tracer of `datasets` gives exact depths, so every pixel of six views
# of a room becomes one small round Gaussian on the surface that it sees. Nothing is trained. A seventh viewpoint, which
# was not used, shows the result: thin things are too fat, and what none of the six cameras saw is black.

# %%
room = make_scene("room", n_views=21, width=96, height=72, n_points=100, test_every=8, supersampling=2)


def lift(step, scale_px):
    """Gaussians on the surfaces that every step-th pixel of six views sees, of a size in those views' pixels."""
    means, scales, colors = [], [], []
    for v in (2, 4, 6, 7, 9, 11):
        view, depth = room.scene.train_views[v], room.train_depths[v][::step, ::step]
        rays = pixel_rays(view.camera, 0.5, 0.5, np.arange(72)).reshape(72, 96, 3)[::step, ::step]
        means.append((view.camera.center + depth[..., None] * rays).reshape(-1, 3))
        scales.append(scale_px * depth.ravel() / view.camera.fx)
        colors.append(view.image[::step, ::step].reshape(-1, 3) / 255)
    n = sum(map(len, means))
    return Gaussians(
        means=np.concatenate(means),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        log_scales=np.log(np.concatenate(scales))[:, None] * np.ones(3),
        opacity_logits=np.full(n, 2.0),
        sh_dc=(np.concatenate(colors) - 0.5) / SH_C0,
        sh_rest=np.zeros((n, 0, 3)),
    )


fine = lift(step=1, scale_px=0.4)
seen = room.scene.test_views[1]
fine_output, fine_tape = render(fine, seen.camera, backend=REFERENCE)
fine_image = np.clip(fine_output.image, 0, 1)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5))
show_pixels(left, seen.image, "ray-traced photograph, not used")
show_pixels(right, fine_image, f"{len(fine.means):,} lifted Gaussians, from the same viewpoint")
plt.show()

# %% [markdown]
# ## Tiles
#
# Asking every pixel about every Gaussian would take $H \times W \times N$ exponentials. Instead, the image is cut into
# tiles of 16 x 16 pixels, each Gaussian is listed in every tile that its box overlaps, and each list is sorted by the
# depth of the means. A (tile, Gaussian) entry is called a *pair*; the number of pairs is what rendering costs.

# %%
room_grid = TileGrid(96, 72, 16, 16)
room_bins = bin_gaussians(fine_tape.projection, room_grid, GSPLAT_MAIN)
n_pairs = np.diff(room_bins.tile_offsets).reshape(room_grid.n_tiles_y, room_grid.n_tiles_x)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.5))
show_pixels(left, fine_image, "Gaussians listed in each tile")
left.imshow(n_pairs, extent=(0, 96, 80, 0), cmap="inferno", alpha=0.45)
for row in range(room_grid.n_tiles_y):
    for tile_column in range(room_grid.n_tiles_x):
        left.text(
            16 * tile_column + 8,
            min(16 * row + 8, 69),
            n_pairs[row, tile_column],
            color="white",
            ha="center",
            va="center",
            weight="bold",
        )
left.set(xticks=range(0, 97, 16), yticks=range(0, 73, 16), ylim=(72, 0))
left.grid(color="white", linewidth=0.8)
sizes = (4, 8, 16, 32, 96)
pairs = [bin_gaussians(fine_tape.projection, TileGrid(96, 72, s, s), GSPLAT_MAIN).tile_offsets[-1] for s in sizes]
evaluations = [p * s * s for p, s in zip(pairs, sizes, strict=True)]
right.loglog(sizes, pairs, "o-", color=BLUE, label="pairs to sort")
right.loglog(sizes, evaluations, "s-", color=RED, label="pairs x pixels of a tile")
right.set(xlabel="tile side [px]", title="small tiles: more sorting; large tiles: more exponentials")
right.set_xticks(sizes, sizes)
right.minorticks_off()
right.legend()
plt.show()

# %%
show_code(bin_gaussians)

# %% [markdown]
# ## One order for all pixels
#
# The list is sorted by the depth of the *means*, in one order for all pixels. Where two Gaussians overlap, that is an
# approximation, and it has a price. Below, the camera turns by one degree, the two means swap their order, and the
# overlap suddenly changes its colour. This is called popping.

# %%
overlapping = Gaussians(
    means=np.array([[-0.3, 0.0, 3.0], [0.3, 0.0, 3.0]]),
    quats=quats[[0, 0]],
    log_scales=np.full((2, 3), np.log(0.35)),
    opacity_logits=np.full(2, 3.0),
    sh_dc=(colors[[2, 1]] - 0.5) / SH_C0,
    sh_rest=np.zeros((2, 0, 3)),
)
figure, panels = plt.subplots(1, 2, figsize=(8, 3))
overlap_colors = {}
for axes, degrees in zip(panels, (-0.5, 0.5), strict=True):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turned = camera._replace(cam_from_world_R=np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    turned_output, turned_tape = render(overlapping, turned, background=background, backend=REFERENCE)
    overlap_colors[degrees] = turned_output.image[30, 40]
    near, far = turned_tape.projection.depths[[0, 1]]
    title = f"turned by {degrees:+}°\nyellow at {near:.4f} m, blue at {far:.4f} m"
    show_pixels(axes, np.clip(turned_output.image, 0, 1), title)
plt.show()

# %% [markdown]
# ## Expected or median depth
#
# Depth can be blended like a colour. Below, a front layer at 2 m covers the left part of a back layer at 4 m. The
# *expected* depth $\sum_i w_i z_i / \sum_i w_i$ is smooth and differentiable, but at the edge of an object it lies in
# the empty space between front and back. The *median* depth, that of the hit which takes the transmittance below one
# half, jumps from one surface to the other.

# %%
y, x = np.meshgrid(np.linspace(-1.8, 1.8, 37), np.linspace(-2.3, 2.3, 47), indexing="ij")
back = np.stack([x, y, np.full_like(x, 4.0)], axis=-1).reshape(-1, 3)
front = np.stack([x / 2, y / 2, np.full_like(x, 2.0)], axis=-1)[:, :25].reshape(-1, 3)
layer_means = np.concatenate([front, back])
is_front = np.arange(len(layer_means)) < len(front)
layers = Gaussians(
    means=layer_means,
    quats=np.tile([1.0, 0.0, 0.0, 0.0], (len(layer_means), 1)),
    log_scales=np.log(np.where(is_front, 0.05, 0.06))[:, None] * np.ones(3),
    opacity_logits=np.where(is_front, 0.5, 2.0),
    sh_dc=(np.where(is_front[:, None], colors[0], colors[1]) - 0.5) / SH_C0,
    sh_rest=np.zeros((len(layer_means), 0, 3)),
)
layer_output, _ = render(layers, camera, backend=REFERENCE, with_depth=True, with_median_depth=True)
expected = expected_depth(layer_output.image[..., 3], layer_output.alpha)
median = layer_output.median_depth
figure, panels = plt.subplots(1, 4, figsize=(11.5, 2.6))
show_pixels(panels[0], np.clip(layer_output.image[..., :3], 0, 1), "image")
show_pixels(panels[1], expected, "expected depth", cmap="viridis", vmin=2, vmax=4)
drawn = show_pixels(panels[2], median, "median depth", cmap="viridis", vmin=2, vmax=4)
figure.colorbar(drawn, ax=panels[2], label="m", shrink=0.9)
panels[3].plot(np.arange(80) + 0.5, expected[30], color=RED, label="expected")
panels[3].plot(np.arange(80) + 0.5, median[30], color=BLUE, label="median")
panels[3].set(xlabel="x [px]", ylabel="depth [m]", title="row 30", xlim=(25, 60), ylim=(1.8, 4.2))
panels[3].legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Which Gaussian dominates a pixel
#
# Mini-Splatting takes three numbers per Gaussian from each view: the sum of its weights $\sum w$, how many pixels it
# touches, and in how many pixels it *dominates*, that is, has the largest weight of all. From these it decides which
# Gaussians to split (one that dominates many pixels is a blur) and which to drop. They come from the same pass as the
# image.

# %%
coarse = lift(step=8, scale_px=4.0)
coarse_output, _ = render(coarse, seen.camera, backend=REFERENCE, with_stats=True)
stats = coarse_output.stats
palette = np.vstack([[0.1, 0.1, 0.1], 0.25 + 0.75 * np.random.default_rng(3).random((len(coarse.means), 3))])
figure, panels = plt.subplots(1, 3, figsize=(11.5, 3))
show_pixels(panels[0], np.clip(coarse_output.image, 0, 1), f"{len(coarse.means)} coarse Gaussians")
show_pixels(panels[1], palette[stats.dominant_ids + 1], "one colour for each dominant Gaussian")
is_drawn, dominates = stats.hit_count > 0, stats.dominant_count > 0
edges = np.linspace(0, stats.blend_weight_sum.max(), 40)
heights = [stats.blend_weight_sum[is_drawn & ~dominates], stats.blend_weight_sum[dominates]]
labels = [f"dominates no pixel: {np.sum(is_drawn & ~dominates)}", f"dominates a pixel: {np.sum(dominates)}"]
panels[2].hist(heights, edges, histtype="stepfilled", alpha=0.6, color=(RED, BLUE), label=labels)
panels[2].set(yscale="log", xlabel="sum of a Gaussian's weights in this view [px]", ylabel="Gaussians")
panels[2].set_title(f"{is_drawn.sum()} of {len(coarse.means)} are drawn")
panels[2].legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Play
#
# Draw the five Gaussians again with other opacities or in another order, and run the cell. What to look for:
#
# * `my_opacities`: raise the first to 0.99. From which value on does the pixel no longer depend on what lies behind?
# * `my_means`: the red Gaussian has gone to the back. Bring it forward in steps of 0.5 m; the picture changes only when
#   it passes another one.

# %%
my_opacities = np.array([0.10, 0.60, 0.70, 0.80, 0.95])
my_means = means.copy()
my_means[0, 2] = 4.5  # the red one is now at the back

mine = project(my_means, quats, scales, my_opacities, camera, GSPLAT_MAIN)
my_output = composite(mine, colors, background, bin_gaussians(mine, grid, GSPLAT_MAIN), GSPLAT_MAIN, with_stats=True)
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2))
show_pixels(left, my_output.image, "yours")
right.bar(names, my_output.stats.blend_weight_sum, color=colors)
right.set(title="sum of weights over the image", ylabel="pixels")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** How many Gaussians of opacity 0.5, one behind the other, does a pixel draw before it is finished? And how many
# of opacity 0.99? Compare with the second figure.
#
# <details>
# <summary>Solution</summary>
#
# After $n$ hits of alpha $\alpha$ the transmittance is $(1 - \alpha)^n$, and the last hit drawn is the last that leaves
# more than $10^{-4}$: $n = \lceil \ln 10^{-4} / \ln(1 - \alpha) \rceil - 1$. That is 13 for 0.5. For 0.99 two hits
# would leave exactly $10^{-4}$, which is not more, so a single one is drawn. (In binary digits $(1 - 0.99)^2$ is a
# little more than $10^{-4}$; a renderer may draw two.)
#
# ```python
# n = np.ceil(np.log(1e-4) / np.log(1 - 0.5)) - 1
# assert n == n_blended[0.5] == 13
# ```
#
# </details>
#
# **2.** The order of two hits matters. Two Gaussians of alphas $a$ and $b$ and of colours $c_a$ and $c_b$ swap their
# order: by how much does the pixel change? When does popping not show?
#
# <details>
# <summary>Solution</summary>
#
# $a\,c_a + (1 - a)\,b\,c_b - b\,c_b - (1 - b)\,a\,c_a = ab\,(c_a - c_b)$. It shows only where both are opaque, and only
# as far as their colours differ.
#
# ```python
# rng = np.random.default_rng(0)
# alpha_a, alpha_b, color_a, color_b = rng.random(), rng.random(), rng.random(3), rng.random(3)
# one_order = alpha_a * color_a + (1 - alpha_a) * alpha_b * color_b
# other_order = alpha_b * color_b + (1 - alpha_b) * alpha_a * color_a
# assert np.allclose(one_order - other_order, alpha_a * alpha_b * (color_a - color_b))
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# The weights and the background's share add up to one, and they blend to the pixel of the image.
assert np.isclose(weights.sum() + transmittances[-1], 1.0) and np.count_nonzero(weights) == 5
assert np.allclose(weights @ colors[ids] + transmittances[-1] * background, output.image[pixel_y, pixel_x], rtol=1e-12)
# The most opaque hit does not dominate the pixel, because others stand in front of it.
assert ids[np.argmax(weights)] != ids[np.argmax(alphas)]
assert output.stats.dominant_ids[pixel_y, pixel_x] == ids[np.argmax(weights)]

assert len(blending) == 5  # the lines that are shown are still there

# Tiles change no image: the same recursion over all Gaussians and all pixels gives the same.
everything, alpha = composite_all_pairs(projection, colors, background, 80, 60, GSPLAT_MAIN)
assert np.allclose(everything, output.image, atol=1e-14) and np.allclose(alpha, output.alpha, atol=1e-14)
assert not np.allclose(output.image, background)

# The thresholds.
assert profile[1.0].max() == 0.99 and profile[0.02].max() < 0.0201
assert all(values[values > 0].min() >= 1 / 255 for values in profile.values())
assert n_blended[0.2] == 30 and n_blended[0.85] < n_blended[0.5] < 30
assert all(T > 1e-4 for T in T_end.values()) and 0.5 * T_end[0.5] < 1e-4  # stopped where the next would cross

# Small tiles cost pairs, and large tiles cost exponentials.
assert pairs == sorted(pairs, reverse=True) and evaluations == sorted(evaluations)

# Median depths are depths of layers; expected ones also take values in between.
assert set(np.unique(median)) == {2.0, 4.0}
assert np.any((expected > 2.5) & (expected < 3.5))

# Statistics: one Gaussian dominates each pixel that was hit; all weights add up to the alpha of all pixels.
assert stats.dominant_count.sum() == np.sum(stats.dominant_ids >= 0) > 0.9 * 96 * 72
assert np.isclose(stats.blend_weight_sum.sum(), coarse_output.alpha.sum(), rtol=1e-9)
assert 0 < np.sum(dominates) < np.sum(is_drawn) < len(coarse.means)

# A turn by one degree swaps the two means, and the overlap turns from mostly yellow to mostly blue.
before, after = overlap_colors.values()
assert np.linalg.norm(before - colors[2]) < np.linalg.norm(before - colors[1])
assert np.linalg.norm(after - colors[2]) > np.linalg.norm(after - colors[1])

# Where the six views looked, the lifted picture explains more than half of the photograph that it never saw.
is_covered = fine_output.alpha > 0.9
photograph = seen.image[is_covered] / 255  # [P, 3]
unexplained = np.mean((fine_image[is_covered] - photograph) ** 2) / photograph.var(axis=0).mean()
assert is_covered.mean() > 0.8 and unexplained < 0.5
