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
# # 04 Compositing, backward
#
# Notebook 03 blended sorted Gaussians into a pixel. Here the error of a pixel travels back to the Gaussians that made
# it. One pixel with three hits is enough to derive every line, and every line is checked at once in two ways: against
# central differences of the renderer, and against `composite_vjp` of the package.
#
# The picture shows three Gaussians, one behind the other, over a light background. The marked pixel sees all of them.
# Its colour is a sum of four lights: the colour of each Gaussian with the weight $w_i = \alpha_i T_i$, and the
# background with the transmittance that is left.

# %%
import math
from dataclasses import replace
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from scipy.optimize import brentq

from figures import BLUE, GREY, RED, draw_ellipses, show_code, show_pixels
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.reference.compositing import blend_tile_vjp, composite, composite_vjp, light_gradient
from minisplat_ref.reference.extent import extents
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import render, render_vjp
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Gaussians, Projection, TileGrid

# %%
WIDTH, HEIGHT = 24, 18
X, Y = 11, 8  # the pixel; its centre is (11.5, 8.5)
STEP = 1e-6  # of central differences; the last section says why


class Inputs(NamedTuple):
    """What composite depends on, and has a derivative with respect to."""

    means2d: np.ndarray  # [N, 2] px
    conics: np.ndarray  # [N, 3] px^-2
    opacities: np.ndarray  # [N]
    colors: np.ndarray  # [N, 3]
    background: np.ndarray  # [3]


def matrices(entries):
    """[[a, b], [b, c]] of (a, b, c) [N, 3]."""
    return entries[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def prepare(inputs):
    """Arguments of composite: nearest first, each Gaussian's box as far as its alpha is visible."""
    camera = Camera(np.eye(3), np.zeros(3), 1.0, 1.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    covariances2d = np.linalg.inv(matrices(inputs.conics))
    radii, boxes = extents(inputs.means2d, covariances2d, inputs.opacities, camera, GSPLAT_MAIN)
    depths = np.arange(1, len(radii) + 1, dtype=inputs.means2d.dtype)
    projection = Projection(
        inputs.means2d, depths, inputs.conics, inputs.opacities, radii.astype(np.int32), boxes.astype(np.int32)
    )
    bins = bin_gaussians(projection, TileGrid(WIDTH, HEIGHT, WIDTH, HEIGHT), GSPLAT_MAIN)
    return projection, inputs.colors, inputs.background, bins, GSPLAT_MAIN


covariances2d = np.array([[[9.0, 4.0], [4.0, 6.0]], [[20.0, -8.0], [-8.0, 9.0]], [[12.0, 3.0], [3.0, 16.0]]])  # px^2
inputs = Inputs(
    means2d=np.array([[9.3, 7.2], [13.4, 7.1], [12.1, 11.9]]),
    conics=np.linalg.inv(covariances2d).reshape(3, 4)[:, [0, 1, 3]],
    opacities=np.array([0.6, 0.8, 0.9]),
    colors=np.array([[0.82, 0.29, 0.25], [0.88, 0.65, 0.15], [0.21, 0.38, 0.55]]),
    background=np.array([0.90, 0.88, 0.85]),
)
output = composite(*prepare(inputs))
hits = next(tile_hits(prepare(inputs)[0], prepare(inputs)[3], GSPLAT_MAIN))
p = Y * WIDTH + X  # the pixel's column in the arrays of a tile
alphas, T = hits.alphas[:, p], hits.transmittances[:, p]  # [3], [4]

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), width_ratios=[1.25, 1])
show_pixels(left, output.image, "three Gaussians, one standard deviation drawn")
for n, name in enumerate(("near", "middle", "far")):
    draw_ellipses(left, inputs.means2d[n], covariances2d[n], edgecolor="black", linewidth=1)
    left.annotate(name, inputs.means2d[n], ha="center", va="center", fontsize=8)
left.add_patch(Rectangle((X, Y), 1, 1, fill=False, edgecolor="black", linewidth=2))
lights = [*(alphas * T[:3]), T[3]]
swatches = [*inputs.colors, inputs.background]
right.bar(range(4), lights, color=swatches, edgecolor="black", linewidth=0.8, width=0.6)
right.step(np.arange(5) - 0.5, [*T, T[3]], where="post", color="black", linewidth=1, label="transmittance T before it")
for i, light in enumerate(lights):
    right.annotate(f"{light:.3f}", (i, light), ha="center", va="bottom", xytext=(0, 1), textcoords="offset points")
