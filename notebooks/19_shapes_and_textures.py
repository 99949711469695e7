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
# # 19 Shapes and textures
#
# A Gaussian has one colour for each direction that it is seen from, and fades out on all sides alike. So a painted ball
# takes many of them, and a sharp edge takes more. This notebook shows relatives that give a Gaussian more to say: paint
# on its surface, a cut through it, a better answer to what a pixel sees of it.
#
# ## Paint on one Gaussian
#
# On the left is a soft ball with three stripes. One plain Gaussian can only take its mean colour. The others have a
# texture of degree 1, 2 and 3, whose coefficients are the best there are, by least squares. Last are five plain
# Gaussians, the best of three trainings: about as many numbers as the one with a texture of degree 3.

# %%
import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREY, RED, YELLOW, show
from minisplat_ref.backends import REFERENCE
from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.analytic.footprint import OPACITY, approximations, covariance, truth
from minisplat_ref.extensions.analytic.reference import NORMAL, integrals
from minisplat_ref.extensions.cuts import card
from minisplat_ref.extensions.cuts.curve import VERTICES, cut
from minisplat_ref.extensions.shared_studies import psnr_of
from minisplat_ref.extensions.textured.method import TEXTURED_GAUSSIANS
from minisplat_ref.extensions.textured.population import with_textures
from minisplat_ref.extensions.textured.reference import frames, meet
from minisplat_ref.extensions.textured.study import colors_across
from minisplat_ref.extensions.textured.tuning import floats_of
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import Request
from minisplat_ref.types import Model, view_from

# %% tags=["rounding"]
SIZE = card.SIZE
ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
centers = np.column_stack([xs.ravel(), ys.ravel()])
one = card.spread(1, np.random.default_rng(0))
one = type(one)(*(field.astype(np.float64) for field in one))
one = one._replace(log_scales=np.log(np.full((1, 3), 0.45)), opacity_logits=np.array([4.0]))


def drawn(gaussians, renderer=TEXTURED_GAUSSIANS.renderer):
    """Return the picture of Gaussians before black by a renderer of the reference."""
    return renderer.render(Model(gaussians), view_from(card.CAMERA), Request(backend=REFERENCE))[0].image


def painted(k):
    """Return the Gaussian with coefficients [K, 3] of its colour over the harmonics."""
    degree = round(np.sqrt(len(k))) - 1
    whole = with_textures(one, degree)
    return whole._replace(sh_dc=(k[:1] * SH_C0 - 0.5) / SH_C0, color_textures=k[1:].T.reshape(1, -1))


alpha = TEXTURED_GAUSSIANS.renderer.render(Model(painted(np.ones((1, 3)))), view_from(card.CAMERA), Request())[0].alpha
slanted = (xs + 0.6 * ys - 38.4) / 6.5
stripes = np.select([slanted < -1, slanted > 1], [0, 2], 1)
STRIPES = np.array([[0.85, 0.2, 0.15], [0.95, 0.9, 0.8], [0.15, 0.35, 0.75]])
ball = alpha[..., None] * STRIPES[stripes]

frame = frames(one.means, one.quats, np.exp(one.log_scales), card.CAMERA)
n = meet(frame, pinhole(one.means, card.CAMERA), centers).directions[0]  # [P, 3]
basis = sh_basis(n, 3)
textured = {}
for degree in range(4):
    terms = alpha.reshape(-1, 1) * basis[:, : (degree + 1) ** 2]
    k = np.linalg.lstsq(terms, ball.reshape(-1, 3), rcond=None)[0]
    textured[degree] = painted(k)
tries = [card.fitted(card.Target(ball, lambda rows: rows), 5, False, 1500, seed) for seed in range(3)]
five = max(tries, key=lambda population: psnr_of(card.drawn(population), ball))

