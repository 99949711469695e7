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
# # 09 Importance and simplification
#
# A trained scene has more Gaussians than its photographs need. Mini-Splatting asks how much each of them contributes,
# drops those that never dominate a pixel, and draws a few of the others at random, the important ones more often. This
# notebook follows one population from many to few, and compares sampling with plainer ways.
#
# We start with a dense population: four thousand points of a small room, with errors of 4 cm as those from structure
# from motion may have, trained for 250 iterations on 24 photographs. In the third picture each pixel has the colour of
# the Gaussian that dominates it; in the fourth it says how many pixels that Gaussian touches.

# %%
import itertools

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse
from scipy.spatial import cKDTree

from figures import BLUE, GREEN, GREY, RED, YELLOW, show, show_code, show_error
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import evaluate
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.strategy import importance, simplify
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Gaussians

# %% tags=["rounding"]
scene = make_scene("room", n_views=24, width=80, height=60, n_points=4000, point_noise=0.04, seed=0).scene
held_out = scene.test_views[1]
dense = train(scene, get_recipe("3dgs-accel", 250)._replace(events=()), seed=0).gaussians


def quality(gaussians):
    """PSNR of the views that training never sees, dB."""
    return evaluate(gaussians, scene.test_views, RenderSettings(scene.background)).psnr


output, tape = render(dense, held_out.camera, background=scene.background, with_stats=True)
shuffled = np.random.default_rng(0).uniform(0.15, 1, (len(dense.means), 3))  # a colour for each Gaussian
n_dominant_here = int(np.count_nonzero(output.stats.dominant_count))

figure, axes = plt.subplots(1, 4, figsize=(11, 2.4))
show(axes[0], held_out.image / 255, "photograph, held out")
show(axes[1], output.image, f"{len(dense.means):,} Gaussians: {quality(dense):.1f} dB")
show(axes[2], shuffled[output.stats.dominant_ids], f"dominant: {n_dominant_here:,} of them")
shown = show(axes[3], np.log10(1 + output.stats.hit_count[output.stats.dominant_ids]), "pixels that it touches")
bar = figure.colorbar(shown, ax=axes[3], shrink=0.9, ticks=np.log10([1, 10, 100, 1000]))
bar.ax.set_yticklabels([1, 10, 100, 1000])
plt.show()

# %% [markdown]
# | file | what it holds | where in the paper |
# |---|---|---|
# | `minisplat_ref/strategy/importance.py` | the weights of all views, added up | MS sec. 3.2, app. E |
# | `minisplat_ref/strategy/simplify.py` | sampling, rank, mass, merging; a new start | MS eq. 3 |
# | `minisplat_ref/methods/mini_splatting.py` | the same as events of a recipe | MS sec. 3.2 |
#
# *MS* is Mini-Splatting, Fang and Wang 2024. **Frames and units:** the world is in metres, z up; images are in pixels,
# the centre of the top-left one at (0.5, 0.5). The kernels are compiled on first use, which takes some twenty seconds
# once. How a population becomes dense is the subject of notebooks 07, 08 and 10; here its size stays as it is
# (`events=()`).
#
# ## Importance
#
# The compositor of notebook 03 blends a pixel from hits of weight $w = \alpha T$. Added up over the pixels $p$ of all
# training views $v$, they are the importance of Gaussian $i$ (MS eq. 12),
#
# $$I_i = \sum_v \sum_{p \in v} w_{ip} \quad\text{(indoor)}, \qquad
# I_i = \sum_{v:\, i \text{ dominates a pixel}} \frac{\sum_{p \in v} w_{ip}}{\#\{p \in v: i \text{ is hit}\}}
# \quad\text{(outdoor)},$$
#
# where *dominates* means: has the largest weight at that pixel. The second form divides by the number of pixels that
# the Gaussian touches: outdoors, a large Gaussian in the sky would otherwise count for more than all the leaves. Both
# come from one rendering of all training views, without gradients:

# %%
show_code(importance.collect_importance)

# %% tags=["rounding"]
stats = importance.collect_importance(dense, scene.train_views)
metrics = {"indoor": importance.indoor(stats), "outdoor": importance.outdoor(stats)}