right.set_xticks(range(4), ["near", "middle", "far", "background"])
right.set(title=f"weights in the marked pixel ({X}, {Y}); they add up to 1", ylabel="weight", ylim=(0, 1.08))
right.legend(frameon=False)
plt.show()

# %% [markdown]
# | file | what it holds | equation |
# |---|---|---|
# | `minisplat_ref/reference/hits.py` | alpha of each hit, transmittance before it | 3DGS (3), (4) |
# | `minisplat_ref/reference/compositing.py` | `composite` and `composite_vjp` | 3DGS (3) |
#
# *3DGS* is Kerbl et al. 2023. **Frames and units:** everything is in the image, in pixels, x right, y down, the centre
# of the top-left pixel at (0.5, 0.5). Conics are in 1/px². Colours, opacities and the loss have no unit. $v_x$ always
# means $\partial L / \partial x$ and has the shape of $x$.
#
# ## One pixel, three hits
#
# With $d_i = p_i - (11.5, 8.5)$ from the pixel's centre to the Gaussian's, the conic $Q_i = \begin{pmatrix} a & b \\ b
# & c \end{pmatrix}$, and $i$ counted from the nearest:
#
# $$ \sigma_i = \tfrac12 d_i^\top Q_i d_i, \quad E_i = e^{-\sigma_i}, \quad \alpha_i = o_i E_i, \quad
#    T_i = \prod_{j<i} (1 - \alpha_j) \tag{3DGS 3, 4} $$
#
# $$ C = \sum_i \alpha_i T_i c_i + T_{\rm end}\, b, \qquad A = 1 - T_{\rm end} \tag{3DGS 3} $$
#
# $C$ is the pixel's colour and $A$ its alpha channel; $b$ in the second line is the background. A loss depends on both.
# To first order any loss is linear in them, so we may as well take a linear one,
#
# $$ L = \langle v, C \rangle + v_A A . $$
#
# These few scalar lines are the subject of this notebook. Here they are once more as code, for this pixel only:

# %%
v, v_A = np.array([0.9, 0.5, 0.7]), 0.3  # derivatives of some loss with respect to the pixel's colour and its alpha


def hit(mean, conic, opacity):
    """Offset, falloff and alpha of one hit."""
    dx, dy = mean[0] - (X + 0.5), mean[1] - (Y + 0.5)
    a, b, c = conic
    E = math.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    return dx, dy, E, opacity * E


def pixel_loss(alphas, colors, background):
    """L = <v, C> + v_A A, front to back."""
    loss, T = 0.0, 1.0
    for alpha, color in zip(alphas, colors, strict=True):
        loss += alpha * T * (v @ color)
        T *= 1 - alpha
    return loss + T * (v @ background) + v_A * (1 - T)


def loss(inputs):
    """Evaluate the same loss with the package's renderer."""
    output = composite(*prepare(inputs))
    return v @ output.image[Y, X] + v_A * output.alpha[Y, X]


def gradient(inputs, v_image=None, v_alpha=None):
    """Return the gradient as the package computes it; by default that of this pixel's loss."""
    if v_image is None:
        v_image, v_alpha = np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH))
        v_image[Y, X], v_alpha[Y, X] = v, v_A
    arguments = prepare(inputs)
    return composite_vjp(*arguments, composite(*arguments), v_image, v_alpha)


def differences(function, values, step=STEP):
    """Central differences of a scalar function with respect to every entry of an array."""
    numeric = np.zeros_like(values)
    for k in range(values.size):
        up, down = values.copy(), values.copy()
        up.flat[k] += step
        down.flat[k] -= step
        numeric.flat[k] = (function(up) - function(down)) / (2 * step)
    return numeric


def by_differences(name):
    """Central differences of the package's renderer with respect to one of the inputs."""
    return differences(lambda values: loss(inputs._replace(**{name: values})), getattr(inputs, name))


errors = {}  # of every line below, for the last cell


def check(name, by_hand, numeric, by_package=None):
    """Print the columns side by side and note the largest error, relative to the largest entry."""
    by_hand, columns = np.asarray(by_hand), [numeric] + ([] if by_package is None else [by_package])
    print(f"{name:<14}{'by hand':>14}{'differences':>14}" + ("" if by_package is None else f"{'composite_vjp':>15}"))
    for index in np.ndindex(by_hand.shape):
        print(f"  {list(index)!s:<12}{by_hand[index]:14.6f}" + "".join(f"{x[index]:14.6f}" for x in columns))
    size = np.abs(numeric).max()
    errors[name] = [np.abs(by_hand - x).max() / size for x in columns]
    print("  largest error  " + "  ".join(f"{error:.1e}" for error in errors[name]))


