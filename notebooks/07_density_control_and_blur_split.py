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
# # 07 Density control and blur split
#
# Training starts with a few hundred Gaussians and needs many thousands. Which ones should become two? 3DGS looks at
# the gradient by the position: where it is large, the photographs pull one Gaussian to two places. There is a spot
# that this sign does not see. A large Gaussian in front of a fine texture is pulled to all sides at once, the pulls
# cancel, and the texture stays blurred. Mini-Splatting adds a second sign, an area, and calls the event *blur split*.
#
# | file | what it holds | where in the paper |
# |---|---|---|
# | `minisplat_ref/strategy/clone_split.py` | the gradient's sign; clone, split, prune | 3DGS sec. 5.2 |
# | `minisplat_ref/strategy/blur_split.py` | the area's sign; children on the longest axis | MS sec. 4.1, eq. 2 |
# | `minisplat_ref/methods/` | the same as events of a recipe | |
#
# *3DGS* is Kerbl et al. 2023, *MS* is Mini-Splatting, Fang and Wang 2024. **Frames and units:** the world is in metres;
# image coordinates are pixels, x right, y down. Gradients by the position are taken in units in which the image is 2
# wide and 2 high.

# %%
import copy
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import EllipseCollection

from figures import BLUE, GREY, RED, YELLOW, show, show_code
from minisplat_ref.backends import CPU
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import gaussian_splatting, get_recipe, mini_splatting
from minisplat_ref.metrics import evaluate, psnr
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.strategy.blur_split import is_blurred, principal_axis_children
from minisplat_ref.strategy.clone_split import clone_and_split, logit, random_children, screen_gradient_norms
from minisplat_ref.training.loop import initial_state, train
from minisplat_ref.training.schedule import BLEND_STATS, During, Every
from minisplat_ref.types import Camera, Gaussians

# %% [markdown]
# ## One Gaussian, two photographs
#
# A grey Gaussian in front of a camera. One photograph is dark on the left and bright on the right; the other is a fine
# checkerboard. In both the Gaussian is the only one, so it has the largest weight at the same pixels.

