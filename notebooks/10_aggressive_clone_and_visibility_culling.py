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
# # 10 Aggressive clone and visibility culling
#
# Mini-Splatting2 wants many Gaussians early, and does not want to pay for all of them in every view. Two ideas:
#
# - **aggressive clone**: the Gaussians that matter become two each, all at once. The copies share opacity and size, so
#   the picture hardly changes, and training can pull them apart afterwards;
# - **visibility culling**: each training view is rendered with only those Gaussians that carry 99 % of its blending
#   weight.
#
# The picture shows the first idea on one Gaussian. A plain copy in the same place makes it more opaque; two copies that
# share its opacity are still too wide; two that share opacity and scale look
# nearly like the original.

# %%
import copy
import time
from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREEN, GREY, RED, YELLOW, show, show_code, show_error
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import gaussian_splatting, get_recipe, mini_splatting2
from minisplat_ref.metrics import evaluate, psnr
from minisplat_ref.rendering import RenderSettings, render, render_vjp
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.strategy import aggressive_clone, visibility
from minisplat_ref.strategy.blur_split import principal_axis_children
from minisplat_ref.strategy.clone_split import screen_gradient_norms
from minisplat_ref.strategy.importance import collect_importance, indoor, mass_mask
from minisplat_ref.strategy.ops import Edit, concat
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import At, During, Every
from minisplat_ref.training.state import apply_edit

# %%
OPACITY = 0.9
x = np.linspace(-4, 4, 801)  # in scales of the original


def stacked(opacity, scale, n):
    """Alpha along a line through the centres of n equal Gaussians, one behind the other."""
    return 1 - (1 - opacity * np.exp(-0.5 * (x / scale) ** 2)) ** n


def copies(n, opacity=OPACITY):
    """Profile of n copies that share opacity and scale."""
    shared = aggressive_clone.shared_opacities(np.array([opacity]), n)[0]
    return stacked(shared, aggressive_clone.shared_scale_factors(np.array([opacity]), n)[0], n)


original = stacked(OPACITY, 1.0, 1)
shared = aggressive_clone.shared_opacities(np.array([OPACITY]), 2)[0]
profiles = {
    "two plain copies": stacked(OPACITY, 1.0, 2),
    "opacity shared": stacked(shared, 1.0, 2),
    "and scale": copies(2),
}

figure, axes = plt.subplots(1, 3, figsize=(11, 2.9))
axes[0].plot(x, original, color="black", label="one Gaussian")
for (name, profile), color in zip(profiles.items(), (RED, YELLOW, BLUE), strict=True):
    axes[0].plot(x, profile, "--", color=color, label=name)
axes[0].set(title=f"one Gaussian of opacity {OPACITY}, and two", ylabel="alpha", xlabel="position / scale")
axes[0].legend(frameon=False, fontsize=7)
for n, color in ((2, BLUE), (4, GREEN), (8, YELLOW)):
    axes[1].plot(x, copies(n) - original, color=color, label=f"{n} copies")
axes[1].set(title="what the copies change", xlabel="position / scale", ylabel="alpha")
axes[1].legend(frameon=False, fontsize=7)
opacities = np.linspace(0, 0.99, 200)
for n, color in ((2, BLUE), (4, GREEN), (8, YELLOW)):
    axes[2].plot(opacities, aggressive_clone.shared_scale_factors(opacities, n), color=color, label=f"{n} copies: s'/s")
    axes[2].plot(opacities, aggressive_clone.shared_opacities(opacities, n), ":", color=color, label=f"{n} copies: o'")
axes[2].set(title="what each copy receives", xlabel="opacity", ylim=(0, 1.05))
axes[2].legend(frameon=False, fontsize=7, ncols=2, loc=(0.02, 0.45))
plt.show()
areas = {
    name: np.trapezoid(profile, x) for name, profile in {"one": original, **profiles, "8 copies": copies(8)}.items()
}
for name, area in areas.items():
    print(f"{name:<18} integral {area:.4f}")