print(f"pixel by the scalar lines {pixel_loss(alphas, inputs.colors, inputs.background):.12f}")
print(f"pixel by composite        {loss(inputs):.12f}")

# %% [markdown]
# ## 1 Colours and background
#
# $C$ is linear in both, with the weights as coefficients:
#
# $$ v_{c_i} = w_i\, v, \quad w_i = \alpha_i T_i, \qquad\qquad v_b = T_{\rm end}\, v . $$
#
# The alpha channel has no colour, so $v_A$ does not appear.

# %%
package = gradient(inputs)
weights, T_end = alphas * T[:3], T[3]
check("v_color", np.outer(weights, v), by_differences("colors"), package.colors)
check("v_background", T_end * v, by_differences("background"), package.background)

# %% [markdown]
# ## 2 Alpha of a hit
#
# $\alpha_i$ does two things: it adds the Gaussian's own light, and it dims everything behind. Dimming is one factor
# $1 - \alpha_i$ in every later transmittance, including $T_{\rm end}$, so
#
# $$ \frac{\partial T_j}{\partial \alpha_i} = -\frac{T_j}{1 - \alpha_i} \;\; (j > i), \qquad
#    \frac{\partial A}{\partial \alpha_i} = +\frac{T_{\rm end}}{1 - \alpha_i} . $$
#
# Collect everything behind in one number, and the derivative has two terms:
#
# $$ S_i = \sum_{j>i} w_j \langle v, c_j \rangle + T_{\rm end} \left( \langle v, b \rangle - v_A \right), \qquad
#    v_{\alpha_i} = T_i \langle v, c_i \rangle - \frac{S_i}{1 - \alpha_i} . $$

# %%
light = inputs.colors @ v  # [3] <v, c_i>
S = np.array([weights[i + 1 :] @ light[i + 1 :] + T_end * (v @ inputs.background - v_A) for i in range(3)])
own, dimmed = T[:3] * light, -S / (1 - alphas)
v_alphas = own + dimmed
numeric = differences(lambda values: pixel_loss(values, inputs.colors, inputs.background), alphas)
check("v_alpha", v_alphas, numeric)

# %% [markdown]
# The picture shows the two terms and their sum. They largely cancel: what counts is the *difference* between the colour
# of a Gaussian and the colour $R_i$ of what it hides. Indeed
#
# $$ S_i = (1 - \alpha_i)\, T_i \left(\langle v, R_i \rangle - v_A t_i\right), \qquad t_i = T_{\rm end} / T_{i+1}, $$
#
# where $t_i$ is the share of the background's light that passes through everything behind hit $i$. The image gives no
# gradient to the opacity of a Gaussian in front of others of the same colour.

# %%
behind = [
    (weights[i + 1 :] @ inputs.colors[i + 1 :] + T_end * inputs.background) / (T[i] * (1 - alphas[i])) for i in range(3)
]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), width_ratios=[1, 1.7])
for i in range(3):
    left.add_patch(Rectangle((0, 2 - i), 1, 0.8, facecolor=inputs.colors[i], edgecolor="black"))
    left.add_patch(Rectangle((1.2, 2 - i), 1, 0.8, facecolor=behind[i], edgecolor="black"))
left.set(xlim=(-0.1, 2.3), ylim=(-0.1, 2.9), title="colours in this pixel", xticks=[0.5, 1.7], yticks=[0.4, 1.4, 2.4])
left.set_xticklabels(["the hit's own $c_i$", "behind it $R_i$"])
left.set_yticklabels(["far", "middle", "near"])
left.spines[:].set_visible(False)
left.tick_params(length=0)
rows = np.arange(3)
right.bar(rows - 0.25, own, 0.22, color=BLUE, label=r"own light  $T_i \langle v, c_i \rangle$")
right.bar(rows, dimmed, 0.22, color=RED, label=r"dims what is behind  $-S_i / (1 - \alpha_i)$")
right.bar(rows + 0.25, v_alphas, 0.22, color=GREY, label=r"sum  $v_{\alpha_i}$")
right.plot(rows + 0.25, numeric, "kx", label="central differences")
right.axhline(0, color="black", linewidth=0.8)
right.set_xticks(rows, ["near", "middle", "far"])
right.set(title=r"the two terms of $v_{\alpha_i}$", ylim=(None, 1.1 * own.max()))
right.legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# **In one sweep.** A kernel does not store $T_i$ and $S_i$ for every hit. It goes from the last hit to the first and
# carries two scalars: $T$ starts at $T_{\rm end}$ and is divided by $1 - \alpha_i$, and $S$ starts with the
# background's share and accumulates $w_i \langle v, c_i \rangle$. The division is the reason why alpha is clamped at
# 0.99: at 1 it would be 0/0.

