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
# # 25 Style and meaning
#
# A trained scene shows what was photographed. This notebook asks two other things of it: which Gaussians are the ball
# (FlashSplat), and what the room would look like in stripes (G-Style). Neither needs a network.

# %% tags=["rounding"]
import matplotlib.pyplot as plt
import numpy as np

from data_tools.claims import segment as masks_study
from data_tools.claims import style as style_study
from figures import BLUE, GREY, RED, show, show_code
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.extensions.segment.commands import paint
from minisplat_ref.extensions.segment.votes import assign_labels, belongs, count_view_votes, count_votes, label_map
from minisplat_ref.extensions.style.model import match_colors
from minisplat_ref.extensions.style.recipe import Plan, stylise
from minisplat_ref.mechanisms.features.filters import CLASSICAL, EVEN, gabor_filters
from minisplat_ref.rendering import SPLATTING, RenderSettings
from minisplat_ref.strategy.ops import take
from minisplat_ref.training.loop import train
from minisplat_ref.types import Model, view_from

made = make_scene("room", n_views=14, width=112, height=84, n_points=2500)
room = train(made.scene, find_recipe("3dgs-accel", 500), seed=0).gaussians
settings = RenderSettings(np.zeros(3))
view = made.scene.test_views[1]


def draw(gaussians):
    return np.clip(settings.render_view(Model(gaussians), view_from(view.camera))[0].image, 0, 1)


masks = [masks_study.object_ids(ids) for ids in made.train_ids]
figure, axes = plt.subplots(1, 3, figsize=(10.5, 2.7))
show(axes[0], draw(room), f"{len(room.means):,} Gaussians")
show(axes[1], made.scene.train_views[3].image, "a photograph ...")
show(axes[2], paint(masks[3]), "... and its mask: four objects")
_ = figure

# %% [markdown]
# ## A label for every Gaussian, without training
#
# A mask M says of each pixel to which object it belongs. A pixel of the image is a sum of colours with weights w. If
# Gaussians had labels P from 0 to 1 in place of colours, the same weights would draw a mask; how far it is from M is
# linear in P. So the best P is 0 or 1, and a Gaussian takes the label in whose pixels it has most weight: it votes.
#
# The votes come out of one backward pass: the derivative of "the sum of colours where M is 1" with respect to a
# Gaussian's colour *is* the sum of its weights there.

# %%
show_code(count_view_votes)
show_code(belongs)

# %% tags=["rounding"]
cameras = [v.camera for v in made.scene.train_views]
votes = count_votes(room, SPLATTING, zip(cameras, masks, strict=True), range(5))
found = assign_labels(votes, 0.0)
drawn = label_map(room, found, SPLATTING, view.camera)
truth = masks_study.object_ids(made.test_ids[1])
iou = masks_study.mean_iou([drawn], [truth])
crate = belongs(votes, 1, 0.0)
figure, axes = plt.subplots(1, 4, figsize=(10.5, 2.2))
show(axes[0], paint(drawn), "labels at a view that had no mask")
show(axes[1], paint(truth), "the truth")
show(axes[2], draw(take(room, crate)), f"the crate alone: {crate.sum()} Gaussians")
show(axes[3], draw(take(room, ~crate)), "everything else")
print(f"mean IoU of four objects: {iou:.3f}")
_ = figure

# %% [markdown]
# ## Bad masks, and a bias
#
# Where masks are shifted or lost, votes of the background win along the edges. A bias gamma moves the border: below
# zero it takes doubtful Gaussians along, above zero it leaves them to the background.

# %% tags=["rounding"]
biases = np.linspace(-0.8, 0.8, 9)
curves = {}
for name in ("clean", "all shifted", "30 % lost"):
    spoiled = masks_study.spoil(masks, *masks_study.CONDITIONS[name], np.random.default_rng(0))
    own = count_votes(room, SPLATTING, zip(cameras, spoiled, strict=True), range(5))
    maps = (label_map(room, assign_labels(own, bias), SPLATTING, view.camera) for bias in biases)
    curves[name] = [masks_study.mean_iou([map_], [truth]) for map_ in maps]
figure, axes = plt.subplots(figsize=(5.5, 2.4))
for (name, curve), color in zip(curves.items(), (GREY, BLUE, RED), strict=True):
    axes.plot(biases, curve, "o-", color=color, label=name)
axes.set(xlabel="gamma", title="mean IoU", ylim=(0, 1))
axes.legend()
_ = figure

