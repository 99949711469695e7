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
# # 08 Depth reinitialisation
#
# Trained Gaussians crowd where gradients were large, and leave plain surfaces to few. Mini-Splatting now and then
# throws them all away and keeps only what they have learned about depth: every photograph gives a number of points on
# the surface, and training starts again from these. That needs an answer to a question which a cloud of blobs does not
# answer by itself: *where* is what a pixel shows?
#
# Below are three answers, seen from above: a camera at the bottom, an oblique wall made of one flat Gaussian, and in
# front of its right half a small half-transparent one. Each dot is the point that a ray is said to show. Later in the
# notebook: where all three fail, at the sky and on bare walls, and what guards against that.

# %%
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

from data_tools.claims.depth import (
    OFF_SURFACE,
    Choice,
    depth_errors,
    draw_points,
    errors,
)
from figures import BLUE, GREEN, GREY, RED, show, show_code
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.strategy.depth_reinit import (
    blend_points,
    centre_points,
    find_refuted,
    midpoint_points,
    reinitial_points,
)
from minisplat_ref.strategy.initialization import gaussians_from_points
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Camera, Gaussians, view_from

KINDS = {"mid-point": (midpoint_points, BLUE), "centre": (centre_points, GREEN), "blended": (blend_points, RED)}


# %%
SIZE = 48
toy_camera = Camera(np.eye(3), np.zeros(3), 48.0, 48.0, SIZE / 2, SIZE / 2, SIZE, SIZE)
TILT = np.radians(35.0)  # of the wall, about the camera's y axis
toy = Gaussians(
    means=np.array([[0.0, 0.0, 4.0], [0.34, 0.0, 1.5]]),
    quats=np.array([[np.cos(TILT / 2), 0.0, np.sin(TILT / 2), 0.0], [1.0, 0.0, 0.0, 0.0]]),
    log_scales=np.log([[1.2, 1.2, 0.02], [0.1, 0.1, 0.1]]),
    opacity_logits=np.array([6.0, -0.7]),
    sh_dc=np.zeros((2, 3)),
    sh_rest=np.zeros((2, 0, 3)),
)
toy_points = {name: points_of(toy, view_from(toy_camera), RenderSettings()) for name, (points_of, _) in KINDS.items()}

row = SIZE // 2
figure, axes = plt.subplots(1, 3, figsize=(10, 3.5), sharex=True, sharey=True)
for panel, (name, (_, color)) in zip(axes, KINDS.items(), strict=True):
    for mean, log_scales, angle in zip(toy.means, toy.log_scales, (-np.degrees(TILT), 0.0), strict=True):
        width, depth = 4 * np.exp(log_scales[[0, 2]])  # two standard deviations to each side
        panel.add_patch(Ellipse(mean[[0, 2]], width, depth, angle=angle, color=GREY, alpha=0.35, linewidth=0))
    points = toy_points[name].points[row]  # [W, 3]
    for x, _, z in points[points[:, 2] > 0][::2]:
        panel.plot([0, x], [0, z], color=GREY, linewidth=0.4)
        panel.plot(x, z, "o", color=color, markersize=4)
    panel.plot(0, 0, "k^", markersize=8)
    panel.set(title=name, xlabel="x [m]", xlim=(-2.4, 2.4), ylim=(-0.2, 5.9), aspect="equal")
axes[0].set_ylabel("z, away from the camera [m]")
plt.show()

# %% [markdown]
# ## Where is what a pixel shows?
#
# - **midpoint**: the densest point of the *dominant* Gaussian, the one with the largest blending weight $w = \alpha T$.
#   It is the middle of the ray's chord through the Gaussian, at $t = \dfrac{d^T \Sigma^{-1} (\mu - o)}{d^T \Sigma^{-1}
#   d}$ on the ray $o + t\,d$;
# - **centre**: the point of the ray at the depth of the dominant Gaussian's mean;
# - **blended**: the point of the ray at the blended depth $\sum w z / \sum w$.
#
# The midpoints follow the wall. The centres flatten it to one depth; with many small Gaussians that matters less. The
# blended depth lies between the wall and the Gaussian in front, where there is nothing. Where the front one is
# transparent, the other two stay on the wall, because it has the larger weight: their points always lie on *some*
# surface.
#
# | file | what it holds | where in the paper |
# |---|---|---|
# | `minisplat_ref/strategy/depth_reinit.py` | points of the pixels; which are drawn; safeguards | MS sec. 4.1, app. D |
# | `minisplat_ref/strategy/simplify.py` | `sample`: drawing without replacement | |
# | `data_tools/claims/depth.py` | the comparison below, larger, with several seeds | MS table 4 |
#
# *MS* is Mini-Splatting, Fang and Wang 2024; the safeguards are not in the paper. **Frames and units:** the world is in
# metres, z up; camera axes are x right, y down, z forward; a depth is the camera z.
#
# ## In a room
#
# Here are the same three answers on a small scene with a true depth for every pixel: 2,000 points as structure from
# motion would give them, and 250 iterations of training. So short a run has no time to recover from an opacity reset or
# to replace large Gaussians, so both are left out.