pictures = {f"degree {degree}": (drawn(g), floats_of(g)) for degree, g in textured.items()}
pictures["five plain"] = (card.drawn(five), 5 * floats_of(one))
figure, axes = plt.subplots(1, 6, figsize=(11, 2.4))
show(axes[0], ball, "a soft ball")
for panel, (name, (image, n_floats)) in zip(axes[1:], pictures.items(), strict=True):
    show(panel, image, f"{name}: {psnr_of(image, ball):.1f} dB")
    panel.set_xlabel(f"{n_floats} numbers")
plt.show()

# %% [markdown]
# Paint helps, up to what eight or fifteen waves around a ball can show: they have no sharp edges. And it does not help
# more than as many numbers that are spent on further Gaussians. Trained scenes say the same (`study textured/counts`).
#
# Where does a ray meet the paint? At the first point of the ellipsoid of one deviation. With the ray turned into the
# Gaussian's axes and divided by its deviations, that ellipsoid is the unit sphere, and its point is a direction $n$.
# Then colour and opacity are spherical harmonics of $n$, as in notebook 02 they were of the viewing direction:
#
# $$ \operatorname{opacity}(n) = \operatorname{sigmoid}\Big(l + \sum_k h_k Y_k(n)\Big), \qquad
#    \operatorname{color}(n) = \max\Big(0,\; c + \sum_k k_k Y_k(n)\Big). $$
#
# | folder | what it gives a Gaussian |
# |---|---|
# | `minisplat_ref/extensions/textured/` | colour and opacity over its ellipsoid (Textured-GS) |
# | `minisplat_ref/extensions/cuts/` | a Bezier curve that cuts a part away (DisC-GS) |
# | `minisplat_ref/extensions/analytic/` | the mean over a pixel instead of a sample (Analytic-Splatting) |
#
# **Frames and units:** pictures are 48 x 48 pixels, and lengths in them are pixels; curves have their control points in
# deviations of their Gaussian.
#
# A footprint reaches to three deviations, so that most of its rays miss the ellipsoid of one. What then? Left: $n$ as a
# colour, with the limb dashed. Rays beyond it take the direction of their nearest point. Then three harmonics as they
# are seen. Right: a texture along a row of rays across the limb, and the same if rays beyond have none, which jumps.

# %%
STEP = 0.01
across, without = colors_across(STEP)
place = np.arange(len(across)) * STEP
limb = np.argmax(np.abs(np.diff(without)))  # where rays begin to miss
radius = 0.45 * card.FOCAL / np.sqrt(card.DISTANCE**2 - 0.45**2)
turn = np.linspace(0, 2 * np.pi, 100)

figure, axes = plt.subplots(1, 6, figsize=(11, 2.4), width_ratios=(1, 1, 1, 1, 0.1, 1.8))
show(axes[0], (n.reshape(SIZE, SIZE, 3) + 1) / 2, "n as red, green, blue")
axes[0].plot(SIZE / 2 - 0.5 + radius * np.cos(turn), SIZE / 2 - 0.5 + radius * np.sin(turn), "--", color="white", lw=1)
for panel, number in zip(axes[1:4], (2, 8, 15), strict=True):
    wave = alpha * basis[:, number].reshape(SIZE, SIZE)
    show(panel, wave, f"harmonic {number}", cmap="RdBu_r", vmin=-0.8, vmax=0.8)
axes[4].axis("off")
axes[5].plot(place, across, color=BLUE, label="nearest point beyond")
axes[5].plot(place[limb + 1 :], without[limb + 1 :], color=RED, label="no texture beyond")
axes[5].axvline(place[limb], color=GREY, linestyle="--", linewidth=0.8)
axes[5].set(xlabel="ray [px]", title="a texture across the limb")
axes[5].legend()
plt.show()

# %% [markdown]
# ## A cut
#
# Each Gaussian gets a curve in the plane of its first two axes. Think of a lamp at its centre: what lies in the curve's
# shadow is cut away. A pixel is lit if the segment from the centre to it crosses the curve an even number of times, 0,
# 2 and so on. Below are three curves with their shadows, then the middle one with a soft edge.