# %% [markdown]
# | file | what it holds | where in the paper |
# |---|---|---|
# | `minisplat_ref/strategy/aggressive_clone.py` | which Gaussians are critical; how copies share | MS2, densification |
# | `minisplat_ref/strategy/visibility.py` | gradients under culling, the culled fraction | MS2, culling |
# | `minisplat_ref/strategy/importance.py` | blending weights over all training views | MS sec. 3.2 |
#
# *MS* is Mini-Splatting, *MS2* Mini-Splatting2, both Fang and Wang 2024. **Frames and units:** the world is in metres;
# image coordinates are pixels. $o$ is the opacity of a Gaussian, $s$ its scale, $w = \alpha T$ its blending weight at a
# pixel.
#
# ## Two for one
#
# Two plain copies of opacity 0.9 let 0.01 of the light through, where one lets 0.1 through. So the $N$ copies share the
# opacity,
#
# $$o' = 1 - (1 - o)^{1/N},$$
#
# and composite to $o$ at the centre. Away from it they are still too wide: where a Gaussian has fallen to a small part
# $E$ of its opacity, the copies add up to $N o' E$, which is more than $o E$. The scale shrinks until the integral of
# alpha along a line through the centre is what it was:
#
# $$s' = s\,o \Big/ \sum_{k=1}^{N} \binom{N}{k} \frac{(-1)^{k+1}\,o'^{\,k}}{\sqrt k}$$
#
# (the rule by which 3DGS-MCMC relocates Gaussians).

# %%
show_code(aggressive_clone.clone)

# %% [markdown]
# ## A scene
#
# The scene is a room with 500 points, trained for 300 iterations with density control by gradients. One rendering of
# each training view, without any gradient, gives the blending weights of every Gaussian:

# %% tags=["rounding"]
START, STOP, ITERATIONS = 300, 450, 600
scene = make_scene("room", n_views=16, width=128, height=96, n_points=500, seed=0).scene
base = get_recipe("3dgs-accel", 1000)._replace(sh_milestones=())


def density_control(start, stop):
    """Events every 50 iterations; the threshold suits small images, the children are those of notebook 07."""
    densify = partial(
        gaussian_splatting.clone_and_split, threshold=1e-3, size_fraction=0.01, draw_children=principal_axis_children
    )
    return (
        During(gaussian_splatting.collect_gradients, start, stop),
        Every(50, densify, start, stop),
        Every(50, partial(gaussian_splatting.prune_faint, min_opacity=0.005), start, stop),
    )


state = train(scene, base._replace(iterations=START, events=density_control(0, START - 10)), seed=0)
gaussians = state.gaussians
cameras = [view.camera for view in scene.train_views]
stats = collect_importance(gaussians, scene.train_views)
n = len(gaussians.means)
print(f"{n} Gaussians, {len(cameras)} training views")

# %% [markdown]
# ## Which Gaussians are critical
#
# The paper describes a threshold on the largest blending weight, at its 0.99 quantile: one Gaussian in a hundred. The
# released code takes those that dominate some pixel and together carry 0.99 of the sum of all blending weights. Both
# contain 0.99, and they differ a lot:

# %% tags=["rounding"]
show_code(aggressive_clone.critical_by_mass)
show_code(aggressive_clone.critical_by_weight)
critical = {
    "code: mass": aggressive_clone.critical_by_mass(stats),
    "paper: rank": aggressive_clone.critical_by_weight(stats),
}
view = scene.train_views[3]
options = {"background": scene.background}
everything = render(gaussians, view.camera, **options)[0].image

figure, axes = plt.subplots(1, 4, figsize=(11, 2.5), width_ratios=(1.2, 1, 1, 1))
importance = np.sort(indoor(stats))[::-1]
axes[0].plot(np.arange(1, n + 1) / n, np.cumsum(importance) / importance.sum(), color="black")
for (name, mask), color in zip(critical.items(), (BLUE, RED), strict=True):
    share = indoor(stats)[mask].sum() / indoor(stats).sum()
    axes[0].plot(mask.mean(), share, "o", color=color, label=f"{name}, {mask.sum()} of {n}")
axes[0].set(xlabel="part of the Gaussians, heaviest first", ylabel="part of the weight", title="weight carried")
axes[0].legend(frameon=False, fontsize=7)
show(axes[1], everything, "all Gaussians")
for panel, (name, mask) in zip(axes[2:], critical.items(), strict=True):
    show(panel, render(gaussians, view.camera, is_visible=mask, **options)[0].image, f"only {name}")