# %%
T_running, S_running = T_end, T_end * (v @ inputs.background - v_A)
swept = np.zeros(3)
for i in reversed(range(3)):
    T_running /= 1 - alphas[i]  # now T before hit i
    swept[i] = T_running * light[i] - S_running / (1 - alphas[i])
    S_running += alphas[i] * T_running * light[i]
print("v_alpha, back to front:", swept, f" T before the first hit: {T_running:.12f}")

# %% [markdown]
# ## 3 Opacity
#
# $\alpha = o E$ is a product:
#
# $$ v_o = E\, v_\alpha, \qquad v_E = o\, v_\alpha . $$
#
# Where $o E$ exceeds 0.99, alpha is constant and both are zero: that is the derivative of what is computed. (The
# profile `INRIA` lets the gradient pass there, as that code does: `clamp_stops_mean_gradient`,
# `clamp_stops_shape_gradient`.)

# %%
dx, dy, E, alphas_by_hand = np.array([hit(*values) for values in zip(*inputs[:3], strict=True)]).T  # [3] each
check("v_opacity", E * v_alphas, by_differences("opacities"), package.opacities)

# %% [markdown]
# ## 4 The exponent
#
# $E = e^{-\sigma}$ is its own derivative, with a minus sign. So everything that concerns the shape passes through one
# number per hit:
#
# $$ v_\sigma = -o E\, v_\alpha = -\alpha\, v_\alpha . $$

# %%
v_sigma = -alphas_by_hand * v_alphas
numeric = differences(
    lambda sigmas: pixel_loss(inputs.opacities * np.exp(-sigmas), inputs.colors, inputs.background), -np.log(E)
)
check("v_sigma", v_sigma, numeric)

# %% [markdown]
# ## 5 Mean
#
# $\sigma = \tfrac12 d^\top Q d$ with symmetric $Q$, and $d = p - \text{pixel centre}$, so $\partial d / \partial p =
# I$:
#
# $$ v_p = v_\sigma\, Q d = v_\sigma \begin{pmatrix} a\,dx + b\,dy \\ b\,dx + c\,dy \end{pmatrix} . $$
#
# The sign depends on the direction of $d$: a renderer with $d = \text{pixel centre} - p$ has a minus here.

# %%
a, b, c = inputs.conics.T
v_means2d = v_sigma[:, None] * np.column_stack([a * dx + b * dy, b * dx + c * dy])
check("v_mean2d", v_means2d, by_differences("means2d"), package.means2d)

# %% [markdown]
# ## 6 Conic
#
# Written out, $\sigma = \tfrac12 a\,dx^2 + b\,dx\,dy + \tfrac12 c\,dy^2$. The number $b$ occurs *twice* in the
# matrix $Q$, so its two halves add up and its derivative has no $\tfrac12$:
#
# $$ v_a = \tfrac12 dx^2\, v_\sigma, \qquad v_b = dx\,dy\, v_\sigma, \qquad v_c = \tfrac12 dy^2\, v_\sigma . $$

# %%
v_conics = v_sigma[:, None] * np.column_stack([0.5 * dx * dx, dx * dy, 0.5 * dy * dy])
check("v_conic", v_conics, by_differences("conics"), package.conics)

# %% [markdown]
# That is all. The package does the same for a whole tile at once, with hits along the rows and pixels along the
# columns. Sections 1 and 2 are these functions; what an ellipse does to a pixel, sections 3 to 6, is `conic_hit_vjp` of
# `reference/hits.py`. Only relatives of 3DGS have a `shading`:

# %%
show_code(light_gradient)
print()
show_code(blend_tile_vjp)

# %% [markdown]
# ## What each parameter does to the picture
#
# A gradient is a sum over pixels. Before the sum, every pixel has its own derivative, and these make pictures: how the
# image changes when one parameter of the near Gaussian grows a little. Red pixels become brighter and blue ones darker.
# They come from `composite_vjp` with one pixel after the other switched on and all three channels weighted equally.

# %%
maps = {name: np.zeros((HEIGHT, WIDTH)) for name in ("opacity", "x", "y", "a", "b", "c")}
for y, x in np.ndindex(HEIGHT, WIDTH):
    v_image = np.zeros((HEIGHT, WIDTH, 3))
    v_image[y, x] = 1 / 3
    one = gradient(inputs, v_image, np.zeros((HEIGHT, WIDTH)))
    for name, value in zip(maps, [one.opacities[0], *one.means2d[0], *one.conics[0]], strict=True):
        maps[name][y, x] = value