# %%
CURVES = {
    "beside the centre": np.array([[2.0, -5.0], [9.0, -6.0], [6.0, 7.0], [-2.5, 5.0]]),
    "almost around it": np.array([[-3.0, 0.5], [-2.0, 9.0], [8.0, -3.0], [-3.0, -0.5]]),
    "with a loop": np.array([[2.5, -1.0], [12.0, 8.0], [-4.0, 8.0], [4.5, -2.0]]),
}
steps = np.linspace(-8, 8, 81) + 0.013
d = np.stack(np.meshgrid(steps, steps), axis=-1)  # [81, 81, 2] px from the centre
falloff = np.exp(-np.sum(d**2, axis=2) / (2 * 3.5**2))


def masked(points, width):
    """Return the mask [81, 81] of a curve."""
    return cut(points[None], np.array([width]), d.reshape(1, -1, 2)).masks.reshape(81, 81)


figure, axes = plt.subplots(1, 4, figsize=(11, 2.9))
for panel, (name, points) in zip(axes, CURVES.items(), strict=False):
    show(panel, falloff * masked(points, 0.0), name, cmap="gray", extent=(-8, 8, 8, -8))
soft = masked(CURVES["almost around it"], 0.7)
show(axes[3], falloff * soft, "an edge 0.7 px wide", cmap="gray", extent=(-8, 8, 8, -8))
for panel, points in zip(axes, (*CURVES.values(), CURVES["almost around it"]), strict=True):
    panel.plot(*(VERTICES @ points).T, "o-", color=RED, markersize=2.5, linewidth=1)
    panel.plot(0, 0, "*", color=YELLOW)
    panel.set(xlim=(-8, 8), ylim=(8, -8))
plt.show()

# %% [markdown]
# With the offset $d$ of a pixel from the centre and the signed distance $s(d)$ to the edge of the shadow,
#
# $$ \alpha = o\, e^{-\frac12 d^T Q d}\, \operatorname{mask}(d), \qquad
#    \operatorname{mask}(d) = \begin{cases} \dfrac{1}{1 + e^{-s(d) / w}} & \text{in training,} \\[1ex]
#    1 \text{ if } s(d) > 0 \text{, else } 0 & \text{in the end } (w = 0). \end{cases} $$
#
# A step has no derivative, so that training sees the soft edge: $w$ is a pixel, then half of one, and 0 in the last
# iteration. Below a Gaussian whose right side is missing is learnt by plain Gaussians and by one with a cut, 300
# iterations each. Then the same one begins with its curve on the other side.

# %% tags=["rounding"]
half = card.cut_gaussian()
plain = {number: card.fitted(half, number, False, 300, seed=3) for number in (1, 4)}
with_cut = {seed: card.fitted(half, 1, True, 300, seed) for seed in (3, 1)}
found = {"1 plain": plain[1], "4 plain": plain[4], "1 with a cut": with_cut[3], "begun left": with_cut[1]}
results = {name: (card.drawn(g), card.measured(half, g)) for name, g in found.items()}

figure, axes = plt.subplots(1, 6, figsize=(11, 2.5), width_ratios=(1, 1, 1, 1, 1, 1.9))
show(axes[0], half.image, "half a Gaussian")
for panel, (name, (image, values)) in zip(axes[1:5], results.items(), strict=True):
    show(panel, image, f"{name}: {values['psnr']:.0f} dB")