plt.show()

# %% [markdown]
# The point of the released code lies below the curve because a Gaussian that dominates no pixel is not critical,
# however much it carries. Its critical Gaussians alone still show the room; those of the paper's rule are a few bright
# spots.
#
# ## The event, before and after
#
# Here the critical Gaussians by mass are doubled: by plain copies, and by copies that share.


# %% tags=["rounding"]
def plain_copies(gaussians, mask):
    """Double the chosen rows as they are."""
    chosen = gaussians._make(field[mask] for field in gaussians)
    ids = np.concatenate([np.arange(len(mask)), np.flatnonzero(mask)])
    return Edit(concat(gaussians, chosen), ids, np.arange(len(ids)) >= len(mask))


is_critical = critical["code: mass"]
doubled = {
    "before": gaussians,
    "plain copies": plain_copies(gaussians, is_critical).gaussians,
    "copies that share": aggressive_clone.clone(gaussians, is_critical).gaussians,
}
quality = {name: evaluate(g, scene.train_views, RenderSettings(scene.background)).psnr for name, g in doubled.items()}

figure, axes = plt.subplots(1, 5, figsize=(11, 2.1))
for panel, (name, g) in zip(axes[:3], doubled.items(), strict=True):
    image = render(g, view.camera, **options)[0].image
    show(panel, image, f"{name}: {len(g.means)}")
    if name != "before":
        panel = axes[3 if name == "plain copies" else 4]
        change = show_error(panel, image, everything, f"change: {name}", vmax=0.2)
figure.colorbar(change, ax=axes[3:], shrink=0.7)
plt.show()
for name, value in quality.items():
    print(f"{name:<18} PSNR of the training views {value:.2f} dB, {len(doubled[name].means)} Gaussians")

# %% [markdown]
# Sharing is exact for a single Gaussian along a line through its centre. Where Gaussians overlap, the copies are sorted
# among the others, and along other lines the integral is not quite preserved. The remaining change comes from that.
#
# ## Which Gaussians are visible in a view
#
# In one view, sort the Gaussians by the sum of their weights. The heaviest ones that together carry 0.99 of the view's
# weight are *visible* there. The training state holds the table for all views:

# %% tags=["rounding"]
show_code(mass_mask)
COLUMN = 3
is_visible = stats.is_visible  # [N, V]
output, tape = render(gaussians, view.camera, with_stats=True, **options)
culled_output, culled_tape = render(gaussians, view.camera, is_visible=is_visible[:, COLUMN], **options)
weights = np.sort(output.stats.blend_weight_sum)[::-1]
n_seen, n_visible = np.count_nonzero(tape.projection.radii[:, 0]), np.count_nonzero(is_visible[:, COLUMN])

figure, axes = plt.subplots(1, 4, figsize=(11, 2.5), width_ratios=(1.2, 1, 1, 1.15))
carried = np.cumsum(weights) / weights.sum()
axes[0].plot(np.arange(1, n + 1), carried, color="black")
axes[0].axvline(n_visible, color=BLUE, label=f"{n_visible} carry 0.99")
axes[0].axvline(n_seen, color=RED, linestyle="--", label=f"{n_seen} touch the image")
axes[0].set(title="weight of the heaviest", xlabel="Gaussians", ylim=(0, 1.05))
axes[0].legend(frameon=False, fontsize=7, loc=(0.2, 0.3))
show(axes[1], output.image, f"all: {n_seen}")
show(axes[2], culled_output.image, f"the visible: {n_visible}")
change = show_error(axes[3], culled_output.image, output.image, "change", vmax=0.2)
figure.colorbar(change, ax=axes[3], shrink=0.8)
plt.show()

# %% [markdown]
# Here are all views at once. Left: one row for each Gaussian, those visible in most views on top. Middle: what is left
# of each view. Right: in how many views a Gaussian is visible.