units = dict(zip(maps, ("", " / px", " / px", " px$^2$", " px$^2$", " px$^2$"), strict=True))
figure, axes = plt.subplots(2, 3, figsize=(10, 5.2), sharex=True, sharey=True)
for panel, (name, values) in zip(axes.ravel(), maps.items(), strict=True):
    reach = np.abs(values).max()
    show_pixels(
        panel, values, f"d image / d {name}   (±{reach:.2g}{units[name]})", cmap="RdBu_r", vmin=-reach, vmax=reach
    )
    draw_ellipses(panel, inputs.means2d[0], covariances2d[0], edgecolor="black", linewidth=0.8)
    panel.set(xticks=range(0, 25, 6), yticks=range(0, 19, 6))
    panel.add_patch(Rectangle((X, Y), 1, 1, fill=False, edgecolor="black", linewidth=1))
    panel.label_outer()
plt.show()

# %% [markdown]
# The near Gaussian is darker than most of what lies behind it, so a higher opacity darkens the image. The maps of $x$
# and $y$ have two lobes, one on either side. The conic is an *inverse* covariance, so a larger $a$ or $c$ makes the
# ellipse narrower and lets the light from behind through. The map of $b$ changes its sign from quadrant to quadrant, as
# $dx\,dy$ does, so parts of it cancel in the sum over the pixels.
#
# ## A wrong factor, and the check that finds it
#
# This mistake exists in released code: $v_b$ with the factor $\tfrac12$ of its neighbours $v_a$ and $v_c$. It is easily
# made. The 3DGS code stores half of $v_b$ on purpose, meaning *one* of the two equal entries of the matrix, and doubles
# it in the next stage. A port that copies the first step without the second is wrong from there on.
#
# We plant the error and look at it in four ways.

# %%
rng = np.random.default_rng(0)


def halved_vjp(*arguments):
    """composite_vjp with the wrong factor."""
    right = composite_vjp(*arguments)
    return right._replace(conics=right.conics * np.array([1, 0.5, 1]))


def error_by_differences(vjp, inputs, v_image, v_alpha, name):
    """Relative error of one gradient over the whole image, along one random direction."""

    def image_loss(inputs):
        output = composite(*prepare(inputs))
        return np.vdot(v_image, output.image) + np.vdot(v_alpha, output.alpha)

    arguments = prepare(inputs)
    analytic = getattr(vjp(*arguments, composite(*arguments), v_image, v_alpha), name)
    direction = np.random.default_rng(1).uniform(-1, 1, analytic.shape)
    up, down = (image_loss(inputs._replace(**{name: getattr(inputs, name) + s * 1e-7 * direction})) for s in (1, -1))
    # Relative to the sum of the terms' sizes, so that a direction whose terms happen to cancel does not look wrong.
    return abs((up - down) / 2e-7 - np.vdot(analytic, direction)) / np.abs(analytic * direction).sum()


def cosine(x, y):
    """Cosine of the angle between two gradients."""
    return float(np.vdot(x, y) / np.linalg.norm(x) / np.linalg.norm(y))


v_image, v_alpha = rng.normal(size=(HEIGHT, WIDTH, 3)), rng.normal(size=(HEIGHT, WIDTH))

numeric = by_differences("conics")
halved = package.conics * np.array([1, 0.5, 1])
pixel_error = np.abs(halved - numeric)[:, 1] / np.abs(numeric)[:, 1]
print("1  v_b of the three hits in our pixel, relative error:", pixel_error.round(6))

on_axis = inputs._replace(means2d=inputs.means2d * [1, 0] + [0, Y + 0.5])  # dy = 0 for all three hits
print("2  the same with the pixel at the height of the Gaussians: v_b =", gradient(on_axis).conics[:, 1])

flat = [
    np.concatenate([np.ravel(x) for x in (g.means2d, conics, g.opacities, g.colors)])
    for g in [package]
    for conics in (g.conics, halved)
]
similarity = cosine(*flat)
print(f"3  cosine of the whole gradient, right and wrong: {similarity:.6f}")

print("4  one inner product for each input, over the whole image:")
inner_errors = {
    (name, label): error_by_differences(vjp, inputs, v_image, v_alpha, name)
    for name in Inputs._fields
    for label, vjp in (("right", composite_vjp), ("halved", halved_vjp))
}
for name in Inputs._fields:
    print(f"     {name:<12} as derived {inner_errors[name, 'right']:.1e}   halved {inner_errors[name, 'halved']:.1e}")