axes[5].plot(half.image[SIZE // 2].mean(axis=1), color="black", linewidth=3, alpha=0.3, label="truth")
for (name, (image, _)), color in zip(results.items(), (GREY, BLUE, RED, YELLOW), strict=True):
    axes[5].plot(image[SIZE // 2].mean(axis=1), color=color, linewidth=1, label=name)
axes[5].set(title="the middle row", xlabel="x [px]", xlim=(0, 80), xticks=range(0, 49, 12))
axes[5].legend(fontsize=7, loc="upper right")
plt.show()
for name, (_, values) in results.items():
    print(f"{name:<18} {values['psnr']:5.1f} dB, near the edge {values['band']:5.1f} dB")

# %% [markdown]
# The one with the cut has the edge; four plain ones have a slope. The last picture shows what a gradient cannot do:
# where the curve would have to move *over the centre*, what was cut and what was left would change places all at once.
# No gradient says so, and the curve is pushed out of the picture instead. Two in four random curves begin there (`study
# cuts/card`).
#
# ## What a pixel sees
#
# An edge or a needle thinner than a pixel raises another question. 3DGS takes the value at the pixel's centre, after it
# has widened every Gaussian. What falls on a pixel is the mean over its square. Left: a Gaussian of 0.25 pixels, its
# value at the centres and its mean over each pixel. Right: the needle moves by one pixel; how much light does each
# method show?

# %%
THIN, MEAN = 0.25, 3.3
fine = np.linspace(0, 7, 701)
profile = OPACITY * np.exp(-((fine - MEAN) ** 2) / (2 * THIN**2))
middles = np.arange(7) + 0.5
sampled = OPACITY * np.exp(-((middles - MEAN) ** 2) / (2 * THIN**2))
averaged = OPACITY * np.sqrt(2 * np.pi) * THIN * integrals(MEAN - middles, np.array(1 / THIN), NORMAL)

shifts = np.linspace(0, 1, 21)
SHOWN = {"centre": GREY, "dilation": RED, "Mip filter": YELLOW, "integral, logistic": BLUE}
C = covariance(0.2, 12.0, 0.0)  # a needle along x
light = {name: [] for name in SHOWN}
for shift in shifts:
    mean = np.array([0.5, shift])
    exact = truth(mean, C).sum()
    for name, alphas in approximations(mean, C).items():
        if name in SHOWN:
            light[name].append(alphas.sum() / exact)

figure, axes = plt.subplots(1, 3, figsize=(11, 2.8), width_ratios=(1.2, 1.2, 1))
bars = {"value at the centre": (sampled, RED), "mean over the pixel": (averaged, BLUE)}
whole = OPACITY * np.sqrt(2 * np.pi) * THIN
for panel, (name, (values, color)) in zip(axes, bars.items(), strict=False):
    panel.bar(middles, values, 0.96, color=color, alpha=0.5)
    panel.plot(fine, profile, color="black", linewidth=1)
    panel.set(title=f"{name}: light {values.sum():.2f} of {whole:.2f}", xlabel="x [px]", ylim=(0, 0.85))
axes[0].plot(middles, sampled, "o", color=RED, markersize=4)
for name, color in SHOWN.items():
    axes[2].plot(shifts, light[name], color=color, label=name)
axes[2].set(title="light relative to the truth", xlabel="place of a needle of 0.2 px [px]", ylim=(0, 4.6))
axes[2].legend(fontsize=7.5, loc="upper right", ncols=2)
plt.show()

# %% [markdown]
# A needle that is sampled flickers as it moves: on a centre it is far too bright, between two it is all but gone.
# Dilation does not flicker, and is too bright everywhere. With deviations $l_k$ along the axes of the ellipse, offsets
# $u_k$ along them and the distribution function $F$ of the normal distribution, the mean is a product:
#
# $$ \alpha = o\, 2\pi\, l_1 l_2 \prod_{k=1}^2 \left[F\!\left(\tfrac{u_k + 1/2}{l_k}\right) -
#    F\!\left(\tfrac{u_k - 1/2}{l_k}\right)\right] . $$
#
# Notebook 16 compares the methods under zoom.
#

# ## Play
#
# Draw a curve. What to look for:
#
# * Move all four points across the centre: what happens to light and shadow?
# * `width`: at which width does the cut stop looking like an edge?
# * Let the ends meet. When is the inside cut away, and when is the shadow behind it?

# %%
points, width = np.array([[3.0, -4.0], [3.0, -1.5], [3.0, 1.5], [3.0, 4.0]]), 0.0

figure, axes = plt.subplots(1, 3, figsize=(9, 2.9))
mask = masked(points, width)
for panel, image, name in zip(
    axes, (mask, falloff * mask, falloff * (1 - mask)), ("mask", "what is left", "what is cut away"), strict=True
):
    show(panel, image, name, cmap="gray", vmin=0, vmax=1, extent=(-8, 8, 8, -8))
    panel.plot(*(VERTICES @ points).T, "o-", color=RED, markersize=2.5, linewidth=1)
    panel.set(xlim=(-8, 8), ylim=(8, -8))
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** How many numbers has a Gaussian with textures of degree $L$ for colour and opacity? From which degree on does
# it have more than five plain ones without view dependence, 14 numbers each?
#
# <details>
# <summary>Solution</summary>
#
# Its own 14, and $(L + 1)^2 - 1$ for each of three colours and the opacity: $14 + 4\,((L + 1)^2 - 1)$. That is 26, 46
# and 74 for degrees 1, 2 and 3; five plain ones have 70.
#
# ```python
# for degree in range(4):
#     assert floats_of(textured[degree]) == 14 + 4 * ((degree + 1) ** 2 - 1)
# assert floats_of(textured[2]) < 5 * 14 < floats_of(textured[3])
# ```
#
# </details>
#
# **2.** A straight curve lies close to the centre, to its right. It is moved by a little, so that it lies to the left.
# How much of the Gaussian's light changes? Compare with the change if it moves by as much without crossing the centre.
#
# <details>
# <summary>Solution</summary>
#
# Nearly all: before, the left side was lit, now the right one is. Without the crossing only a thin strip changes.
#
# ```python
# straight = np.array([[0.0, -40.0], [0.0, -15.0], [0.0, 15.0], [0.0, 40.0]])
# right, left, further = (falloff * masked(straight + [x, 0.0], 0.0) for x in (0.1, -0.1, 0.3))
# assert np.abs(left - right).sum() > 0.9 * falloff.sum()
# assert np.abs(further - right).sum() < 0.1 * falloff.sum()
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# A higher degree is never worse, and paint gains several dB; as many numbers in five plain Gaussians gain as much.
psnrs = [psnr_of(drawn(textured[degree]), ball) for degree in range(4)]
assert np.all(np.diff(psnrs) > 0) and psnrs[3] > psnrs[0] + 5
assert abs(psnr_of(card.drawn(five), ball) - psnrs[3]) < 3
# Beyond the limb a texture goes on without a jump.
assert np.abs(np.diff(across)).max() < 0.2 * np.abs(np.diff(without)).max()
# A mask is a step, a soft one is in between, and both cut away the same side.
hard = masked(CURVES["almost around it"], 0.0)
assert set(np.unique(hard)) == {0.0, 1.0} and np.all((soft > 0.5) == (hard == 1))
assert all(0.05 < masked(points_of, 0.0).mean() < 0.95 for points_of in CURVES.values())
# One Gaussian with a cut finds the edge if it begins on the right side; on the other it does not.
values = {name: result[1] for name, result in results.items()}
assert values["1 with a cut"]["psnr"] > values["4 plain"]["psnr"] + 10 > values["1 plain"]["psnr"]
assert values["begun left"]["psnr"] < values["4 plain"]["psnr"]
assert values["1 with a cut"]["edge_width"] < 2 < values["1 plain"]["edge_width"]
# The mean keeps the light wherever a needle lies, a sample does not.
assert np.isclose(averaged.sum(), whole, rtol=1e-6) and abs(sampled.sum() / whole - 1) > 0.1
assert np.ptp(light["centre"]) > 1 and np.abs(np.array(light["integral, logistic"]) - 1).max() < 0.02
assert min(light["dilation"]) > 2
print("all of the above holds")