def paint(colors):
    """Render the held-out view with a colour [N, 3] for each Gaussian."""
    sh_dc = ((np.asarray(colors)[:, :3] - 0.5) / SH_C0).astype(np.float32)
    painted = dense._replace(sh_dc=sh_dc, sh_rest=np.zeros((len(sh_dc), 0, 3), np.float32))
    return render(painted, held_out.camera)[0].image


def on_log_scale(values):
    """Colours [N, 3] from dark to light between the 5th and 95th percentile of the values above 0."""
    logs = np.log(np.maximum(values, values[values > 0].min()))
    low, high = np.percentile(logs[values > 0], [5, 95])
    return plt.get_cmap("magma")(np.clip((logs - low) / (high - low), 0, 1))


is_dominant = stats.dominant_count > 0
figure, axes = plt.subplots(1, 4, figsize=(11, 2.4))
show(axes[0], output.image, "render")
for panel, (name, values) in zip(axes[1:], metrics.items(), strict=False):
    show(panel, paint(on_log_scale(values)), f"importance, {name}")
show(axes[3], paint(np.where(is_dominant[:, None], (0.85, 0.85, 0.85), (0.82, 0.2, 0.15))), "red: never dominant")
plt.show()

# %% [markdown]
# (Light is high.) Importance is distributed unevenly: sorted by it, a part of the Gaussians carries nearly all of it.
# *Mass* is the share that the most important ones carry together. A threshold of 0.99 keeps many more Gaussians than
# one in a hundred.

# %% tags=["rounding"]
MASS = 0.99
indoor = metrics["indoor"]
figure, axes = plt.subplots(1, 2, figsize=(10, 3))
edges = np.linspace(*np.log10(np.percentile(indoor[indoor > 0], [0.5, 100])), 40)
for mask, color, label in ((is_dominant, BLUE, "dominates some pixel"), (~is_dominant, RED, "never dominant")):
    logs = np.log10(np.maximum(indoor[mask], 10 ** edges[0]))
    axes[0].hist(logs, edges, color=color, alpha=0.75, label=f"{label}: {mask.sum():,}")
axes[0].set(title="importance, indoor", xlabel="log10 of the sum of weights (pixels)", ylabel="Gaussians")
axes[0].legend(frameon=False)
for (name, values), color in zip(metrics.items(), (BLUE, GREEN), strict=True):
    carried = np.cumsum(np.sort(values)[::-1]) / values.sum()
    n_of_mass = int(importance.mass_mask(values, MASS).sum())
    axes[1].plot(np.arange(1, len(values) + 1), carried, color=color, label=f"{name}: {n_of_mass:,} carry {MASS:g}")
    axes[1].plot(n_of_mass, carried[n_of_mass - 1], "o", color=color)
axes[1].axhline(MASS, color=GREY, linewidth=0.8, linestyle=":")
axes[1].set(title="mass of the most important", xlabel="number of Gaussians", ylim=(0, 1.05))
axes[1].legend(frameon=False, loc="lower right")
plt.show()

# %% [markdown]
# ## Intersection preserving: drop what never dominates
#
# The ray through a pixel meets the surface at the Gaussian with the largest weight. A Gaussian that never has the
# largest weight, in any pixel of any training view, is buried or is spread thinly over many pixels; its importance is
# set to 0 (MS eq. 3). Seen from above, in a slice between ankle and head, the dominant ones outline walls and
# furniture. The others lie between them and crowd inside the furniture. Without them the picture is slightly worse.

# %% tags=["rounding"]
candidates = simplify.intersection_preserving(indoor, stats.dominant_count)
preserved = take(dense, candidates > 0)


def show_above(axes, means, color, title, size=3):
    """Scatter the centres between 0.2 and 1.8 m, seen from above."""
    is_inside = (means[:, 2] > 0.2) & (means[:, 2] < 1.8)
    axes.scatter(*means[is_inside, :2].T, s=size, color=color, linewidths=0)
    axes.set(title=title, aspect="equal", xlim=(-3.2, 3.2), ylim=(-3.2, 3.2), xlabel="x [m]")


figure, axes = plt.subplots(1, 4, figsize=(11, 2.8))
show_above(axes[0], dense.means[is_dominant], BLUE, f"{is_dominant.sum():,} dominate")
show_above(axes[1], dense.means[~is_dominant], RED, f"{(~is_dominant).sum():,} never do")
axes[0].set_ylabel("y [m]")
for panel, gaussians, label in ((axes[2], dense, "before"), (axes[3], preserved, "after")):
    image = render(gaussians, held_out.camera, background=scene.background)[0].image
    show(panel, image, f"{label}: {len(gaussians.means):,}, {quality(gaussians):.2f} dB")