# %% [markdown]
# 1. Entry by entry the error is exactly one half. This check finds it.
# 2. Where $dx\,dy = 0$ the check finds nothing, because zero equals half of zero. A test must first show that what it
#    compares is not zero.
# 3. A cosine over everything is close to 1: only the entries $v_b$ of a long vector are wrong. Compare input by input.
# 4. An inner product $\langle v, \mathrm{d}f(u) \rangle = \langle f^{\ast} v, u \rangle$ with a random direction $u$
#    needs two renderings per input, whatever its size, and finds the error, too.
#
# Further back, the gradient of the conic becomes that of scales and rotations. A backend is a value, so the wrong stage
# can be swapped into the whole renderer. Here are twelve Gaussians in space, all stages in NumPy, every parameter
# against central differences:

# %%
camera = Camera(np.eye(3), np.zeros(3), 30.0, 30.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
n = 12
z = 3 + rng.uniform(-0.8, 0.8, n)  # world frame = camera frame, world units
gaussians = Gaussians(
    means=np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)) * z[:, None], z]),
    quats=rng.normal(size=(n, 4)),
    log_scales=np.log(0.15) + rng.uniform(-0.7, 0.7, (n, 3)),
    opacity_logits=rng.normal(size=n),
    sh_dc=rng.normal(size=(n, 3)),
    sh_rest=np.zeros((n, 0, 3)),
)
wrong_backend = replace(REFERENCE, name="halved", composite_vjp=halved_vjp)
gradients = [
    render_vjp(render(gaussians, camera, backend=backend)[1], v_image).gaussians
    for backend in (REFERENCE, wrong_backend)
]


def scene_loss(gaussians):
    """<v, image> of a population."""
    return np.vdot(v_image, render(gaussians, camera, backend=REFERENCE)[0].image)


names = ("means", "quats", "log_scales", "opacity_logits", "sh_dc")
scene_errors = np.zeros((2, len(names)))
for k, name in enumerate(names):

    def loss_by(values, name=name):
        """Loss as a function of one field."""
        return scene_loss(gaussians._replace(**{name: values}))

    numeric = differences(loss_by, getattr(gaussians, name), step=1e-7)
    for row, analytic in enumerate(gradients):
        scene_errors[row, k] = np.linalg.norm(getattr(analytic, name) - numeric) / np.linalg.norm(numeric)

figure, axes = plt.subplots(figsize=(8, 3))
axes.bar(np.arange(5) - 0.2, scene_errors[0], 0.35, color=BLUE, label="as derived")
axes.bar(np.arange(5) + 0.2, scene_errors[1], 0.35, color=RED, label=r"$v_b$ halved")
axes.set(
    yscale="log",
    ylabel="relative error",
    ylim=(1e-10, 10),
    title="gradients of twelve 3D Gaussians against central differences",
)
axes.set_xticks(range(5), names)
axes.legend(frameon=False, ncols=2, loc="upper left")
plt.show()

# %% [markdown]
# Opacities and colours are right, means are slightly off, scales and rotations are off by tens of per cent. The loss of
# a training still goes down, only less: a gradient check shows the error, a loss curve does not.
#
# ## Where there is no derivative
#
# A hit with $\alpha < 1/255$ is skipped. At that threshold the image *jumps*: $L$ is linear in $\alpha_i$, so the step
# is exactly $v_{\alpha_i} / 255$. The derivative treats the set of hits as fixed, which is right on both sides
# of the jump. Central differences that straddle the jump are wrong: they divide it by $2h$. Below, the near Gaussian
# moves to the left, away from the pixel, until its hit is skipped.

# %%
steps = np.logspace(-11, 0, 45)  # px


def at(x, dtype=np.float64):
    """Inputs with the near Gaussian's centre moved to x."""
    moved = inputs.means2d.copy()
    moved[0, 0] = x
    return Inputs(*(field.astype(dtype) for field in inputs._replace(means2d=moved)))


def loss_at(x, dtype=np.float64):
    """Loss of the pixel, rendered in a dtype."""
    output = composite(*prepare(at(dtype(x), dtype)))
    return output.image[Y, X] @ v.astype(dtype) + dtype(v_A) * output.alpha[Y, X]


def alpha_at(x):
    """Alpha of the near Gaussian in the pixel, before the threshold."""
    return hit((x, inputs.means2d[0, 1]), inputs.conics[0], inputs.opacities[0])[3]