# %%
VIEW_SETTINGS = {"n_views": 14, "width": 96, "height": 72, "n_points": 2000, "seed": 0}
ITERATIONS, MORE_ITERATIONS = 250, 150
recipe = get_recipe("3dgs-accel", ITERATIONS)
LEFT_OUT = {"reset_opacity", "prune_large"}
recipe = recipe._replace(
    events=tuple(e for e in recipe.events if partial(e.action).func.__name__ not in LEFT_OUT), sh_milestones=()
)
truths = {name: make_scene(name, **VIEW_SETTINGS) for name in ("room", "outdoor", "plain-wall")}

# %% tags=["rounding"]
trained = {name: train(truth.scene, recipe, seed=0).gaussians for name, truth in truths.items()}
for name, gaussians in trained.items():
    result = evaluate(gaussians, truths[name].scene.test_views, RenderSettings(truths[name].scene.background))
    print(f"{name:<12}{len(gaussians.means):>6} Gaussians, held-out views {result.psnr:.1f} dB")


# %% tags=["rounding"]
def relative_errors(depths, true_depths):
    """Return |z - z true| / z true as a map; at the sky, which has no depth, 1."""
    return np.where(true_depths > 0, np.abs(depths - true_depths) / np.where(true_depths > 0, true_depths, 1), 1.0)


VIEW_ID = 4
room, room_truth = trained["room"], truths["room"]
view, true_depth = room_truth.scene.train_views[VIEW_ID], room_truth.train_depths[VIEW_ID]
farthest = true_depth.max()
figure, axes = plt.subplots(2, 4, figsize=(11, 4.4))
show(axes[0, 0], view.image / 255, "photograph")
show(axes[1, 0], true_depth, "true depth", cmap="viridis", vmin=0, vmax=farthest)
for k, (name, (points_of, _)) in enumerate(KINDS.items(), start=1):
    pixel_points = points_of(room, view, RenderSettings())
    shown_depth = show(axes[0, k], pixel_points.depths, name, cmap="viridis", vmin=0, vmax=farthest)
    error = relative_errors(pixel_points.depths, true_depth)
    shown_error = show(axes[1, k], error, f"error, median {np.median(error):.1%}", cmap="magma", vmin=0, vmax=0.3)
figure.colorbar(shown_depth, ax=axes[0, 3], label="m", shrink=0.9)
figure.colorbar(shown_error, ax=axes[1, 3], label="relative", shrink=0.9)
plt.show()

# %% [markdown]
# ## Which pixels
#
# Each view gives the same number of points. The paper says that pixels are drawn at random. The released code draws
# them with a probability proportional to the accumulated opacity $A = \sum w$, and so does this package. No pixel is
# drawn twice. The colour of a point is that of the photograph.

# %%
show_code(reinitial_points)

# %% [markdown]
# Here are the room's trained Gaussians and the new points, 3 % of all pixels. The trained centres crowd at edges. The
# points are spread evenly over everything that a camera saw:

# %% tags=["rounding"]
PAPER = Choice(midpoint_points)
POINTS_PER_PIXEL = 0.03


def drawn(name, choice):
    """Draw points with a fixed generator: points [P, 3], their pixels [P], colours [P, 3] in 0 .. 1."""
    scene = truths[name].scene
    n_points = round(POINTS_PER_PIXEL * sum(view.camera.width * view.camera.height for view in scene.train_views))
    points, pixels = draw_points(trained[name], scene, choice, np.random.default_rng(0), n_points)
    return points, pixels, np.concatenate([v.image.reshape(-1, 3) for v in scene.train_views])[pixels] / 255


def plan(axes, points, colors, title, size=3):
    """Draw points from above."""
    axes.scatter(points[:, 0], points[:, 1], s=size, c=colors, linewidths=0)
    axes.set(title=title, aspect="equal", xlabel="x [m]")


def train_from(gaussians, scene, iterations, rng):
    """Train in place, without events and without view-dependent colour."""
    recipe = get_recipe("3dgs-accel", iterations)._replace(events=(), sh_milestones=())
    train(scene, recipe, seed=0, state=TrainState(gaussians, zero_moments(gaussians), 0, [], rng, {}))


