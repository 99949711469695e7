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
# # 05 Loss
#
# How far is a rendered picture from a photograph? 3DGS adds two answers: the mean absolute difference, which looks at
# one pixel at a time, and structural similarity, which looks at neighbourhoods. This notebook shows what each of them
# sees, and the gradient image that they send back to the renderer.
#
# Below is a ray-traced photograph of a small room with five kinds of error: too bright everywhere, low contrast,
# shifted by a fraction of a pixel, blurred, noisy. Each is scaled so that the mean absolute difference is **the same**,
# 0.03. The first row is what you see, the second what L1 sees, and the third what SSIM sees.

# %%
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from scipy.ndimage import gaussian_filter

from figures import BLUE, GREY, RED, YELLOW, show, show_code, show_error, with_sliders
from minisplat_ref.constants import SSIM_SIGMA, SSIM_WINDOW
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.metrics import psnr
from minisplat_ref.reference.loss import photometric_loss, photometric_loss_vjp, ssim_map, ssim_map_vjp

# %%
photo = make_scene("room", n_views=2, width=120, height=90, n_points=0, seed=3).scene.train_views[0].image / 255.0
MEAN_DIFFERENCE = 0.03
DETAIL = np.s_[10:70, 20:100]  # the part that is shown
rng = np.random.default_rng(0)
shifted = np.roll(photo, (1, 1), axis=(0, 1))
shifted[0], shifted[:, 0] = photo[0], photo[:, 0]  # what rolls in from the other side is no shift
directions = {
    "brighter": np.ones_like(photo),
    "less contrast": photo.mean(axis=(0, 1)) - photo,
    "shifted": shifted - photo,
    "blurred": gaussian_filter(photo, (1.5, 1.5, 0), mode="nearest") - photo,
    "noisy": rng.normal(size=photo.shape),
}
images = {name: photo + MEAN_DIFFERENCE * d / np.abs(d).mean() for name, d in directions.items()}

l1 = {name: photometric_loss(image, photo, 0.0)[0] for name, image in images.items()}  # weight 0: L1 alone
dssim = {name: photometric_loss(image, photo, 1.0)[0] for name, image in images.items()}  # weight 1: 1 - SSIM alone

figure, axes = plt.subplots(3, 5, figsize=(10, 4.9))
for column, (name, image) in zip(axes.T, images.items(), strict=True):
    show(column[0], image[DETAIL], f"{name}\nPSNR {psnr(image, photo):.1f} dB")
    l1_map = np.abs(image - photo).mean(axis=2)[DETAIL]
    dssim_map = 1 - ssim_map(image, photo).mean(axis=2)[DETAIL]
    difference = show(column[1], l1_map, f"L1 {l1[name]:.3f}", cmap="magma", vmin=0, vmax=0.15)
    dissimilarity = show(column[2], dssim_map, f"1 - SSIM {dssim[name]:.3f}", cmap="magma", vmin=0, vmax=0.5)
figure.colorbar(difference, ax=axes[1], label="|I - T|", shrink=0.9)
figure.colorbar(dissimilarity, ax=axes[2], label="1 - SSIM", shrink=0.9)
figure.colorbar(difference, ax=axes[0]).ax.set_visible(False)
plt.show()

# %% [markdown]
# For L1 the five are equal. For SSIM they are not: a change of brightness hardly counts, and blur does. What counts
# most is noise on the plain walls, where the photograph has no structure to hide it.
#
# | file | what it holds | equation |
# |---|---|---|
# | `minisplat_ref/reference/loss.py` | `photometric_loss`, `ssim_map` and their gradients | 3DGS (7), SSIM (13) |
#
# *3DGS* is Kerbl et al. 2023, *SSIM* is Wang et al. 2004. **Frames and units:** images are [H, W, 3] with values in
# [0, 1]; pixel indices count from 0 at the top left. The loss has no unit.
#
# ## The two terms
#
# $$ \mathcal L = (1 - w)\, \frac1n \sum |I - T| + w\, \Bigl( 1 - \frac1n \sum \mathrm{SSIM} \Bigr), \qquad w = 0.2,
#    \tag{3DGS 7} $$
#
# with sums over the $n = 3HW$ values of the image. SSIM compares two neighbourhoods $x$ of the rendering and $y$ of the
# photograph by their weighted means, variances and covariance, for each channel by itself:
#
# $$ \mathrm{SSIM} = \frac{(2 \mu_x \mu_y + C_1)(2 \sigma_{xy} + C_2)}
#                         {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)}, \qquad
#    C_1 = 0.01^2,\; C_2 = 0.03^2 . \tag{SSIM 13} $$
#
# The left factors compare brightness and the right ones structure; neither fraction exceeds 1. $C_2$ decides what
# "flat" means: a standard deviation well below 0.03 counts as no structure. Some texts halve the second term,
# $(1 - \mathrm{SSIM})/2$. The code that the published numbers come from does not, and neither does this package.