plt.show()

# %% [markdown]
# ## Sampling
#
# $n$ Gaussians are drawn without replacement, with $P_i = I_i / \sum_j I_j$. Drawing one after the other is slow for a
# million. Adding Gumbel noise to $\log I_i$ and taking the $n$ largest has the same distribution.

# %%
show_code(simplify.sample)

# %% [markdown]
# To see it, take four rows of importance 4, 3, 2 and 1, of which two are drawn. Drawing one after the other gives a
# pair $\{a, b\}$ the probability $P_a P_b / (1 - P_a) + P_b P_a / (1 - P_b)$. Rank would always take the first pair. On
# the right is our population: the part of the Gaussians that is kept, from the least important to the most. Rank cuts.
# Sampling gives every candidate a chance, and does not keep all that are important.

# %% tags=["rounding"]
N_DRAWS, FRACTION = 4000, 0.2
rng = np.random.default_rng(0)
weights = np.array([4.0, 3.0, 2.0, 1.0])
p = weights / weights.sum()
pairs = list(itertools.combinations(range(4), 2))
expected = np.array([p[a] * p[b] / (1 - p[a]) + p[b] * p[a] / (1 - p[b]) for a, b in pairs])
drawn = [tuple(simplify.sample(weights, 2, rng).tolist()) for _ in range(N_DRAWS)]
shares = np.array([drawn.count(pair) for pair in pairs]) / N_DRAWS

n_kept = round(FRACTION * np.count_nonzero(candidates))
ranked = np.argsort(candidates, kind="stable")[-np.count_nonzero(candidates) :]  # ascending
n_bins = 24
figure, axes = plt.subplots(1, 2, figsize=(10, 2.8), width_ratios=(1, 1.4))
x = np.arange(len(pairs))
axes[0].bar(x - 0.2, expected, 0.38, color=GREY, label="one after the other, by hand")
axes[0].bar(x + 0.2, shares, 0.38, color=BLUE, label=f"{N_DRAWS:,} draws")
axes[0].set(title="pairs drawn", xticks=x, xticklabels=[f"{weights[a]:g}, {weights[b]:g}" for a, b in pairs])
axes[0].set(xlabel="their importance", ylabel="probability")
axes[0].legend(frameon=False)
for choose, color in ((simplify.by_sampling, BLUE), (simplify.by_rank, RED)):
    is_kept = np.zeros(len(candidates), bool)
    is_kept[choose(dense, candidates, n_kept, rng).parent_ids] = True
    kept_share = [part.mean() for part in np.array_split(is_kept[ranked], n_bins)]
    axes[1].step(np.arange(n_bins), kept_share, where="mid", color=color, label=choose.__name__.removeprefix("by_"))
axes[1].set(title=f"part that is kept of each {n_bins}th, {n_kept:,} in all", ylabel="kept", ylim=(-0.03, 1.03))
axes[1].set(xlabel="least important ... most important", xticks=[])
axes[1].legend(frameon=False)
plt.show()

# %% [markdown]
# ## Merging
#
# Instead of keeping one of two neighbours, both can be merged. The centre is their mean, weighted by importance, and
# the covariance is that of the two together: the weighted mean of their covariances plus that of the outer products of
# their offsets. Here are two discs of standard deviation 1, three units apart, of importance 2 and 1.

# %%
pair = Gaussians(
    means=np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]),
    quats=np.array([[1.0, 0.0, 0.0, 0.0]] * 2),
    log_scales=np.log([[1.0, 1.0, 0.1]] * 2),
    opacity_logits=np.zeros(2),
    sh_dc=np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]]),
    sh_rest=np.zeros((2, 0, 3)),
)
merged = simplify.merge_neighbours(pair, np.array([2.0, 1.0]), 1).gaussians
sigma = covariances(merged.quats, np.exp(merged.log_scales))[0]