# %% tags=["rounding"]
in_frustum = np.column_stack([render(gaussians, c)[1].projection.radii[:, 0] > 0 for c in cameras])  # [N, V]
order = np.lexsort((in_frustum.sum(axis=1), is_visible.sum(axis=1)))[::-1]
colors = np.array([[1.0, 1.0, 1.0], [0.82, 0.29, 0.25], [0.21, 0.38, 0.55]])
figure, axes = plt.subplots(1, 3, figsize=(11, 3))
axes[0].imshow(colors[in_frustum.astype(int) + is_visible][order], aspect="auto", interpolation="nearest")
axes[0].set(title="outside (white), culled, visible", xlabel="training view", ylabel="Gaussian")
positions = np.arange(len(cameras))
axes[1].bar(positions, in_frustum.sum(axis=0), color=RED, label="culled")
axes[1].bar(positions, is_visible.sum(axis=0), color=BLUE, label="visible")
axes[1].axhline(n, color="black", linewidth=0.8)
axes[1].set(title="Gaussians in each view (line: all)", xlabel="training view")
axes[1].set(ylim=(0, 1.25 * n))
axes[1].legend(frameon=False, fontsize=7, loc="upper right", ncols=2)
n_views = is_visible.sum(axis=1)
axes[2].hist(n_views, bins=np.arange(-0.5, len(cameras) + 1.5), color=BLUE)
axes[2].set(title="views per Gaussian", xlabel="views where it is visible", ylabel="Gaussians")
plt.show()
fraction = visibility.culled_fraction(is_visible, stats.frustum_count)
few = visibility.find_seen_by_few(is_visible, 2)
print(f"culling removes {fraction:.0%} of the (Gaussian, view) pairs that the frustum leaves")
print(f"{few.sum()} of {n} Gaussians are visible in fewer than two views; the event removes them")

# %% [markdown]
# ## What culling saves, and what it costs
#
# The times depend on the machine and on what else it does; iterations with and without culling alternate. What is
# culled is small and faint, so it is a smaller share of the work than of the Gaussians.

# %% tags=["clock"]
targets = [np.multiply(v.image, np.float32(1 / 255), dtype=np.float32) for v in scene.train_views]
columns = {"without": [None] * len(cameras), "with": list(is_visible.T)}


def one_pass(v, column):
    """Rendering, loss and all gradients of training view v."""
    output, tape = render(gaussians, cameras[v], is_visible=column, **options)
    _, loss_tape = CPU.photometric_loss(output.image, targets[v], 0.2, None)
    return output, tape, render_vjp(tape, CPU.photometric_loss_vjp(loss_tape))


seconds, pairs, psnrs, gradients = ({kind: [] for kind in columns} for _ in range(4))
for v in range(len(cameras)):
    for kind, column in columns.items():
        output, tape, gradient = one_pass(v, column[v])
        pairs[kind].append(len(tape.splats.bins.gaussian_ids))
        psnrs[kind].append(psnr(np.clip(output.image, 0, 1), targets[v]))
        gradients[kind].append(screen_gradient_norms(gradient.means2d, view.camera.width, view.camera.height))
for v in np.tile(np.arange(len(cameras)), 3):
    for kind in list(columns)[:: 1 if v % 2 else -1]:
        start = time.perf_counter()
        one_pass(v, columns[kind][v])
        seconds[kind].append(time.perf_counter() - start)
medians = {kind: 1e3 * float(np.median(values)) for kind, values in seconds.items()}
print(f"{'':<9}(Gaussian, tile) pairs   median ms   PSNR of the training views")
for kind in columns:
    print(f"{kind:<9}{np.sum(pairs[kind]):>23}{medians[kind]:>12.1f}{np.mean(psnrs[kind]):>20.2f} dB")
saved = 1 - np.sum(pairs["with"]) / np.sum(pairs["without"])
print(f"{fraction:.0%} of the Gaussians are culled, which takes {saved:.0%} of the pairs")

# %% [markdown]
# ## Gradients under culling
#
# Density control compares the *mean* gradient, over the views that see a Gaussian, with a threshold. Culling leaves out
# the views in which the Gaussian hardly counts and its gradient is small, so the mean rises, and too many Gaussians
# would be split. The released code multiplies by $f = n_\text{visible} / (n_\text{frustum} + 0.1)$, as if the gradient
# were zero in the views left out. The paper does not mention it.