# %%
show_code(ssim_map)
show_code(photometric_loss)

# %% [markdown]
# ## The window
#
# The weights are a Gaussian of $\sigma = 1.5$ px, cut to $11 \times 11$ pixels and normalised. They can be *measured*:
# for two constant images the variances vanish, SSIM depends on the window mean alone, and the gradient of one SSIM
# value with respect to the image is the window.

# %%
size = 31
dark, bright = np.full((size, size, 3), 0.4), np.full((size, size, 3), 0.6)
one = np.zeros_like(dark)
one[15, 15, 0] = 1  # the SSIM value at pixel (15, 15), red
v_image = ssim_map_vjp(dark, bright, one)[:, :, 0]
window = v_image / v_image.sum()
rows, columns = np.nonzero(window)

changed = photo.copy()
changed[45, 60] = 1 - changed[45, 60]  # one pixel
footprint = np.abs(ssim_map(changed, photo) - 1).max(axis=2) > 1e-12

figure, axes = plt.subplots(1, 3, figsize=(11, 3.1), width_ratios=[1, 1.2, 1.2])
figure.get_layout_engine().set(w_pad=0.12)  # inches: else the first label is cut off
shown = axes[0].imshow(window[8:23, 8:23], cmap="magma", extent=(7.5, 22.5, 22.5, 7.5))
axes[0].add_patch(Rectangle((9.5, 9.5), 11, 11, fill=False, edgecolor="white"))
axes[0].set(title="the window, measured; frame: 11 x 11", xlabel="column", ylabel="row", xticks=range(8, 23, 2))
figure.colorbar(shown, ax=axes[0], shrink=0.85)
offsets = np.arange(-7, 8)
axes[1].bar(offsets, window.sum(axis=0)[8:23], color=BLUE, label="measured")
gaussian = np.where(np.abs(offsets) <= 5, np.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2), 0)
axes[1].plot(offsets, gaussian / gaussian.sum(), "o-", color=YELLOW, label=r"Gaussian, $\sigma = 1.5$ px, cut at ±5 px")
axes[1].set(title="summed over rows", xlabel="offset [px]", ylabel="weight", ylim=(0, 0.33))
axes[1].legend(frameon=False, loc="upper center", fontsize=8)
spoiled = 1 - ssim_map(changed, photo).mean(axis=2)
shown = axes[2].imshow(spoiled[37:54, 52:69], cmap="magma", extent=(51.5, 68.5, 53.5, 36.5))
axes[2].add_patch(Rectangle((54.5, 39.5), 11, 11, fill=False, edgecolor="white"))
axes[2].set(title="1 - SSIM when pixel (45, 60) changes", xlabel="column", ylabel="row")
figure.colorbar(shown, ax=axes[2], shrink=0.85)
plt.show()

# %% [markdown]
# One wrong pixel changes 121 SSIM values, and one SSIM value has a gradient at 121 pixels.
#
# **At the border** the window extends beyond the image. As in the 3DGS code, both images are padded with zeros, which
# keep their share of the weights. So both images appear to end in a black frame, and a frame is structure: a difference
# in brightness becomes a difference in contrast, which SSIM punishes more. Two constant images, 0.4 and 0.6, show it
# best; away from the border their SSIM is $(2 \mu_x \mu_y + C_1) / (\mu_x^2 + \mu_y^2 + C_1)$.

# %%
similarity = ssim_map(dark, bright)[:, :, 0]
inside = (2 * 0.4 * 0.6 + 0.01**2) / (0.4**2 + 0.6**2 + 0.01**2)

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.1), width_ratios=[1, 1.4, 1.4])
figure.colorbar(show(left, similarity, "SSIM of constant 0.4 and 0.6", cmap="magma", vmin=0.7, vmax=0.95), ax=left)
middle.plot(similarity[15], "o-", color=BLUE, markersize=3, label="middle row")
middle.axhline(inside, color=GREY, linewidth=0.8, label="closed form, away from the border")
for x in (4.5, 25.5):
    middle.axvline(x, color=GREY, linewidth=0.8, linestyle=":")