# %% [markdown]
# ## What style is, in numbers
#
# First the colours: photographs are moved so that mean and covariance of their colours are those of the style. Then
# patterns: a bank of filters says of each pixel how much of which wave is there, in which direction. The loss asks that
# the vector of each pixel points where *some* vector of the style points, its nearest neighbour, wherever it is.

# %%
show_code(match_colors)
swatches = style_study.swatches()
figure, axes = plt.subplots(1, 6, figsize=(10.5, 1.9))
for axis, (name, swatch) in zip(axes, swatches.items(), strict=False):
    show(axis, swatch, name)
waves = gabor_filters()[EVEN]  # of the even ones: the weights of green
for axis, wave in zip(axes[2:], waves[:: len(waves) // 4], strict=False):
    show(axis, wave[1], "a filter", cmap="gray")
_ = figure

# %% [markdown]
# ## Room for a pattern
#
# A wall may be a single Gaussian, which cannot be striped. So large ones are split and needles are cut, before and
# while base colours are painted. Below: without splitting, and with it. The walls get patches; the price is the chair,
# whose rods are needles and break into beads.

# %% tags=["rounding"]
styled = {
    name: stylise(room, made.scene, swatches["checks"], Plan(iterations=120, splits=splits))
    for name, splits in (("not split", False), ("split", True))
}
figure, axes = plt.subplots(1, 3, figsize=(10.5, 2.7))
show(axes[0], draw(styled["split"].recolored), "colours alone")
for axis, (name, result) in zip(axes[1:], styled.items(), strict=True):
    show(axis, draw(result.gaussians), f"{name}: {len(result.gaussians.means):,} Gaussians")
distances = {
    name: style_study.feature_distance(draw(gaussians), swatches["checks"])
    for name, gaussians in (
        ("colours alone", styled["split"].recolored),
        *((name, result.gaussians) for name, result in styled.items()),
    )
}
print(", ".join(f"{name}: distance of features {distance:.4f}" for name, distance in distances.items()))
_ = figure

# %% [markdown]
# [The page of G-Style](../docs/family/style.md) has the figures with three seeds, the unfavourable ones first:
# splitting does not help every pattern, and a bank of edges and stripes copies patterns; it does not understand brush
# strokes. Even here it is not certain: another processor rounds differently, so other Gaussians are split, and with the
# same seed the distance was 0.075 on one and 0.100 on another, where colours alone have 0.084.
#
# ## Play
#
# Paint with another swatch, or with an image of your own: `read_style` of `extensions/style/recipe.py` reads one.

# %% tags=["rounding"]
other = stylise(room, made.scene, swatches["stripes"], Plan(iterations=40))
figure, axes = plt.subplots(figsize=(4.2, 3.1))
show(axes, draw(other.gaussians), "stripes")
_ = figure

# %% [markdown]
# ## Exercises
#
# 1. Two Gaussians draw a pixel of the mask of the ball, with the weights 0.6 and 0.3; a third pixel, of the background,
#    has 0.9 of the second. Which label does each take?
#
# <details><summary>Solution</summary>
#
# The first has all its weight, 0.6, in the ball; the second 0.3 of 1.2: the background.
#
# ```python
# from minisplat_ref.extensions.segment.votes import Votes
#
# by_hand = Votes((0, 1), np.array([[0.0, 0.9], [0.6, 0.3]]))
# assert assign_labels(by_hand, 0.0).tolist() == [1, 0]
# ```
#
# </details>
#
# 2. What does matching colours do to an image whose colours are those of the style already?
#
# <details><summary>Solution</summary>
#
# Nothing: mean and covariance agree, so M is the identity.
#
# ```python
# colors = np.random.default_rng(0).random((500, 3))
# same = match_colors(colors, colors)
# assert np.allclose(same(colors), colors)
# ```
#
# </details>

# %% [markdown]
# ## What was shown

# %%
# The votes of a Gaussian for all labels add up to all the weight that it has in the photographs.
alphas = [settings.render_view(Model(room), view_from(camera))[0].alpha.sum() for camera in cameras]
assert np.isclose(votes.weights.sum(), np.sum(alphas), rtol=1e-3)
assert iou > 0.6
assert max(curves["clean"]) >= curves["clean"][4] > max(curves["30 % lost"][4], 0.5)
assert np.argmax(curves["30 % lost"]) < 4  # lost masks vote for the background: a bias below zero helps
assert distances["not split"] < distances["colours alone"]
assert len(styled["split"].gaussians.means) > len(room.means)
maps, _ = CLASSICAL.features(np.full((96, 96, 3), 0.5))
assert all(np.allclose(map_.std(axis=(0, 1)), 0, atol=1e-6) for map_ in maps[:1])  # one colour has no pattern
print("all of the above holds")