def scored(gaussians, name):
    """Return the mean PSNR of the held-out views, dB."""
    return evaluate(gaussians, truths[name].scene.test_views, RenderSettings(truths[name].scene.background)).psnr


points, pixels, colors = drawn("room", PAPER)
n_before, n_after = len(room.means), len(points)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharex=True, sharey=True)
plan(axes[0], room.means, np.clip(0.5 + SH_C0 * room.sh_dc, 0, 1), f"before: {n_before} trained centres")
plan(axes[1], points, colors, f"after: {n_after} points of the pixels")
low, high = room_truth.scene.points.min(axis=0) - 0.5, room_truth.scene.points.max(axis=0) + 0.5
axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), ylabel="y [m]")
for panel in axes:
    panel.set_facecolor("#dddddd")
plt.show()

# %% tags=["rounding"]
held_out = room_truth.scene.test_views[1]
learned = gaussians_from_points(points, np.round(255 * colors).astype(np.uint8), sh_degree=0)
figure, axes = plt.subplots(1, 4, figsize=(11, 2.2))
show(axes[0], held_out.image / 255, "a held-out photograph")
show(axes[1], render(room, held_out.camera)[0].image, "trained")
show(axes[2], render(learned, held_out.camera)[0].image, "started again")
psnr_trained, psnr_begun = scored(room, "room"), scored(learned, "room")
train_from(learned, room_truth.scene, MORE_ITERATIONS, np.random.default_rng(0))  # in place
psnr_learned = scored(learned, "room")
show(axes[3], render(learned, held_out.camera)[0].image, f"{MORE_ITERATIONS} iterations later")
plt.show()
print(f"trained {psnr_trained:.1f} dB, started again {psnr_begun:.1f} dB, then {psnr_learned:.1f} dB")

# %% [markdown]
# ## Where it fails
#
# Outdoors half of the picture is sky. It has no depth, but the photographs must be matched, so training has painted it
# onto Gaussians anywhere between the cameras and the horizon. They are as opaque as the ground, so their pixels are as
# likely to be drawn. On a bare wall every depth gives the same grey, and training keeps whichever depth explained the
# views first. A red point is off by more than 5 % of the depth, or hangs in the sky.


# %% tags=["rounding"]
def is_wrong(name, points, pixels):
    """Return which points [P] of these pixels are off the surface, or in front of the sky."""
    error, is_in_front = depth_errors(points, pixels, truths[name])
    return (error > OFF_SURFACE) | is_in_front


def elevation(axes, name, points, pixels, title):
    """Draw points from the side, wrong ones in red over the others, with the cameras."""
    wrong = is_wrong(name, points, pixels)
    for rows, color in ((~wrong, BLUE), (wrong, RED)):
        axes.scatter(points[rows, 0], points[rows, 2], s=2, color=color, linewidths=0)
    cameras = [v.camera for v in truths[name].scene.train_views]
    centres = np.array([c.center for c in cameras])
    axes.plot(centres[:, 0], centres[:, 2], "k^", markersize=4)
    axes.set(title=f"{title}\n{wrong.mean():.0%} of {len(points)} wrong", aspect="equal", xlabel="x [m]")


figure, axes = plt.subplots(2, 5, figsize=(11, 3.9), width_ratios=(1, 1, 1, 1, 1.7))
for line, name in zip(axes, ("outdoor", "plain-wall"), strict=True):
    view, true_depth = truths[name].scene.train_views[VIEW_ID], truths[name].train_depths[VIEW_ID]
    pixel_points = midpoint_points(trained[name], view, RenderSettings())
    farthest = np.quantile(true_depth[true_depth > 0], 0.9)
    show(line[0], view.image / 255, name)
    show(line[1], pixel_points.alpha, "opacity", cmap="gray", vmin=0, vmax=1)
    show(line[2], pixel_points.depths, "mid-point depth", cmap="viridis", vmin=0, vmax=farthest)
    error = relative_errors(pixel_points.depths, true_depth)
    show(line[3], error, "relative error", cmap="magma", vmin=0, vmax=0.3)
    points, pixels, _ = drawn(name, PAPER)
    elevation(line[4], name, points, pixels, "from the side")
    low, high = np.clip(np.quantile(points, (0.02, 0.98), axis=0), -5, 5)
    line[4].set(xlim=(low[0], high[0]), ylim=(min(low[2], -0.3), high[2]), ylabel="z [m]")
plt.show()