# %% tags=["rounding"]
show_code(visibility.gradient_factors)
sums = {kind: np.sum(gradients[kind], axis=0) for kind in columns}  # [N]
is_compared = (n_views > 0) & (sums["without"] > 0)
mean_without = sums["without"][is_compared] / stats.frustum_count[is_compared]
mean_with = sums["with"][is_compared] / n_views[is_compared]
mean_corrected = mean_with * visibility.gradient_factors(is_visible, stats.frustum_count)[is_compared]

figure, axes = plt.subplots(1, 3, figsize=(11, 3), width_ratios=(1, 1, 1.2))
for panel, mean, title in ((axes[0], mean_with, "culled"), (axes[1], mean_corrected, "culled, times f")):
    panel.loglog(mean_without, mean, ".", color=BLUE, markersize=2)
    panel.plot([1e-6, 1e-1], [1e-6, 1e-1], color="black", linewidth=0.8)
    panel.set(title=title, xlabel="mean gradient without culling", ylabel="mean gradient", xlim=(1e-6, 1e-1))
    panel.set(ylim=(1e-6, 1e-1))
ratios = {"culled": mean_with / mean_without, "culled, times f": mean_corrected / mean_without}
for (name, ratio), color in zip(ratios.items(), (RED, BLUE), strict=True):
    axes[2].hist(np.log2(ratio), bins=np.linspace(-2, 4, 61), color=color, alpha=0.6, label=name)
axes[2].axvline(0, color="black", linewidth=0.8)
axes[2].set(title="ratio to the mean without culling", xlabel="log2", ylabel="Gaussians")
axes[2].legend(frameon=False, fontsize=7)
plt.show()
for name, ratio in ratios.items():
    print(f"{name:<16} median ratio {np.median(ratio):.2f}, 0.9 quantile {np.quantile(ratio, 0.9):.2f}")

# %% [markdown]
# ## Train on, three ways
#
# Training continues from the same state in three ways: with density control by gradients alone, with two events of
# plain copies added, and with two aggressive clones added. An aggressive clone removes, clones and culls:

# %% tags=["rounding"]
show_code(mini_splatting2.aggressive_clone)


def copy_plainly(state, iteration):
    """An event: double the critical Gaussians as they are."""
    found = collect_importance(state.gaussians, scene.train_views)
    apply_edit(state, plain_copies(state.gaussians, aggressive_clone.critical_by_mass(found)))
    for name in ("gradient_sum", "view_count"):
        state.stats.pop(name, None)


cloning = partial(
    mini_splatting2.aggressive_clone,
    critical=aggressive_clone.critical_by_mass,
    factor=2,
    tail_mass=0.999,
    min_views=2,
)
CLONE_STEPS = (325, 425)
ways = {
    "gradients": (),
    "and plain copies": tuple(At(step, copy_plainly) for step in CLONE_STEPS),
    "and aggressive clones": tuple(At(step, cloning) for step in CLONE_STEPS),
}
curves, ends = {}, {}
for name, more_events in ways.items():
    recipe = base._replace(iterations=ITERATIONS, events=(*density_control(START - 1, STOP + 1), *more_events))
    start_result = evaluate(gaussians, scene.test_views, RenderSettings(scene.background))
    curve = curves[name] = [(START, n, start_result.psnr)]

    def on_step(report, curve=curve):
        """Measure every 25 iterations, just after events."""
        if report.step % 25 == 0:
            result = evaluate(report.state.gaussians, scene.test_views, RenderSettings(scene.background))
            curve.append((report.step, len(report.state.gaussians.means), result.psnr))

    ends[name] = train(scene, recipe, seed=0, state=copy.deepcopy(state), on_step=on_step)

figure, axes = plt.subplots(1, 2, figsize=(10, 3))
for (name, curve), color in zip(curves.items(), (GREY, RED, BLUE), strict=True):
    steps, counts, values = np.array(curve).T
    axes[0].plot(steps, counts, color=color, label=name)
    axes[1].plot(steps, values, color=color, label=name)
axes[0].set(title="count", xlabel="iteration", ylabel="Gaussians", ylim=(0, None))
axes[1].set(title="PSNR of the held-out views", xlabel="iteration", ylabel="dB")
axes[0].legend(frameon=False, fontsize=7)
plt.show()