threshold = brentq(lambda x: alpha_at(x) - 1 / 255, -5, 8, xtol=1e-15)
far_from_it, near_it = 8.0, threshold + 1e-3
jump = loss_at(threshold + 1e-9) - loss_at(threshold - 1e-9)


def step_errors(x, dtype=np.float64):
    """Relative error of central differences with respect to x; float32 renders, but the quotient is exact."""
    exact = gradient(at(x)).means2d[0, 0]
    slopes = [(float(loss_at(x + h, dtype)) - float(loss_at(x - h, dtype))) / (2 * h) for h in steps]
    return np.abs(np.array(slopes) - exact) / abs(exact)


curves = {
    "float64, far from a threshold": (step_errors(far_from_it), BLUE, "-"),
    "float64, 0.001 px from it": (step_errors(near_it), RED, "-"),
    "float32, far from a threshold": (step_errors(far_from_it, np.float32), GREY, "--"),
}
figure, (whole, zoom, error) = plt.subplots(1, 3, figsize=(12, 3.5), width_ratios=[1, 1, 1.5])
xs = np.linspace(0, 12, 300)
whole.plot(xs, [loss_at(x) for x in xs], color="black")
whole.axvline(threshold, color=GREY, linewidth=0.8)
whole.set(title="loss as the near Gaussian moves", xlabel="its centre x [px]", ylabel="L")
for side in (-1, 1):
    xs = threshold + side * np.linspace(1e-9, 0.1, 50)
    zoom.plot(xs - threshold, [loss_at(x) for x in xs], color="black")
zoom.annotate(
    f"jump {jump:.1e}",
    (0, loss_at(threshold - 0.01) + jump / 2),
    xytext=(8, 0),
    textcoords="offset points",
    va="center",
)
zoom.set(title=r"the same at $\alpha = 1/255$", xlabel=f"x - {threshold:.3f} [px]")
zoom.ticklabel_format(axis="y", useOffset=False)
for label, (values, color, line) in curves.items():
    error.loglog(steps, values, line, color=color, label=label)
error.axvline(STEP, color=GREY, linewidth=0.8)
error.annotate("step used here", (1.3 * STEP, 2e-12), fontsize=8, color=GREY)
error.set(title="error of central differences", xlabel="step h [px]", ylabel="relative error", ylim=(1e-12, 1e8))
error.legend(frameon=False, fontsize=8, loc="upper center")
plt.show()

# %% [markdown]
# Each curve has three parts. On the left is rounding: the loss is known to about $10^{-16}$ and the quotient to
# $10^{-16} / h$. On the right is curvature: the error grows as $h^2$. The best step lies in between, at $10^{-6}$ to
# $10^{-4}$ px in float64. The red curve leaves the others as soon as the step crosses the threshold, and from there its
# error is not a few per cent but up to hundreds of times the gradient, so that a right derivative looks wrong. In
# float32 the best step leaves an error of $10^{-4}$, and a step of $10^{-6}$ px says nothing. Therefore: **check
# gradients in float64, with a small step, on scenes with no hit near a threshold**, and check the float32 kernel
# against the float64 one. The same is true of the stop at $T \le 10^{-4}$ and of two Gaussians of equal depth, whose
# order flips.
#
# ## Play
#
# What decides whether a Gaussian becomes more opaque or less? Change the near Gaussian or the loss, and run the cell.
# What to look for:
#
# * `near_color`: give it the colour of what it hides, the swatch `behind it` further up. Its bar of $v_\alpha$
#   vanishes.
# * `my_v`: the sign of the loss. With `-v` every bar flips.
# * `near_opacity`: raise it to 0.95. The bars of the others shrink, since less light reaches them.

# %%
near_color, near_opacity = np.array([0.82, 0.29, 0.25]), 0.6
my_v = v