figure, panel = plt.subplots(figsize=(5, 2.2))
for gaussians, style in ((pair, {"edgecolor": RED}), (merged, {"edgecolor": BLUE, "linewidth": 2})):
    for mean, part in zip(gaussians.means, covariances(gaussians.quats, np.exp(gaussians.log_scales)), strict=True):
        panel.add_patch(Ellipse(mean[:2], *2 * np.sqrt(np.diag(part)[:2]), fill=False, **style))
panel.plot(*pair.means[:, :2].T, "+", color=RED, label="two")
panel.plot(*merged.means[:, :2].T, "+", color=BLUE, label="merged")
panel.set(xlim=(-1.6, 5.6), ylim=(-1.5, 1.5), aspect="equal", title="ellipses of one standard deviation")
panel.legend(frameon=False, loc="right")
plt.show()
print(f"mean {merged.means[0]}, covariance along x {sigma[0, 0]:.3f} = 1 + 2/3 * 1^2 + 1/3 * 2^2")

# %% [markdown]
# ## A fifth of them, chosen in three ways
#
# All three keep the same number. (*Mass* is not a fourth way: it keeps what rank keeps, and only chooses the number.)
# Right after the cut the picture has holes where Gaussians are missing. Further training, the same for all three,
# closes the holes that have a Gaussian nearby. Rank keeps crowds where importance is high and leaves gaps that training
# cannot close. Sampling thins out evenly. Merging leaves no holes in the first place.

# %% tags=["rounding"]
FINE_TUNING = 120


def fine_tuned(gaussians):
    """Train on, all parameters and all views, nothing added or removed."""
    recipe = get_recipe("3dgs-accel", FINE_TUNING)._replace(events=(), sh_milestones=(0, 0, 0))
    gaussians = gaussians._make(field.copy() for field in gaussians)  # training works in place
    state = TrainState(gaussians, zero_moments(gaussians), 0, [], np.random.default_rng(0), {})
    return train(scene, recipe, seed=0, state=state).gaussians


CHOICES = {"sampling": simplify.by_sampling, "rank": simplify.by_rank, "merging": simplify.by_merging}
COLORS = dict(zip(CHOICES, (BLUE, RED, YELLOW), strict=True))
at_once = {name: choose(dense, candidates, n_kept, rng).gaussians for name, choose in CHOICES.items()}
after = {name: fine_tuned(gaussians) for name, gaussians in at_once.items()}

figure, axes = plt.subplots(3, 4, figsize=(9.5, 6.4))
images = {}
for column, (name, color) in enumerate(COLORS.items()):
    show_above(axes[0, column], at_once[name].means, color, f"{name}: {len(at_once[name].means):,}")
    for line, (gaussians, label) in enumerate(((at_once[name], "at once"), (after[name], "fine-tuned")), start=1):
        image = render(gaussians, held_out.camera, background=scene.background)[0].image
        show(axes[line, column], image, f"{label}: {quality(gaussians):.2f} dB")
show_above(axes[0, 3], dense.means, GREY, f"dense: {len(dense.means):,}")
show(axes[1, 3], output.image, f"dense: {quality(dense):.2f} dB")
show(axes[2, 3], held_out.image / 255, "photograph, held out")
plt.show()

# %% [markdown]
# Below is the quality against the number that is kept, and how well the kept centres cover the dense ones: the mean
# distance from each of the 4000 to the nearest kept one. That is one half of the Chamfer distance; the other half, from
# the kept to the dense, is 0 except for merging.

# %% tags=["rounding"]
fractions = np.array([0.05, 0.1, 0.2, 0.4, 0.7])
curves = {name: [] for name in CHOICES}
for name, choose in CHOICES.items():
    for fraction in fractions:
        kept = choose(dense, candidates, round(fraction * np.count_nonzero(candidates)), rng).gaussians
        gap = cKDTree(kept.means).query(dense.means)[0].mean()
        curves[name].append((len(kept.means), quality(kept), gap))

figure, axes = plt.subplots(1, 3, figsize=(11, 2.8), width_ratios=(1, 1, 0.9))
for name, color in COLORS.items():
    counts, psnrs, gaps = np.transpose(curves[name])
    axes[0].plot(counts, psnrs, "o-", color=color, ms=4, label=name)
    axes[1].plot(counts, 100 * gaps, "o-", color=color, ms=4)