# %%
SIZE = 48
camera = Camera(np.eye(3), np.zeros(3), 48.0, 48.0, SIZE / 2, SIZE / 2, SIZE, SIZE)
alone = Gaussians(
    means=np.array([[0.06, 0.04, 4.0]]),
    quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
    log_scales=np.log([[0.6, 0.6, 0.6]]),
    opacity_logits=np.array([logit(0.95)]),
    sh_dc=np.zeros((1, 3)),  # grey
    sh_rest=np.zeros((1, 0, 3)),
)
output, tape = render(alone, camera, with_stats=True)
ys, xs = np.mgrid[:SIZE, :SIZE]
photographs = {
    "an edge": np.where(xs < SIZE / 2, 0.15, 0.85),
    "a fine texture": np.where((xs // 3 + ys // 3) % 2, 0.15, 0.85),
}

figure, axes = plt.subplots(1, 5, figsize=(12, 2.6))
show(axes[0], output.image, "the Gaussian")
pulls = {}
for k, (name, photograph) in enumerate(photographs.items()):
    target = np.repeat(photograph[:, :, None], 3, axis=2)
    loss, loss_tape = CPU.photometric_loss(output.image, target, 0.2, None)
    v_means2d = render_vjp(tape, CPU.photometric_loss_vjp(loss_tape)).means2d
    pulls[name] = float(screen_gradient_norms(v_means2d, SIZE, SIZE)[0])
    show(axes[1 + 2 * k], target, name)
    show(axes[2 + 2 * k], np.abs(output.image - target).mean(axis=2), f"error, loss {loss:.2f}", cmap="magma", vmax=1)
    arrow = -5e3 * v_means2d[0]
    centre = tape.projection.means2d[0]
    axes[1 + 2 * k].annotate(
        "", centre + arrow, centre, arrowprops={"arrowstyle": "->", "color": RED, "linewidth": 2.5}
    )
    axes[1 + 2 * k].plot(*centre, "o", color=RED, markersize=4)
plt.show()
n_led = int(output.stats.dominant_count[0])
for name, pull in pulls.items():
    print(f"{name:<15} gradient by the position {pull:.1e}, largest weight at {n_led} pixels")

# %% [markdown]
# The arrow is the step that gradient descent would take. The texture needs a split as badly, and the gradient is next
# to nothing.
#
# ## The second sign: who leads where
#
# The compositor counts at how many pixels each Gaussian has the largest blending weight $w = \alpha T$. Whoever leads
# at more than a fraction $\theta = 2 \cdot 10^{-4}$ of an image since the last event is split, whatever its gradient
# and size (MS eq. 2). In a photograph of a megapixel that is a patch of 15 x 15 pixels.

# %%
show_code(is_blurred)

# %% [markdown]
# In our photographs of 128 x 96 pixels a fraction of $2 \cdot 10^{-4}$ is 2.5 pixels, less than any Gaussian can be
# made to cover; the recipes never call 64 pixels blurred (`least_area`). We take $\theta = 6 \cdot 10^{-3}$, 74
# pixels. The threshold of the gradient is raised to $10^{-3}$ for a like reason: in a small image every Gaussian covers
# a larger part, and gradients are larger.
#
# Now a room with 300 points, trained for 350 iterations with the density control of 3DGS alone:

# %%
THRESHOLD, AREA_FRACTION, SIZE_FRACTION = 1e-3, 6e-3, 0.01
FIRST_STOP, STOP, ITERATIONS = 350, 550, 750  # end of the first part; end of density control; end
scene = make_scene("room", n_views=16, width=128, height=96, n_points=300, seed=0).scene
base = get_recipe("3dgs-accel", 1000)._replace(sh_milestones=())


def density_control(start, stop, has_blur_split=False, draw_children=random_children):
    """Events every 50 iterations."""
    densify = partial(
        gaussian_splatting.clone_and_split,
        threshold=THRESHOLD,
        size_fraction=SIZE_FRACTION,
        draw_children=draw_children,
    )
    blur = During(partial(mini_splatting.collect_blur, area_fraction=AREA_FRACTION), start, stop, wants=BLEND_STATS)
    return (
        During(gaussian_splatting.collect_gradients),
        *([blur] if has_blur_split else []),
        Every(50, densify, start, stop),
        Every(50, partial(gaussian_splatting.prune_faint, least_opacity=0.005), start, stop),
    )


first_part = base._replace(iterations=FIRST_STOP, events=density_control(0, FIRST_STOP - 40))
state = train(scene, first_part, seed=0)
before = state.gaussians
mean_norms = state.stats["gradient_sum"] / np.maximum(state.stats["view_count"], 1)  # [N] since the last event
n_start = len(initial_state(scene, base, seed=0).gaussians.means)
print(f"{n_start} Gaussians at first, {len(before.means)} after {state.step} iterations")

# %%
view, held_out = scene.train_views[3], scene.test_views[1]
camera = view.camera
in_views = [render(before, v.camera, with_stats=True)[0].stats.dominant_count for v in scene.train_views]
areas = np.max(in_views, axis=0)  # [N] pixels, in the view where it leads most
marked = is_blurred(areas, camera.width, camera.height, area_fraction=AREA_FRACTION)
is_pulled = mean_norms >= THRESHOLD
is_missed = marked & ~is_pulled


def leaders(gaussians, camera, shade):
    """Colour every pixel by the Gaussian that leads there: shade [N, 3]; black where there is none."""
    stats = render(gaussians, camera, with_stats=True)[0].stats
    return np.vstack([shade, [0, 0, 0]])[stats.dominant_ids], stats


rng = np.random.default_rng(1)
tints = 0.45 + 0.5 * rng.random((len(before.means), 1)) * np.ones(3)  # [N, 3] greys
warm = np.array([0.82, 0.29, 0.25]) + 0.25 * (rng.random((len(before.means), 1)) - 0.5)
tints[is_missed] = warm[is_missed]
picture, _ = leaders(before, camera, tints)
output, _ = render(before, camera, background=scene.background)

figure, axes = plt.subplots(1, 4, figsize=(13, 2.9), width_ratios=(1, 1, 1, 1.1))
show(axes[0], view.image / 255, "photograph")
show(axes[1], output.image, "render")
show(axes[2], picture, "who leads; red: large area, small gradient")
for mask, color, label in (
    (~marked & ~is_pulled, GREY, "neither"),
    (is_pulled & ~marked, BLUE, "gradient"),
    (is_pulled & marked, YELLOW, "both"),
    (is_missed, RED, "area alone"),
):
    axes[3].loglog(
        mean_norms[mask], np.maximum(areas[mask], 0.5), ".", color=color, markersize=3, label=f"{label}: {mask.sum()}"
    )
axes[3].axvline(THRESHOLD, color="black", linewidth=0.8)
axes[3].axhline(AREA_FRACTION * camera.width * camera.height, color="black", linewidth=0.8)
axes[3].set(xlabel="mean gradient by the position", ylabel="pixels led", title="the two signs")
axes[3].set(xlim=(1e-5, None), ylim=(0.4, 2e5))
axes[3].legend(frameon=False, fontsize=7, loc="upper left")
plt.show()

# %% [markdown]
# The walls are red. Bricks and stripes have not been drawn there, and by the gradient nothing is wrong.
#
# ## Two ways to split
#
# The released code of Mini-Splatting splits as 3DGS does: two children drawn at random from the Gaussian, with 1/1.6 of
# its scales. The other rule cuts it in two across its longest axis, and gives each half its centre of mass and its
# variance:
#
# $$\mu' = \mu \pm \sqrt{2/\pi}\; s_k R_k, \qquad s'_k = \sqrt{1 - 2/\pi}\; s_k, \qquad \text{the others as they were}$$
#
# The even mixture of both then has the parent's mean and covariance, since $2/\pi + (1 - 2/\pi) = 1$.

# %%
show_code(principal_axis_children)

# %%
parent = alone._replace(
    quats=np.array([[np.cos(0.2), 0.0, 0.0, np.sin(0.2)]]),
    log_scales=np.log([[0.7, 0.3, 0.3]]),
    sh_dc=np.array([[0.87, 0.6, 0.1]]) / SH_C0 - 0.5 / SH_C0,
)
parent_id = np.array([0])
forms = {
    "the parent": parent,
    "random, one draw": random_children(parent, parent_id, np.random.default_rng(4)),
    "random, another": random_children(parent, parent_id, np.random.default_rng(7)),
    "longest axis": principal_axis_children(parent, parent_id, rng),
}
close_up = Camera(np.eye(3), np.zeros(3), 90.0, 90.0, 48.0, 36.0, 96, 72)


def draw_outlines(axes, tape):
    """Draw the visible Gaussians' ellipses of one standard deviation."""
    projection = tape.projection
    covariances2d = np.linalg.inv(projection.conics[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    variances, directions = np.linalg.eigh(covariances2d)  # [N, 2], [N, 2, 2]
    angles = np.degrees(np.arctan2(directions[:, 1, 0], directions[:, 0, 0]))
    sizes = 2 * np.sqrt(variances)
    outline = EllipseCollection(
        sizes[:, 0], sizes[:, 1], angles, units="xy", offsets=projection.means2d - 0.5, offset_transform=axes.transData
    )
    outline.set(facecolor="none", edgecolor="white", linewidth=1)
    axes.add_collection(outline)


figure, axes = plt.subplots(2, 4, figsize=(12, 4.6))
errors = {}
for column, (title, gaussians) in enumerate(forms.items()):
    output, tape = render(gaussians, close_up)
    if column == 0:
        parent_image = output.image
    errors[title] = float(np.abs(output.image - parent_image).mean())
    show(axes[0, column], output.image, title)
    draw_outlines(axes[0, column], tape)
    if column:
        difference = (output.image - parent_image).mean(axis=2)
        title = f"change, mean {errors[title]:.3f}"
        shown = show(axes[1, column], difference, title, cmap="RdBu_r", vmin=-0.5, vmax=0.5)
figure.colorbar(shown, ax=axes[1, 1:], shrink=0.9)
steps = np.linspace(-3.2, 3.2, 400)


def density(centres, deviations):
    """Even mixture of one-dimensional Gaussians at ``steps``."""
    z = (steps[:, None] - np.asarray(centres)) / deviations
    return (np.exp(-(z**2) / 2) / (deviations * np.sqrt(2 * np.pi))).mean(axis=1)


offset, deviation = np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi)
axes[1, 0].plot(steps, density([0], 1.0), color="black", label="parent")
axes[1, 0].plot(steps, density([-offset, offset], deviation), color=BLUE, label="longest axis")
for seed in range(12):
    draw = np.random.default_rng(seed).standard_normal(2)
    label = "random, 12 draws" if seed == 0 else ""
    axes[1, 0].plot(steps, density(draw, 1 / 1.6), color=RED, linewidth=0.4, label=label)
axes[1, 0].set(title="density along the longest axis", xlabel="standard deviations", ylim=(0, 0.85), yticks=[])
axes[1, 0].legend(frameon=False, fontsize=7, loc="upper left")
plt.show()

# %% [markdown]
# Mean and variance along the longest axis, in units of the parent's standard deviation and variance. A random pair has
# its centre 0.7 standard deviations off, and on average 0.89 of the variance: $1/1.6^2 = 0.39$ in each child and 0.5
# between the two.

# %%
many = Gaussians(*(np.repeat(field, 20_000, axis=0) for field in parent))


def moments(children):
    """Root mean square of the shift, and mean variance, of all pairs along the parent's longest axis."""
    longest = np.array([np.cos(0.4), np.sin(0.4), 0.0])
    along = ((children.means - parent.means) @ longest / 0.7).reshape(2, -1)  # [2, pairs]
    within = (np.exp(children.log_scales[:, 0]) / 0.7) ** 2  # the axes have not turned
    shift = along.mean(axis=0)
    return float(np.sqrt(np.mean(shift**2))), float(within.mean() + along.var(axis=0).mean())


of_random = moments(random_children(many, np.arange(20_000), np.random.default_rng(0)))
of_longest = moments(principal_axis_children(parent, parent_id, rng))
print("                shift   variance")
for name, (shift, variance) in {"random": of_random, "longest axis": of_longest}.items():
    print(f"{name:<14}{shift:>7.3f}{variance:>11.3f}")

# %% [markdown]
# ## One event, before and after
#
# `clone_and_split` takes the marked Gaussians as one more reason for a split. Here is the event on the trained room:

# %%
show_code(clone_and_split)

# %%
afterwards = {}
for name, draw_children in {"random": random_children, "longest axis": principal_axis_children}.items():
    edit = clone_and_split(
        before,
        np.zeros(len(before.means)),  # as if no gradient were large: blur split alone
        threshold=THRESHOLD,
        size_limit=SIZE_FRACTION * scene.extent,
        rng=np.random.default_rng(0),
        is_blurred=marked,
        draw_children=draw_children,
    )
    afterwards[name] = edit.gaussians

figure, axes = plt.subplots(2, 3, figsize=(10, 5))
image_before = render(before, camera, background=scene.background)[0].image
shades = 0.25 + 0.7 * np.random.default_rng(2).random((3 * len(before.means), 3))
agreement, n_leaders = {}, {}
for column, (title, gaussians) in enumerate({"before": before, **afterwards}.items()):
    image = render(gaussians, camera, background=scene.background)[0].image
    picture, stats = leaders(gaussians, camera, shades[: len(gaussians.means)])
    n_leaders[title] = np.count_nonzero(stats.dominant_count)
    agreement[title] = psnr(np.clip(image, 0, 1), np.clip(image_before, 0, 1))
    show(axes[0, column], image, "render before" if not column else f"{title}: {agreement[title]:.1f} dB from before")
    show(axes[1, column], picture, f"{n_leaders[title]} of {len(gaussians.means)} Gaussians lead somewhere here")
plt.show()

# %% [markdown]
# More Gaussians lead, so that patches are smaller on average. A single one can grow: where the split was along the line
# of sight, or has uncovered somebody else. Halves on the longest axis change the picture less than random children do,
# which leaves training less to repair.
#
# ## Train on, four ways
#
# From the same state: with and without blur split, and with either rule for children, which the split by gradients
# uses, too. `inside` is the PSNR of the held-out views at those pixels that were red above: where one Gaussian led at
# a large area and no gradient told.

# %%
ids = [render(before, v.camera, with_stats=True)[0].stats.dominant_ids for v in scene.test_views]
red_masks = [np.append(is_missed, False)[leader] for leader in ids]


def inside(gaussians):
    """Mean PSNR of the held-out views at the red pixels."""
    values = []
    for v, mask in zip(scene.test_views, red_masks, strict=True):
        image = render(gaussians, v.camera, background=scene.background)[0].image
        values.append(psnr(np.clip(image, 0, 1), v.image / 255, mask))
    return float(np.mean(values))


ways = {
    "gradient; random": (False, random_children),
    "gradient; longest axis": (False, principal_axis_children),
    "and blur; random": (True, random_children),
    "and blur; longest axis": (True, principal_axis_children),
}
curves, results, ends = {}, {}, {}
result_before, inside_before = evaluate(before, scene.test_views, background=scene.background), inside(before)
for name, (has_blur_split, draw_children) in ways.items():
    recipe = base._replace(
        iterations=ITERATIONS, events=density_control(FIRST_STOP - 1, STOP + 1, has_blur_split, draw_children)
    )
    curve = curves[name] = [(FIRST_STOP, len(before.means), result_before.psnr)]

    def on_step(report, curve=curve):
        """Measure every 25 iterations."""
        if report.step % 25 == 0:
            gaussians = report.state.gaussians
            result = evaluate(gaussians, scene.test_views, background=scene.background)
            curve.append((report.step, len(gaussians.means), result.psnr))

    ends[name] = train(scene, recipe, seed=0, state=copy.deepcopy(state), on_step=on_step).gaussians
    result = evaluate(ends[name], scene.test_views, background=scene.background)
    results[name] = (result.psnr, result.ssim, inside(ends[name]), len(ends[name].means))
print(f"{'':<26}PSNR (dB)   SSIM   inside (dB)   Gaussians")
for name, (quality, similarity, within, count) in results.items():
    print(f"{name:<26}{quality:>9.2f}{similarity:>7.3f}{within:>14.2f}{count:>12}")
values = f"{result_before.psnr:>9.2f}{result_before.ssim:>7.3f}{inside_before:>14.2f}{len(before.means):>12}"
print(f"{'before':<26}{values}")

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3))
styles = dict(zip(ways, ((RED, ":"), (BLUE, ":"), (RED, "-"), (BLUE, "-")), strict=True))
for name, (color, style) in styles.items():
    steps, counts, psnrs = np.array(curves[name]).T
    axes[0].plot(steps, psnrs, style, color=color, label=name)
    axes[1].plot(steps, counts, style, color=color, label=name)
axes[0].set(title="PSNR of the held-out views", ylabel="dB", xlabel="iteration")
axes[1].set(title="count", ylabel="Gaussians", xlabel="iteration", ylim=(0, None))
axes[0].legend(frameon=False, fontsize=7)
axes[2].barh(list(ways), [results[name][2] for name in ways], color=[styles[name][0] for name in ways])
for bar, name in zip(axes[2].patches, ways, strict=True):
    bar.set_alpha(1.0 if ways[name][0] else 0.5)
axes[2].axvline(inside_before, color="black", linewidth=0.8)
axes[2].set(title="PSNR inside the red area (line: before)", xlabel="dB", xlim=(inside_before - 1, None))
axes[2].invert_yaxis()
plt.show()

# %%
truth = held_out.image / 255
shown_ways = ("gradient; random", "and blur; random", "and blur; longest axis")
chosen = {"before": before, **{name: ends[name] for name in shown_ways}}
figure, axes = plt.subplots(2, 5, figsize=(13, 4.3))
show(axes[0, 0], truth, "photograph, held out")
show(axes[1, 0], np.where(red_masks[1][:, :, None], truth, 0.25 * truth), "the red area")
for column, (title, gaussians) in enumerate(chosen.items(), start=1):
    image = render(gaussians, held_out.camera, background=scene.background)[0].image
    show(axes[0, column], image, title)
    error = show(axes[1, column], np.abs(image - truth).mean(axis=2), "error", cmap="magma", vmin=0, vmax=0.3)
figure.colorbar(error, ax=axes[1, 1:], shrink=0.9)
plt.show()

# %% [markdown]
# With halves on the longest axis, blur split draws what was blurred, and the walls gain most. With random children it
# gains less in a run as short as this. The Gaussians that it takes are the largest of all; a child that lands a metre
# off hangs somewhere in the room, the wall behind it has a hole, and every event comes before the last one has healed.
# The released code draws at random and has thousands of iterations for the repair. The recipes of this package cut.
#
# It is a matter of thresholds, too. `minisplat-ref study split SCENE --out DIR` trains a whole recipe all four
# ways: on this room at 160 x 120 pixels, in 1500 iterations of `mini-splatting-d`, they end within 0.1 dB of each
# other. There the gradient's threshold is the published one, which in small images asks for a split nearly everywhere,
# and the area's adds hardly anybody.
#
# **To try:** lower `THRESHOLD` instead of adding blur split, until the counts are equal; set `AREA_FRACTION` to 2e-4;
# the scene `outdoor`, where the largest patch is the sky and no split helps it.
#
# ## What was shown

# %%
# The gradient sees the edge and hardly the texture.
assert pulls["an edge"] > 20 * pulls["a fine texture"]

# Some lead at large areas though no gradient asks for a split; each is replaced by two.
assert is_missed.sum() > 20
assert n_leaders["longest axis"] > n_leaders["before"]
assert all(len(gaussians.means) == len(before.means) + marked.sum() for gaussians in afterwards.values())

# Halves on the longest axis keep mean and variance; random pairs lose a tenth of it, and shift.
assert np.allclose(of_longest, (0.0, 1.0), atol=1e-12)
assert np.allclose(of_random, (np.sqrt(1 / 2), 1 / 1.6**2 + 1 / 2), atol=0.02)
assert errors["longest axis"] < min(errors["random, one draw"], errors["random, another"])
assert agreement["longest axis"] > agreement["random"]

# After training, blur split draws what was blurred, and with halves on the longest axis best.
for measure in (0, 1, 2):  # PSNR, SSIM, PSNR inside
    assert results["and blur; longest axis"][measure] > results["and blur; random"][measure]
    assert results["and blur; longest axis"][measure] > results["gradient; longest axis"][measure]
assert results["and blur; longest axis"][2] > inside_before + 1
print("all of the above holds")