# %% [markdown]
# ## Safeguards
#
# There are three safeguards. The paper has none of them; the recipes use the second together with the third:
#
# - **a least accumulated opacity** (`min_alpha`): rays that are nearly empty are not drawn. This costs nothing, and
#   helps only as long as the sky is *not* painted yet;
# - **a vote of the other views** (`depth_tolerance`): up to 8 other views vote. A point is refuted if at least as many
#   see through it as have it on their own surface. A view that sees something nearer in that place has no vote;
# - **a backdrop** (`backdrop_distance`): a refuted point moves along its ray to behind the scene, so that there is
#   something left to paint the sky on.

# %%
show_code(find_refuted)

# %% tags=["rounding"]
GUARDED = {
    "paper": PAPER,
    "floor": Choice(midpoint_points, min_alpha=0.9),
    "vote": Choice(midpoint_points, depth_tolerance=0.05),
    "vote, backdrop": Choice(midpoint_points, depth_tolerance=0.05, has_backdrop=True),
    "blended": Choice(blend_points),
    "centre": Choice(centre_points),
}
figures_of = {}  # (scene, choice): what the true depths say
print(f"{'scene':<12}{'choice':<16}{'points':>7}{'median error':>14}{'off surface':>13}{'in the sky':>12}")
for name in truths:
    for choice, settings in GUARDED.items():
        points, pixels, _ = drawn(name, settings)
        told = figures_of[name, choice] = {"n": len(points), **errors(points, pixels, truths[name])}
        told["wrong"] = told["off_surface"] + told["in_front_of_sky"]
        cells = f"{told['median_error']:>14.1%}{told['off_surface']:>13.1%}{told['in_front_of_sky']:>12.1%}"
        print(f"{name:<12}{choice:<16}{told['n']:>7}{cells}")

# %% [markdown]
# In this table a point that the backdrop has moved away from a surface counts as off it. The least opacity changes next
# to nothing outdoors, because after training the sky is as opaque as the ground. The vote helps, but leaves many wrong
# points. Blended depth is the worst choice in every scene, as in the paper, where it costs ten decibels.

# %% tags=["rounding"]
figure, axes = plt.subplots(2, 3, figsize=(11, 4.8), sharex="row", sharey="row")
for line, name in zip(axes, ("outdoor", "plain-wall"), strict=True):
    for panel, choice in zip(line, ("paper", "vote", "vote, backdrop"), strict=True):
        points, pixels, _ = drawn(name, GUARDED[choice])
        elevation(panel, name, points, pixels, f"{name}, {choice}")
    points, _, _ = drawn(name, PAPER)
    low, high = np.clip(np.quantile(points, (0.02, 0.98), axis=0), -5, 5)
    line[0].set(xlim=(low[0], high[0]), ylim=(min(low[2], -0.3), high[2]), ylabel="z [m]")
plt.show()

# %% [markdown]
# Do better points give better pictures? Training from each set of points, without any event, says:

# %% tags=["rounding"]
after_psnrs = {}
print(f"{'scene':<12}" + "".join(f"{choice:>16}" for choice in ("trained", "paper", "vote", "vote, backdrop")))
for name in ("outdoor", "plain-wall"):
    for choice in ("paper", "vote", "vote, backdrop"):
        points, _, colors = drawn(name, GUARDED[choice])
        begun = gaussians_from_points(points, np.round(255 * colors).astype(np.uint8), sh_degree=0)
        train_from(begun, truths[name].scene, MORE_ITERATIONS, np.random.default_rng(0))
        after_psnrs[name, choice] = scored(begun, name)
    cells = "".join(f"{after_psnrs[name, choice]:>13.1f} dB" for choice in ("paper", "vote", "vote, backdrop"))
    print(f"{name:<12}{scored(trained[name], name):>13.1f} dB{cells}")

# %% [markdown]
# Not by themselves. Outdoors the vote removes points that hang in the sky, but the sky still has to be painted, and
# there is less left to paint it on: wrong points are useful. The backdrop gives something to paint on again, this time
# behind the scene and not in the middle of it. On the plain wall the three are within a decibel. In runs as short and
# small as these, one seed says little about a decibel or two; `python -m data_tools.claims depth outdoor --out DIR`
# trains the whole recipe at 160 x 120 with three seeds. The recipes use vote and backdrop.
#
# ## Play
#
# Choose a scene and the safeguards. What to look for:
#
# * `depth_tolerance`: at 0.01 views refute each other's noise, at 0.3 they agree with almost everything.
# * `min_alpha`: at 0.999, what happens outdoors, and what on the plain wall?
# * `name`: in the room the vote removes few points. Which?