axes[0].axhline(quality(dense), color=GREY, linestyle="--", linewidth=1, label="dense")
for panel in axes[:2]:
    panel.set(xlabel="Gaussians", xscale="log")
    panel.set_xticks(counts, [f"{n:g}" for n in counts])
    panel.minorticks_off()
axes[0].set(title="right after simplification", ylabel="PSNR (dB)")
axes[0].legend(frameon=False)
axes[1].set(title="from a dense centre to the nearest kept", ylabel="cm", ylim=(0, None))
for column, name in enumerate(CHOICES):
    values = quality(at_once[name]), quality(after[name])
    axes[2].bar([column - 0.2, column + 0.2], values, 0.38, color=(COLORS[name] + "70", COLORS[name]))
    axes[2].annotate(f"{values[1]:.2f}", (column + 0.2, values[1]), ha="center", va="bottom", fontsize=8)
axes[2].set(title="at once (pale), fine-tuned", xticks=range(3), xticklabels=CHOICES, ylabel="PSNR (dB)")
axes[2].set(ylim=(0, 1.15 * quality(dense)))
plt.show()

# %% [markdown]
# ## A new start
#
# Mini-Splatting keeps only the centres and the colours of those that it draws. Sizes and opacities were learned in a
# crowd. With four of five gone they are set as at the start of training, from the distance to the nearest three, and
# 15,000 iterations follow in which they are learned again. With as few iterations as here, the new start costs more
# than it gives.

# %% tags=["rounding"]
show_code(simplify.reinitialise)

restarted = simplify.reinitialise(at_once["sampling"], 3)
rows = {
    "drawn": at_once["sampling"],
    "drawn, new start": restarted,
    "drawn, fine-tuned": after["sampling"],
    "drawn, new start, fine-tuned": fine_tuned(restarted),
}
figure, axes = plt.subplots(1, 4, figsize=(11, 2.4))
for panel, (label, gaussians) in zip(axes, rows.items(), strict=True):
    image = render(gaussians, held_out.camera, background=scene.background)[0].image
    show(panel, image, f"{label}: {quality(gaussians):.2f} dB")
plt.show()

# %% [markdown]
# ## The tail
#
# Later in training a recipe prunes once more, to a mass of 0.99: it removes the least important, which together carry
# one part in a hundred. The picture hardly changes.

# %% tags=["rounding"]
few = after["sampling"]
few_stats = importance.collect_importance(few, scene.train_views)
few_candidates = simplify.intersection_preserving(importance.indoor(few_stats), few_stats.dominant_count)
heavy_ids = simplify.select_mass(few_candidates, MASS)
trimmed = take(few, heavy_ids)

figure, axes = plt.subplots(1, 3, figsize=(11, 2.9))
images = [render(gaussians, held_out.camera, background=scene.background)[0].image for gaussians in (few, trimmed)]
for panel, gaussians, image, label in zip(axes, (few, trimmed), images, ("before", "after"), strict=False):
    show(panel, image, f"{label}: {len(gaussians.means):,}, {quality(gaussians):.2f} dB")
shown = show_error(axes[2], *images, "difference", vmax=0.1)
figure.colorbar(shown, ax=axes[2], shrink=0.9)
plt.show()

# %% [markdown]
# ## Play
#
# Choose the fraction, the kind of importance and the way of choosing. What to look for:
#
# * `fraction`: at which fraction does the picture have no holes, right after the cut?
# * `metric`: with `"outdoor"`, which parts of the room become sparser?
# * `choose`: `simplify.by_sampling`, `simplify.by_rank` or `simplify.by_merging`.
#
# `python -m data_tools.claims simplify --help` draws the curves on any scene, with several seeds and after fine-tuning.

# %% tags=["rounding"]
fraction, metric, choose = 0.4, "outdoor", simplify.by_sampling