middle.set(title="one row: 5 pixels at each end are affected", xlabel="column", ylabel="SSIM")
middle.legend(loc="center")
means = np.linspace(0, 1, 101)
flat = [ssim_map(np.full((11, 11, 3), m), np.full((11, 11, 3), 0.6))[5, 5, 0] for m in means]
right.plot(means, flat, color=BLUE, label="brightness: constant m against constant 0.6")
pattern = np.where(np.indices((11, 11)).sum(axis=0)[:, :, None] % 2, 1.0, -1.0) * np.ones(3)
amplitudes = np.linspace(0, 0.4, 81)
noise = [ssim_map(0.5 + a * pattern, np.full((11, 11, 3), 0.5))[5, 5, 0] for a in amplitudes]
right.plot(amplitudes, noise, color=RED, label="structure: checkerboard ±a against constant 0.5")
right.axvline(0.03, color=GREY, linewidth=0.8, linestyle=":")
right.set(title="SSIM in the middle of an 11 x 11 image", xlabel="m or a", ylim=(-0.05, 1.25))
right.legend(frameon=False, fontsize=8, loc="upper right")
plt.show()

# %% [markdown]
# (On the right the image is as small as the window, so its middle is the only pixel whose window stays inside.) SSIM
# tolerates a wrong brightness over a wide range. It does not tolerate structure that is not in the photograph: at an
# amplitude of 0.03, the dotted line, half of the similarity is gone.
#
# ## The gradient image
#
# What the renderer receives is $v_I = \partial \mathcal L / \partial I$, one number for each pixel and channel. Here is
# the red channel for two of the five errors. Red pixels are to become darker, blue ones brighter.

# %%
figure, axes = plt.subplots(2, 4, figsize=(11, 4.3))
for line, name in zip(axes, ("blurred", "noisy"), strict=True):
    show(line[0], images[name], name)
    for panel, weight, title in zip(line[1:], (0.0, 1.0, 0.2), ("L1", "1 - SSIM", "loss, w = 0.2"), strict=True):
        tape = photometric_loss(images[name], photo, weight)[1]
        v_red = photometric_loss_vjp(tape)[:, :, 0] * photo.size  # in units of 1 / n
        reach = 1.0 if weight == 0 else float(np.quantile(np.abs(v_red), 0.99))
        shown = show(panel, v_red, f"gradient of {title}", cmap="RdBu_r", vmin=-reach, vmax=reach)
        figure.colorbar(shown, ax=panel, shrink=0.85, label="units of 1/n" if panel is line[-1] else "")
plt.show()

# %% [markdown]
# In the blurred image both terms ask for sharper edges. In the noisy one, L1 responds to the noise everywhere alike,
# and SSIM pulls hardest on the plain walls. A gradient of the SSIM term can be tens of times $1/n$: with $w = 0.2$ it
# often outweighs L1.
#
# L1 sends a sign: $\pm 1/n$ whatever the size of the error. For SSIM, call its four factors $S = PQ / (AB)$. They
# depend on the image through three blurred images, and a blur with a symmetric window is its own transpose, so the
# backward pass consists of three blurs:
#
# $$ v_x = \mathrm{blur}(v_\mu) + 2x \odot \mathrm{blur}(v_m) + y \odot \mathrm{blur}(v_k), \qquad
#    \mu = \mathrm{blur}(x),\; m = \mathrm{blur}(x^2),\; k = \mathrm{blur}(xy) . $$

# %%
show_code(ssim_map_vjp)
show_code(photometric_loss_vjp)

# %% [markdown]
# **Checked at once** against central differences along a random direction $u$, which moves all pixels together:
# $\langle v_I, u \rangle$ against $(\mathcal L(I + hu) - \mathcal L(I - hu)) / 2h$. L1 has a kink at $I = T$, where the
# gradient is 0 because $\operatorname{sign}(0) = 0$; pixels as close to the kink as the step are not moved.

# %%
STEP = 1e-7


def check_along(image, weight):
    """Relative error of the gradient along a random direction, and the size of what was compared."""
    v_image = photometric_loss_vjp(photometric_loss(image, photo, weight)[1])
    direction = np.random.default_rng(1).uniform(-1, 1, photo.shape) * (np.abs(image - photo) > STEP)
    up, down = (photometric_loss(image + sign * STEP * direction, photo, weight)[0] for sign in (1, -1))
    size = np.abs(v_image * direction).sum()
    return abs((up - down) / (2 * STEP) - np.vdot(v_image, direction)) / size, size