mine = inputs._replace(
    colors=np.vstack([near_color, inputs.colors[1:]]), opacities=np.array([near_opacity, *inputs.opacities[1:]])
)
v_image_mine = np.zeros((HEIGHT, WIDTH, 3))
v_image_mine[Y, X] = my_v
v_opacities = gradient(mine, v_image_mine, np.zeros((HEIGHT, WIDTH))).opacities
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 2.8))
show_pixels(left, composite(*prepare(mine)).image, "yours")
left.add_patch(Rectangle((X, Y), 1, 1, fill=False, edgecolor="black", linewidth=2))
right.bar(["near", "middle", "far"], v_opacities, color=mine.colors, edgecolor="black", linewidth=0.5)
right.axhline(0, color="black", linewidth=0.8)
right.set(title="gradient with respect to the opacities")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Derive the gradient with respect to the *logit* $\ell$ of an opacity, $o = 1 / (1 + e^{-\ell})$, which is what
# training changes. Where does a Gaussian learn fastest?
#
# <details>
# <summary>Solution</summary>
#
# $\mathrm{d}o / \mathrm{d}\ell = o\,(1 - o)$, so $v_\ell = o\,(1 - o)\,v_o$. It is largest at $o = \tfrac12$; a
# Gaussian that is nearly opaque, or nearly gone, hardly moves.
#
# ```python
# logits = np.log(inputs.opacities / (1 - inputs.opacities))
# v_logits = inputs.opacities * (1 - inputs.opacities) * package.opacities
# of_logits = differences(lambda l: loss(inputs._replace(opacities=1 / (1 + np.exp(-l)))), logits)
# assert np.allclose(v_logits, of_logits, rtol=1e-6)
# ```
#
# </details>
#
# **2.** The conic is the inverse of the covariance, $Q = \Sigma'^{-1}$. Turn $v_Q$ into $v_{\Sigma'}$. Use a symmetric
# matrix for $v_Q$; what stands off its diagonal?
#
# <details>
# <summary>Solution</summary>
#
# From $\mathrm{d}Q = -Q\,\mathrm{d}\Sigma'\,Q$ follows $v_{\Sigma'} = -Q\,v_Q\,Q$ for symmetric matrices. The number
# $b$ occurs twice, so *half* of $v_b$ stands at each of its two places. That is the half which the planted error forgot
# to double.
#
# ```python
# v_Q = matrices(package.conics * [1, 0.5, 1])
# Q = matrices(inputs.conics)
# v_Sigma = -Q @ v_Q @ Q
# upper = covariances2d[:, [0, 0, 1], [0, 1, 1]]  # a, b, c of the covariances
# of_upper = differences(
#     lambda s: loss(inputs._replace(conics=np.linalg.inv(matrices(s)).reshape(3, 4)[:, [0, 1, 3]])), upper
# )
# expected = v_Sigma[:, [0, 0, 1], [0, 1, 1]] * [1, 2, 1]
# assert np.allclose(expected, of_upper, rtol=1e-4, atol=1e-9)
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
assert set(errors) == {"v_color", "v_background", "v_alpha", "v_opacity", "v_sigma", "v_mean2d", "v_conic"}
for name, (numeric_error, *package_error) in errors.items():
    assert numeric_error < 1e-7, f"{name} by hand is not what central differences say"
    assert all(e < 1e-13 for e in package_error), f"{name} by hand is not what composite_vjp says"
for gradient_of_input in package:
    assert np.abs(gradient_of_input).max() > 1e-3, "a gradient is zero: nothing was checked"
assert abs(pixel_loss(alphas, inputs.colors, inputs.background) - loss(inputs)) < 1e-15
assert np.allclose(swept, v_alphas, rtol=1e-13) and abs(T_running - 1) < 1e-14, "the sweep from back to front"

# The planted factor: exactly a half entry by entry, caught by the inner product, missed where dx dy = 0.
assert np.allclose(pixel_error, 0.5, atol=1e-6)
assert all(inner_errors[name, "right"] < 1e-6 for name in Inputs._fields)
assert inner_errors["conics", "halved"] > 0.05
assert all(inner_errors[name, "halved"] < 1e-6 for name in Inputs._fields if name != "conics")
assert np.all(gradient(on_axis).conics[:, 1] == 0) and np.all(gradient(on_axis).conics[:, 0] != 0)
assert similarity > 0.95, "a cosine over everything misses it"
assert scene_errors[0].max() < 1e-6 and scene_errors[1, 1:3].min() > 0.1 and scene_errors[1, 3:].max() < 1e-6

# The jump at 1/255 and the step of the differences.
v_alpha_at_threshold = gradient(at(threshold + 1e-9)).opacities[0] / (alpha_at(threshold) / inputs.opacities[0])
assert np.isclose(jump, v_alpha_at_threshold / 255, rtol=1e-6) and abs(jump) > 1e-4
best = {label: values.min() for label, (values, _, _) in curves.items()}
assert best["float64, far from a threshold"] < 1e-9 < 1e-5 < best["float32, far from a threshold"]
straddling = curves["float64, 0.001 px from it"][0][(steps > 1.1e-3) & (steps < 1e-2)]
assert straddling.min() > 0.5, "differences across the jump are no derivative"
print("all of the above holds")