# %% tags=["rounding"]
held_out = scene.test_views[1]
truth = held_out.image / 255
figure, axes = plt.subplots(2, 4, figsize=(10.5, 4.2))
show(axes[0, 0], truth, "photograph, held out")
show(axes[1, 0], render(gaussians, held_out.camera, **options)[0].image, f"before: {n}")
results = {}
for column, (name, end) in enumerate(ends.items(), start=1):
    image = render(end.gaussians, held_out.camera, **options)[0].image
    results[name] = evaluate(end.gaussians, scene.test_views, RenderSettings(scene.background))
    show(axes[0, column], image, f"{name}: {len(end.gaussians.means)}")
    error = show_error(axes[1, column], image, truth)
figure.colorbar(error, ax=axes[1, 1:], shrink=0.9)
plt.show()
for name, result in results.items():
    print(f"{name:<26} PSNR {result.psnr:.2f} dB, SSIM {result.ssim:.3f}, {len(ends[name].gaussians.means)} Gaussians")

# %% [markdown]
# The clones come without the drop in PSNR that plain copies cause. But more is not better yet: with nearly twice as
# many Gaussians the picture is worse than with gradients alone. To see why, here is one event at the start and then
# nothing but gradient steps: how far apart are the two copies?

# %% tags=["rounding"]
alone = base._replace(iterations=ITERATIONS, events=(At(START + 1, cloning),))
pairs_state = copy.deepcopy(state)
pairs_state.stats = {"origin": np.arange(n)}  # follows the rows through every edit
distances = {}


def on_step(report):
    """Note the distance of the copies in units of their mean scale."""
    if report.step - START in (25, 100, ITERATIONS - START):
        g, origins = report.state.gaussians, report.state.stats["origin"]
        first_rows = np.zeros(n, int)
        first_rows[origins[::-1]] = np.arange(len(origins))[::-1]
        copy_rows = np.flatnonzero(first_rows[origins] != np.arange(len(origins)))
        first_rows = first_rows[origins[copy_rows]]
        apart = np.linalg.norm(g.means[copy_rows] - g.means[first_rows], axis=1)
        distances[report.step - START] = apart / np.exp(g.log_scales[first_rows].mean(axis=1))


train(scene, alone, seed=0, state=pairs_state, on_step=on_step)
figure, axes = plt.subplots(figsize=(6, 2.6))
for (count, values), color in zip(distances.items(), (YELLOW, GREEN, BLUE), strict=True):
    label = f"after {count} iterations, median {np.median(values):.2f}"
    axes.hist(
        np.log10(np.maximum(values, 1e-4)), bins=np.linspace(-3, 1.5, 60), histtype="step", color=color, label=label
    )
axes.set(title="distance of two copies / their scale", xlabel="log10", ylabel="pairs")
axes.legend(frameon=False, fontsize=7, loc="upper left")
plt.show()

# %% [markdown]
# Halves of a split start 1.6 scales apart. Copies in one place receive the same gradients, and only Adam's moments,
# which the copy does not inherit, tell them apart. Mini-Splatting2 does not wait for them: after a ninth of the
# training it draws as many new points from the depth of the views as there are Gaussians by then (notebook 08), and for
# that the number counts.
#
# ## Play
#
# Clone and cull with numbers of your own. What to look for:
#
# * `factor`: with 4 or 8 copies, how much does the picture change, and how many Gaussians does it cost?
# * `mass`: with 0.9 instead of 0.99, which parts of the picture go first?
# * `critical_rule`: the paper's `aggressive_clone.critical_by_weight` doubles very few.
#
# `python -m data_tools.claims culling SCENE --out DIR` measures fraction, time and PSNR on any scene.

# %% tags=["rounding"]
factor, mass, critical_rule = 4, 0.9, aggressive_clone.critical_by_mass