gradient_errors = {(name, weight): check_along(images[name], weight) for name in images for weight in (0.0, 0.2, 1.0)}
print("relative error                   L1     w = 0.2    1 - SSIM")
for name in images:
    print(f"{name:<24}" + "".join(f"{gradient_errors[name, weight][0]:12.1e}" for weight in (0.0, 0.2, 1.0)))

# %% [markdown]
# ## A mask
#
# A passer-by, or a reflection of the photographer: some pixels must not count. Leaving them out of the two means is not
# enough, because the windows of their neighbours still contain them, up to 5 pixels away. So the rendering is first
# replaced by the photograph under the mask. What is masked then neither counts nor affects its neighbours.

# %%
mask = np.ones(photo.shape[:2], dtype=bool)
mask[30:62, 48:72] = False
rendered = images["blurred"].copy()
rendered[~mask] = [0.9, 0.1, 0.6]  # something that the photograph does not show
gradients = {
    "without mask": photometric_loss_vjp(photometric_loss(rendered, photo, 0.2)[1]),
    "with mask": photometric_loss_vjp(photometric_loss(rendered, photo, 0.2, mask)[1]),
}
clean = photometric_loss_vjp(photometric_loss(images["blurred"], photo, 0.2, mask)[1])

figure, axes = plt.subplots(1, 3, figsize=(11, 2.8))
show(axes[0], rendered, "rendering, with an intruder")
reach = 5.0
for panel, (name, v_image) in zip(axes[1:], gradients.items(), strict=True):
    shown = show(
        panel, v_image[:, :, 0] * photo.size, f"gradient {name}, red channel", cmap="RdBu_r", vmin=-reach, vmax=reach
    )
    panel.add_patch(Rectangle((47.5, 29.5), 24, 32, fill=False, edgecolor="black", linewidth=0.8))
figure.colorbar(shown, ax=axes[2], label="units of 1/n")
plt.show()

outside = np.abs(gradients["without mask"] * photo.size - gradients["with mask"] * mask.sum() * 3).max(axis=2) > 1e-6
outside &= mask
reach_rows = np.flatnonzero(outside.any(axis=1))
print(
    f"without the mask the gradient changes in rows {reach_rows[0]} to {reach_rows[-1]}; the intruder covers 30 to 61"
)

# %% [markdown]
# Without a mask the intruder affects pixels up to 10 away: it is 5 to the SSIM values whose windows contain it, and 5
# more from those to the pixels on which they depend.
#
# ## Play
#
# Mix an error of your own, with the sliders that a running notebook has below the picture, or by the first numbers of
# the last lines. What to look for:
#
# * `brighter` against `noise`: which of the two does SSIM forgive, at the same L1?
# * `stripes` and `blur`: an error where the picture is smooth, and one where it is not.
# * `w`: at which weight do the two terms pull equally hard, that is, when are the two sizes in the title equal?
# * Other errors: in `mixed`, try `photo**1.2`, `np.flipud(photo)` or `np.round(photo * 4) / 4`.

# %%
x = np.arange(photo.shape[1])[None, :, None]
grain = np.random.default_rng(1).normal(size=photo.shape)


def mixed(brighter, stripes, blur, noise, w):
    """Draw the photograph with four errors at once, and both terms of the loss."""
    blurred = gaussian_filter(photo, (blur, blur, 0), mode="nearest")
    mine = np.clip(blurred + brighter + stripes * np.sin(x) + noise * grain, 0, 1)
    l1, dssim = (photometric_loss(mine, photo, weight) for weight in (0.0, 1.0))  # values with tapes
    sizes = [
        part * np.abs(photometric_loss_vjp(tape)).sum() for part, (_, tape) in zip((1 - w, w), (l1, dssim), strict=True)
    ]
    figure, axes = plt.subplots(1, 3, figsize=(11, 3))
    figure.suptitle(f"size of the gradient: (1 - w) L1 {sizes[0]:.2f}, w (1 - SSIM) {sizes[1]:.2f}", fontsize=9.5)
    show(axes[0], mine, f"yours, PSNR {psnr(mine, photo):.1f} dB")
    show_error(axes[1], mine, photo, f"L1 {l1[0]:.3f}", vmax=0.15)
    show(axes[2], 1 - ssim_map(mine, photo).mean(axis=2), f"1 - SSIM {dssim[0]:.3f}", cmap="magma", vmin=0, vmax=0.5)
    return figure