my_candidates = simplify.intersection_preserving(metrics[metric], stats.dominant_count)
n_mine = round(fraction * np.count_nonzero(my_candidates))
mine = choose(dense, my_candidates, n_mine, np.random.default_rng(0)).gaussians
figure, axes = plt.subplots(1, 3, figsize=(10, 2.7))
show_above(axes[0], mine.means, BLUE, f"{len(mine.means):,} kept")
show(axes[1], output.image, f"dense: {quality(dense):.2f} dB")
show(axes[2], render(mine, held_out.camera, background=scene.background)[0].image, f"yours: {quality(mine):.2f} dB")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Gumbel noise is $g = -\ln(-\ln u)$ with $u$ uniform in (0, 1). Show that the largest of $\ln I_i + g_i$ is row
# $i$ with probability $I_i / \sum_j I_j$. (Hint: $e^{-(\ln I_i + g_i)}$ has an exponential distribution.)
#
# <details>
# <summary>Solution</summary>
#
# $e^{-(\ln I_i + g_i)} = -\ln u_i / I_i$ is exponentially distributed with rate $I_i$. The largest of the sums is the
# smallest of these times, and of independent exponential clocks, clock $i$ rings first with probability
# $I_i / \sum_j I_j$.
#
# ```python
# u = np.random.default_rng(0).random((20_000, 4))
# first = np.argmax(np.log(weights) - np.log(-np.log(u)), axis=1)
# assert np.allclose(np.bincount(first) / 20_000, p, atol=0.015)
# ```
#
# </details>
#
# **2.** Two Gaussians of equal importance are merged. How far apart may two round ones of standard deviation $s$ be
# until the merged one is twice as long as wide?
#
# <details>
# <summary>Solution</summary>
#
# Along the line between them the variance is $s^2 + (d/2)^2$, across it $s^2$. Twice as long means
# $s^2 + d^2/4 = 4 s^2$, so $d = 2\sqrt3\,s = 3.5\,s$.
#
# ```python
# d = 2 * np.sqrt(3)
# apart = pair._replace(means=np.array([[0, 0, 0], [d, 0, 0.0]]), log_scales=np.zeros((2, 3)))
# joined = simplify.merge_neighbours(apart, np.ones(2), 1).gaussians
# lengths = np.sort(np.exp(joined.log_scales[0]))
# assert np.allclose(lengths, [1, 1, 2])
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# Many Gaussians never dominate a pixel. They carry little, and the picture changes little without them.
assert 0.2 < np.mean(~is_dominant) < 0.8
assert indoor[~is_dominant].sum() < 0.3 * indoor.sum()
assert quality(preserved) > quality(dense) - 2

# Both metrics are 0 for what no pixel sees; the outdoor one also for what never dominates.
assert np.array_equal(metrics["outdoor"] > 0, is_dominant) and (indoor[is_dominant] > 0).all()

# Drawing all at once has the distribution of drawing one after the other: within 4 standard deviations of the counts.
assert abs(expected.sum() - 1) < 1e-12
assert (np.abs(shares - expected) < 4 * np.sqrt(expected * (1 - expected) / N_DRAWS)).all()

# A mass keeps what rank keeps at the same number, and far more than one part in a hundred.
heaviest = simplify.select_mass(candidates, MASS)
assert np.array_equal(heaviest, simplify.most_important(candidates, len(heaviest)))
assert len(heaviest) > 0.5 * np.count_nonzero(candidates)

# Merging keeps mean and covariance, by hand.
assert np.allclose(merged.means[0], [1, 0, 0]) and np.allclose(np.diag(sigma), [3, 1, 0.01])

# Equal numbers. Further training helps all; sampling and merging cover the scene better than rank, and end higher.
assert all(len(gaussians.means) == n_kept for gaussians in at_once.values())
assert all(quality(after[name]) > quality(at_once[name]) + 2 for name in CHOICES)
assert quality(after["sampling"]) > quality(after["rank"]) + 0.5
assert quality(after["merging"]) > quality(after["rank"]) + 0.5
few_gaps = {name: values[0][2] for name, values in curves.items()}  # of the smallest number
assert few_gaps["sampling"] < 0.8 * few_gaps["rank"] and few_gaps["merging"] < 0.8 * few_gaps["rank"]
assert quality(at_once["merging"]) > max(quality(at_once["sampling"]), quality(at_once["rank"])) + 2

# A new start keeps centres and colours, and forgets the rest.
assert np.array_equal(restarted.means, at_once["sampling"].means)
assert np.array_equal(restarted.sh_dc, at_once["sampling"].sh_dc)
assert np.ptp(restarted.opacity_logits) == 0 and not restarted.sh_rest.any()

# Without the tail the picture is as good.
assert len(trimmed.means) < len(few.means) and quality(trimmed) > quality(few) - 0.5
print("all of the above holds")