cloned = aggressive_clone.clone(gaussians, critical_rule(stats), factor=factor).gaussians
heavy = mass_mask(render(gaussians, view.camera, with_stats=True, **options)[0].stats.blend_weight_sum, mass)
images = {
    f"all: {n}": everything,
    f"{factor} copies: {len(cloned.means)}": render(cloned, view.camera, **options)[0].image,
    f"mass {mass:g}: {heavy.sum()}": render(gaussians, view.camera, is_visible=heavy, **options)[0].image,
}
figure, axes = plt.subplots(1, 3, figsize=(9, 2.5))
for panel, (title, image) in zip(axes, images.items(), strict=True):
    show(panel, image, title)
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Show that $N$ copies with $o' = 1 - (1 - o)^{1/N}$ composite to $o$ at their common centre. What is $o'$ for
# faint Gaussians?
#
# <details>
# <summary>Solution</summary>
#
# What $N$ copies let through is $(1 - o')^N = 1 - o$. For small $o$ it is $o' \approx o / N$: faint copies simply share
# alpha, and their scale need not shrink.
#
# ```python
# shared = aggressive_clone.shared_opacities(np.array([0.9, 1e-4]), 4)
# assert np.allclose(1 - (1 - shared) ** 4, [0.9, 1e-4]) and np.isclose(shared[1], 0.25e-4, rtol=1e-3)
# assert np.isclose(aggressive_clone.shared_scale_factors(np.array([1e-4]), 4)[0], 1, atol=1e-3)
# ```
#
# </details>
#
# **2.** Derive the sum in $s'$: integrate the alpha of $N$ copies, $1 - (1 - o' e^{-x^2 / 2 s'^2})^N$, along $x$.
#
# <details>
# <summary>Solution</summary>
#
# The binomial theorem gives $\sum_{k=1}^N \binom{N}{k} (-1)^{k+1} o'^k e^{-k x^2 / 2 s'^2}$, and each term integrates
# to $\sqrt{2\pi}\,s' / \sqrt k$. The original integrates to $\sqrt{2\pi}\,s\,o$. Setting both equal gives the formula.
#
# ```python
# from math import comb
#
# o = 1 - (1 - 0.9) ** (1 / 3)
# by_hand = 0.9 / sum(comb(3, k) * (-1) ** (k + 1) * o**k / np.sqrt(k) for k in (1, 2, 3))
# assert np.isclose(by_hand, aggressive_clone.shared_scale_factors(np.array([0.9]), 3)[0])
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# Copies that share preserve the integral of alpha, for any number; plain ones do not.
assert abs(areas["and scale"] - areas["one"]) < 1e-3 and abs(areas["8 copies"] - areas["one"]) < 1e-3
assert areas["two plain copies"] > 1.1 * areas["one"] and areas["opacity shared"] > areas["one"] + 0.05
assert np.isclose(profiles["and scale"][400], OPACITY)

# On the scene the picture hardly changes, far less than with plain copies.
assert abs(quality["before"] - quality["copies that share"]) < 0.3 * (quality["before"] - quality["plain copies"])

# Critical by mass is a large part, by rank one in a hundred and those that tie.
assert critical["code: mass"].mean() > 0.2 > 5 * critical["paper: rank"].mean()

# The table agrees with the renderer: nothing is visible outside the frustum, and the fraction counts the red cells.
assert not (is_visible & ~in_frustum).any() and np.array_equal(in_frustum.sum(axis=1), stats.frustum_count)
assert np.isclose(fraction, np.sum(in_frustum & ~is_visible) / np.sum(in_frustum)) and 0.05 < fraction < 0.9
assert n_visible == np.count_nonzero(culled_tape.projection.radii[:, 0])

# Culling saves work and changes the picture little.
assert 0 < saved < fraction
assert abs(np.mean(psnrs["with"]) - np.mean(psnrs["without"])) < 0.5

# Culling raises mean gradients, and the factor brings them back near to what they were.
assert np.median(ratios["culled"]) > 1
assert abs(np.log(np.median(ratios["culled, times f"]))) < abs(np.log(np.median(ratios["culled"])))

# The clones come without the drop of plain copies, and with more Gaussians than gradients ask for.
after_event = {
    name: next(value for step, _, value in curve if step == CLONE_STEPS[0]) for name, curve in curves.items()
}
gradients_alone, plain, shared_copies = ways
assert after_event[shared_copies] > after_event[plain] + 0.2
assert len(ends[shared_copies].gaussians.means) > 1.3 * len(ends[gradients_alone].gaussians.means)
assert ends[shared_copies].stats["is_visible"].shape == (len(ends[shared_copies].gaussians.means), len(cameras))

# The copies have not moved far from each other.
assert np.median(distances[25]) < np.median(distances[ITERATIONS - START]) < 1.6
print("all of the above holds")