# %% tags=["rounding"]
name = "outdoor"
my_choice = Choice(midpoint_points, min_alpha=0.0, depth_tolerance=0.02)

points, pixels, colors = drawn(name, my_choice)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.8))
elevation(axes[0], name, points, pixels, "yours")
low, high = np.clip(np.quantile(points, (0.02, 0.98), axis=0), -5, 5)
axes[0].set(xlim=(low[0], high[0]), ylim=(min(low[2], -0.3), high[2]), ylabel="z [m]")
plan(axes[1], points, colors, "from above")
axes[1].set(xlim=(-6, 6), ylim=(-6, 6), ylabel="y [m]", facecolor="#dddddd")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Derive the formula of the midpoint: along the ray $o + t\,d$, where is the density $e^{-\frac12 (x - \mu)^T
# \Sigma^{-1} (x - \mu)}$ largest?
#
# <details>
# <summary>Solution</summary>
#
# Set the derivative of the exponent with respect to $t$ to zero: $d^T \Sigma^{-1} (o + t\,d - \mu) = 0$, which is the
# formula. For a round Gaussian it is the foot of the perpendicular from $\mu$ to the ray.
#
# ```python
# rng = np.random.default_rng(0)
# root = rng.normal(size=(3, 3))
# inverse, (mean, origin, direction) = np.linalg.inv(root @ root.T), rng.normal(size=(3, 3))
# t = direction @ inverse @ (mean - origin) / (direction @ inverse @ direction)
# ts = t + np.linspace(-1, 1, 2001)
# offsets = origin + ts[:, None] * direction - mean
# exponents = np.einsum("ti,ij,tj->t", offsets, inverse, offsets)
# assert abs(ts[exponents.argmin()] - t) < 1e-3
# ```
#
# </details>
#
# **2.** Points are drawn with a probability proportional to the opacity of their rays. In a view whose left half has
# opacity 1 and whose right half has 0.25, which share of the points comes from the left half, if few are drawn?
#
# <details>
# <summary>Solution</summary>
#
# Four fifths: $1 / (1 + 0.25)$. Without replacement the share falls when many are drawn, because the left half runs
# out of pixels: if all pixels are drawn, it is one half.
#
# ```python
# alpha = np.repeat([1.0, 0.25], 5000)
# from minisplat_ref.strategy.simplify import sample
#
# few_ids = sample(alpha, 500, np.random.default_rng(0))
# many_ids = sample(alpha, 9500, np.random.default_rng(0))
# assert abs(np.mean(few_ids < 5000) - 0.8) < 0.06 and np.mean(many_ids < 5000) < 0.54
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# On an oblique wall: mid-points are on it, centres at the depth of its centre, blended points in front of it.
midpoints, centres, blended = (toy_points[name].points[row] for name in KINDS)  # [W, 3]
is_hit = midpoints[:, 2] > 0
offsets = (midpoints[is_hit] - toy.means[0]) @ [np.sin(TILT), 0.0, np.cos(TILT)]  # along the wall's normal
assert is_hit.sum() > SIZE / 2 and np.abs(offsets).max() < 0.02
assert np.abs(centres[is_hit, 2] - 4.0).max() < 1e-9
behind = round(toy_camera.fx * 0.34 / 1.5 + toy_camera.cx)  # column of the front Gaussian
assert 1.7 < blended[behind, 2] < midpoints[behind, 2] - 0.3

# Without a vote every view gives its full number of points, and training from them learns the room again.
assert all(figures_of[name, "paper"]["n"] == figures_of["room", "paper"]["n"] for name in truths)
assert psnr_learned > psnr_begun + 2

# Sky and bare walls: a large part of the points is wrong, and blended depth is even worse.
assert figures_of["outdoor", "paper"]["wrong"] > 0.3
assert figures_of["outdoor", "paper"]["in_front_of_sky"] > 0.1
assert all(figures_of[name, "blended"]["wrong"] > figures_of[name, "paper"]["wrong"] for name in truths)

# The vote makes fewer points wrong, but not few; with the backdrop, fewer hang in front of the sky.
for name in ("outdoor", "plain-wall"):
    assert figures_of[name, "paper"]["wrong"] > figures_of["room", "paper"]["wrong"]
    assert 0.1 < figures_of[name, "vote"]["wrong"] < figures_of[name, "paper"]["wrong"]
assert figures_of["outdoor", "vote, backdrop"]["in_front_of_sky"] < figures_of["outdoor", "paper"]["in_front_of_sky"]
print("all of the above holds")