with_sliders(
    mixed,
    brighter=(0.0, -0.2, 0.2),  # the first value, the least, the most
    stripes=(0.03, 0.0, 0.2),
    blur=(0.0, 0.0, 3.0),
    noise=(0.0, 0.0, 0.2),
    w=(0.2, 0.0, 1.0),
)

# %% [markdown]
# ## Exercises
#
# **1.** Two constant images differ by 0.2 in brightness, 0.1 against 0.3 and 0.7 against 0.9. L1 sees no difference
# between the two pairs. What does SSIM see, away from the border?
#
# <details>
# <summary>Solution</summary>
#
# All variances vanish, so SSIM is $(2 \mu_x \mu_y + C_1) / (\mu_x^2 + \mu_y^2 + C_1)$: 0.60 in the dark and 0.97
# in the light. SSIM compares brightness by its ratio, as the eye does.
#
# ```python
# pairs = {}
# for m, n in ((0.1, 0.3), (0.7, 0.9)):
#     pairs[m] = ssim_map(np.full((31, 31, 3), m), np.full((31, 31, 3), n))[15, 15, 0]
#     assert np.isclose(pairs[m], (2 * m * n + 1e-4) / (m * m + n * n + 1e-4))
# assert pairs[0.1] < 0.61 and pairs[0.7] > 0.96
# ```
#
# </details>
#
# **2.** Which constant grey image has the smallest L1 against the photograph, and which the smallest mean squared
# error? What does that say about a Gaussian that is too large for the texture behind it?
#
# <details>
# <summary>Solution</summary>
#
# The median of the values minimises the sum of absolute differences, the mean that of squares. A Gaussian that
# can only be grey takes the *median* colour under L1: on a checkerboard of unequal shares it takes the colour of the
# majority, and its gradient is then small although half of the picture is wrong.
#
# ```python
# greys = np.linspace(0, 1, 201)
# best_l1 = greys[np.argmin([np.abs(photo - grey).mean() for grey in greys])]
# best_l2 = greys[np.argmin([((photo - grey) ** 2).mean() for grey in greys])]
# assert abs(best_l1 - np.median(photo)) < 0.006 and abs(best_l2 - photo.mean()) < 0.006
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# Five errors that L1 cannot tell apart and SSIM can.
assert all(abs(value - MEAN_DIFFERENCE) < 1e-12 for value in l1.values())
assert dssim["brighter"] < dssim["less contrast"] < min(dssim["shifted"], dssim["blurred"]) < dssim["noisy"]
assert dssim["noisy"] > 10 * dssim["brighter"]
combined = photometric_loss(images["blurred"], photo, 0.2)[0]
assert np.isclose(combined, 0.8 * l1["blurred"] + 0.2 * dssim["blurred"], rtol=1e-12)

# The window: 11 x 11, a Gaussian, normalised; zeros beyond the border.
assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 20, 10, 20) and len(rows) == SSIM_WINDOW**2
assert np.allclose(window.sum(axis=0)[8:23], gaussian / gaussian.sum(), atol=1e-12)
assert footprint.sum() == 121 and footprint[40:51, 55:66].all()
assert np.allclose(similarity[5:-5, 5:-5], inside, rtol=1e-12) and (similarity[:5] < inside - 1e-4).all()
assert np.interp(0.03, amplitudes, noise) < 0.55 < 0.9 < np.interp(0.5, means, flat)

# The gradient is a derivative, and not zero.
assert len(gradient_errors) == 15
for (name, weight), (error, size) in gradient_errors.items():
    assert error < 1e-6 and size > 0.01, f"{name}, w = {weight}: relative error {error:.1e}"

# The mask: nothing under it counts or affects its neighbours, and an empty one is no error.
assert np.all(gradients["with mask"][~mask] == 0) and np.array_equal(gradients["with mask"], clean)
assert np.abs(gradients["without mask"][~mask]).max() * photo.size > 0.5
assert (reach_rows[0], reach_rows[-1]) == (20, 71)
empty_loss, empty_tape = photometric_loss(rendered, photo, 0.2, np.zeros_like(mask))
assert empty_loss == 0 and not photometric_loss_vjp(empty_tape).any()
print("all of the above holds")
