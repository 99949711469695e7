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
# on its surface, a cut through it, a better answer to what a pixel sees of it, lines and triangles in the place of
# ellipses. The last two turn Gaussians into polygons and meshes, for programs that know nothing of Gaussians.
#
# ## Paint on one Gaussian
#
# On the left is a soft ball with three stripes. One plain Gaussian can only take its mean colour. The others have a
# texture of degree 1, 2 and 3, whose coefficients are the best there are, by least squares. Last are five plain
# Gaussians, the better of two trainings: about as many numbers as the one with a texture of degree 3.

# %%
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

from data_tools.claims.analytic import OPACITY, approximations, covariance, truth
from data_tools.claims.cuts import card
from data_tools.claims.fans.profile import fan_profile, profile_error
from data_tools.claims.kit import count_floats, psnr_of
from data_tools.claims.mixed import fit
from data_tools.claims.polygons import edits as polygon_claims
from data_tools.claims.rays.demo import ball as ball_of_discs
from data_tools.claims.textured import colors_across
from figures import BLUE, GREEN, GREY, PLUM, RED, YELLOW, show
from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.analytic.response import NORMAL, integrals
from minisplat_ref.extensions.cuts.response import VERTICES, evaluate_cuts
from minisplat_ref.extensions.fans.model import FanShape, convert_gaussians, mesh_of, render_fans
from minisplat_ref.extensions.mixed import response as hull_response
from minisplat_ref.extensions.polygons.soup import make_soup
from minisplat_ref.extensions.textured.model import add_textures, frames, meet
from minisplat_ref.extensions.textured.recipe import TEXTURED_GAUSSIANS
from minisplat_ref.mechanisms.meshes.fans import fit_spans, rims
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.reference.spherical_harmonics import sh_basis
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Model, view_from

# %% tags=["rounding"]
SIZE = card.SIZE
ys, xs = np.mgrid[:SIZE, :SIZE] + 0.5
centers = np.column_stack([xs.ravel(), ys.ravel()])
one = card.place_cards(1, np.random.default_rng(0))
one = type(one)(*(field.astype(np.float64) for field in one))
one = one._replace(log_scales=np.log(np.full((1, 3), 0.45)), opacity_logits=np.array([4.0]))


def drawn(gaussians, renderer=TEXTURED_GAUSSIANS.renderer):
    """Return the picture of Gaussians before black by a renderer of the reference."""
    return renderer.render(Model(gaussians), view_from(card.CAMERA), Request(backend=REFERENCE))[0].image


def painted(k):
    """Return the Gaussian with coefficients [K, 3] of its colour over the harmonics."""
    degree = round(np.sqrt(len(k))) - 1
    whole = add_textures(one, degree)
    return whole._replace(sh_dc=(k[:1] * SH_C0 - 0.5) / SH_C0, color_textures=k[1:].T.reshape(1, -1))


black = Request(backend=REFERENCE)
alpha = TEXTURED_GAUSSIANS.renderer.render(Model(painted(np.ones((1, 3)))), view_from(card.CAMERA), black)[0].alpha
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
tries = [card.fit_card(card.Target(ball, lambda rows: rows), 5, False, 1500, seed) for seed in (0, 2)]
five = max(tries, key=lambda population: psnr_of(card.render_card(population), ball))

pictures = {f"degree {degree}": (drawn(g), count_floats(g)) for degree, g in textured.items()}
pictures["five plain"] = (card.render_card(five), 5 * count_floats(one))
figure, axes = plt.subplots(1, 6, figsize=(11, 2.4))
show(axes[0], ball, "a soft ball")
for panel, (name, (image, n_floats)) in zip(axes[1:], pictures.items(), strict=True):
    show(panel, image, f"{name}: {psnr_of(image, ball):.1f} dB")
    panel.set_xlabel(f"{n_floats} numbers")
plt.show()

# %% [markdown]
# Paint helps, up to what eight or fifteen waves around a ball can show: they have no sharp edges. And it does not help
# more than as many numbers that are spent on further Gaussians. Trained scenes say the same (`claims textured/counts`).
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
# | `minisplat_ref/extensions/mixed/` | two or three centres: lines and triangles (MP-GS) |
# | `minisplat_ref/extensions/polygons/` | corners that can be edited (REdiSplats) |
# | `minisplat_ref/extensions/fans/` | triangles with a transparent rim (MeshSplats) |
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
    return evaluate_cuts(points[None], np.array([width]), d.reshape(1, -1, 2)).masks.reshape(81, 81)


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
plain = {number: card.fit_card(half, number, False, 300, seed=3) for number in (1, 4)}
with_cut = {seed: card.fit_card(half, 1, True, 300, seed) for seed in (3, 1)}
found = {"1 plain": plain[1], "4 plain": plain[4], "1 with a cut": with_cut[3], "begun left": with_cut[1]}
results = {name: (card.render_card(g), card.measure_card(half, g)) for name, g in found.items()}

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
# ## Lines and triangles
#
# A Gaussian falls off with the distance from a *point*. Let it fall off with the distance from a segment or from a
# triangle instead, and it is a line with round ends, or a patch with soft edges. Below are three targets, and beside
# each two attempts: ellipses, then lines or triangles, the better of two trainings. The first two targets are a line
# and a triangle themselves. The last is fair: a letter is made of none of the three.

# %% tags=["rounding"]
TARGETS = {"line": fit.one_line(), "triangle": fit.one_triangle(), "letter": fit.letter_a()}
ATTEMPTS = {"line": ((3, 1), (1, 2)), "triangle": ((4, 1), (1, 3)), "letter": ((5, 1), (4, 3))}


def best_fit(target, n, n_vertices):
    """Return the better of two fits, its picture and its PSNR."""
    fits = [fit.fit_primitives(target, n, n_vertices=n_vertices, iterations=400, seed=seed) for seed in range(2)]
    pictures = [fit.render_primitives(population) for population in fits]
    psnrs = [psnr_of(image, target) for image in pictures]
    best = int(np.argmax(psnrs))
    return fits[best], pictures[best], psnrs[best]


figure, axes = plt.subplots(1, 9, figsize=(11, 1.9), width_ratios=3 * (1, 1, 1))
attempts = {}
for k, (name, target) in enumerate(TARGETS.items()):
    show(axes[3 * k], target, name)
    for panel, (number, n_vertices) in zip(axes[3 * k + 1 : 3 * k + 3], ATTEMPTS[name], strict=True):
        _, image, psnr = attempts[name, n_vertices] = best_fit(target, number, n_vertices)
        show(panel, image, f"{number} {fit.NAMES[n_vertices][: -1 if number == 1 else None]}\n{psnr:.1f} dB")
        panel.set_xlabel(f"{number * fit.N_FLOATS[n_vertices]} numbers", fontsize=8)
plt.show()

# %% [markdown]
# A line draws a line, and a triangle a triangle; a few ellipses do not. The letter is drawn better by triangles than by
# as many numbers of ellipses, but it is not drawn exactly. One formula covers all three kinds. In whitened pixels
# $y = L^{-1} x$, where $L L^T$ is the covariance that all vertices share,
#
# $$ \alpha = o \exp\left(-\tfrac12 \operatorname{dist}(y, \operatorname{conv}\{y_1, \dots, y_m\})^2\right) . $$
#
# With $m = 1$ that is 3DGS. The paper builds the same from ellipses around the vertices and their common tangents. The
# picture shows lines of equal alpha, and from some pixels the way to the nearest point of the hull. These ways are not
# perpendicular to it, because distance is measured in the metric of the ellipse.

# %%
Q = np.linalg.inv(np.array([[9.0, 4.0], [4.0, 4.0]]))
HULLS = np.array([[-9.0, 4.0], [9.0, -6.0], [5.0, 9.0]])  # vertices, px
side = np.linspace(-20, 20, 81)
pixels = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
some = np.array([[-14.0, -8.0], [0.0, -14.0], [15.0, 4.0], [-4.0, 14.0], [4.0, 2.0], [14.0, -14.0]])


def reached(m, at):
    """Return for pixels [P, 2] the offsets [P, 2] to the nearest points of the hull of m vertices."""
    vertices = np.where(np.arange(3)[:, None] < m, HULLS, HULLS[0])
    return hull_response.nearest(vertices[None], np.array([m]), Q[None], at).offsets[0]


hull_alphas = {}
figure, axes = plt.subplots(1, 3, figsize=(9.5, 3))
for panel, (m, name) in zip(axes, ((1, "ellipse"), (2, "line"), (3, "triangle")), strict=True):
    ways = reached(m, pixels)
    hull_alphas[m] = np.exp(-0.5 * np.einsum("pi,ij,pj->p", ways, Q, ways)).reshape(81, 81)
    show(panel, hull_alphas[m], name, cmap="gray", vmin=0, vmax=1, extent=(-20, 20, 20, -20))
    panel.contour(side, side, hull_alphas[m], [0.05, 0.3, 0.7], colors=[BLUE, GREEN, YELLOW], linewidths=1)
    panel.plot(*HULLS[:m].T, "o", color=RED)
    for pixel, way in zip(some, reached(m, some), strict=True):
        panel.annotate("", pixel + way, pixel, arrowprops={"arrowstyle": "->", "color": PLUM})
plt.show()

# %% [markdown]
# ## Polygons that can be edited
#
# A flat Gaussian can be written down as a polygon: eight corners on the ellipse where it has faded. Any mesh program
# can move corners. Then the way back: which flat Gaussian fits the moved corners best? On the left a checkered sheet of
# polygons; then it is sheared, and bent into a half-pipe. Black are the corners after the edit, red those of the
# Gaussians that fit. Only where the edit is not affine do they differ.

# %%
sheet = polygon_claims.sheet(5)  # of 5 x 5 splats
sheet = sheet._replace(log_scales=sheet.log_scales - np.log(2.5))  # so small that they hardly overlap
soup = make_soup(sheet, 8)
SHEAR = np.array([[1.0, 0.5, 0.0], [0.0, 0.8, 0.0], [0.3, 0.0, 1.0]])
edits = {"at rest": soup.corners, "sheared": soup.corners @ SHEAR.T}
edits["bent by 180 degrees"] = polygon_claims.bend(soup.corners, 180)
misses = {}
figure, axes = plt.subplots(1, 4, figsize=(11, 3), width_ratios=(1, 1, 1, 1.1))
paint = np.column_stack([np.clip(0.5 + SH_C0 * sheet.sh_dc[soup.rows], 0, 1), np.full(len(soup.rows), 0.5)])
for panel, (name, corners) in zip(axes, edits.items(), strict=False):
    refit = rims(*fit_spans(corners, soup.radii), soup.radii, 8)
    misses[name] = np.abs(refit - corners).max()
    seen, seen_refit = (
        in_view[..., :2] / in_view[..., 2:] for in_view in map(polygon_claims.place_sheet, (corners, refit))
    )
    panel.add_collection(PolyCollection(seen, facecolors=paint, edgecolors="black", linewidths=0.6))
    panel.add_collection(PolyCollection(seen_refit, facecolors="none", edgecolors=RED, linewidths=0.7))
    panel.set(aspect="equal", xlim=(-0.42, 0.42), ylim=(0.3, -0.4), xticks=[], yticks=[])
    panel.set_title(f"{name}: off by {misses[name]:.2f}")
per_side, bend_misses = (4, 8, 16, 32), {}
for angle, color in ((45, BLUE), (180, RED)):
    found = []
    for number in per_side:
        these = make_soup(polygon_claims.sheet(number), 8)
        corners = polygon_claims.bend(these.corners, angle)
        refit = rims(*fit_spans(corners, these.radii), these.radii, 8)
        spread = np.sqrt(np.mean((corners - corners.mean(axis=1, keepdims=True)) ** 2))
        found.append(np.sqrt(np.mean((refit - corners) ** 2)) / spread)
    bend_misses[angle] = found
    axes[3].loglog(np.square(per_side), found, "o-", color=color, label=f"bent by {angle} degrees")
axes[3].set(title="corners off, relative to a polygon", xlabel="splats of the sheet")
axes[3].legend()
plt.show()

# %% [markdown]
# With the half axes $S = [s_a e_a,\; s_b e_b]$ and the radius $r$ at which alpha has fallen to 1/291, the corners are
#
# $$ x_j = \mu + r S (\cos\varphi_j, \sin\varphi_j)^T, \qquad
#    S = \frac{2}{n r} \sum_j (x_j - \mu)\,(\cos\varphi_j, \sin\varphi_j) , $$
#
# and the second formula, least squares, is the way back. A shear leaves $S$ with oblique columns, which are turned to
# the axes of the same ellipse. The remaining error of a bend falls as splats become smaller: a small piece of a
# cylinder is nearly flat.
#
# ## Fans: a mesh for any program
#
# The other way round: can a scene be exported as a mesh of triangles that other programs draw? Each Gaussian becomes a
# fan: opaque in the middle, transparent on the rim, linear in between. Left: the profile of a Gaussian, and those of
# three fans. Then the ball of notebook 18 as Gaussians, its mesh, and its fans, of which a pixel draws only the nearest
# layer, the first four, and all (depth peeling).

# %%
SHAPES = {"rim transparent": FanShape(), "rim at 0.2": FanShape(rim=0.2), "reach 3.5": FanShape(reach=3.5)}
radius_of = np.linspace(0, 4, 200)
on_line = np.column_stack([radius_of, np.zeros(200)])
round_ball = ball_of_discs(120)
eye = Camera(np.eye(3), np.zeros(3), 150.0, 150.0, 47.0, 24.0, 64, 64)
LAYERS = (1, 4, None)
request = Request(np.array([0.1, 0.12, 0.16]), backend=REFERENCE)
fans = convert_gaussians(round_ball, FanShape())
as_gaussians = SPLATTING.render(Model(round_ball), view_from(eye), request)[0].image
peeled = {layers: render_fans(Model(fans), view_from(eye), request, max_layers=layers)[0].image for layers in LAYERS}

figure, axes = plt.subplots(1, 6, figsize=(11, 2.4), width_ratios=(1.5, 1, 1, 1, 1, 1))
axes[0].plot(radius_of, np.exp(-(radius_of**2) / 2), color="black", linewidth=3, alpha=0.3, label="Gaussian")
for (name, shape), color in zip(SHAPES.items(), (BLUE, YELLOW, RED), strict=True):
    axes[0].plot(radius_of, fan_profile(on_line, shape), color=color, label=f"{name}: {profile_error(shape):.2f}")
axes[0].set(title="profile, and its error", xlabel="deviations")
axes[0].legend(fontsize=7)
show(axes[1], as_gaussians, "Gaussians")
mesh = mesh_of(fans)
points = mesh.vertices @ eye.cam_from_world_R.T + eye.cam_from_world_t
axes[2].triplot(*(eye.fx * points[:, :2] / points[:, 2:] + [eye.cx, eye.cy]).T, mesh.faces, color=BLUE, linewidth=0.15)
axes[2].set(aspect="equal", xlim=(0, 64), ylim=(64, 0), xticks=[], yticks=[], title=f"{len(mesh.faces)} triangles")
for panel, (layers, image) in zip(axes[3:], peeled.items(), strict=True):
    name = "all layers" if layers is None else f"{layers} layer{'s' * (layers > 1)}"
    show(panel, image, f"{name}: {psnr_of(image, as_gaussians):.1f} dB")
plt.show()

# %% [markdown]
# $$ \operatorname{fan}(r, \theta) = 1 - \frac{r \cos\theta}{k \cos(\pi / n)} \quad \text{up to the rim,} $$
#
# at the distance $r$ from the centre and the angle $\theta$ from the middle of a side. A linear slope is no bell, so
# that a scene loses something; refitting colours, opacities and vertices gives a part of it back (`claims fans/refit`).
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
#     assert count_floats(textured[degree]) == 14 + 4 * ((degree + 1) ** 2 - 1)
# assert count_floats(textured[2]) < 5 * 14 < count_floats(textured[3])
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
assert abs(psnr_of(card.render_card(five), ball) - psnrs[3]) < 3
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
# Lines and triangles draw their own kind exactly; and a letter better than as many numbers of ellipses.
reached_psnr = {key: found_psnr for key, (_, _, found_psnr) in attempts.items()}
assert reached_psnr["line", 2] > 40 > reached_psnr["line", 1]
assert reached_psnr["triangle", 3] > 40 > reached_psnr["triangle", 1]
assert reached_psnr["letter", 3] > reached_psnr["letter", 1] + 2
# A hull of more vertices holds that of fewer.
assert np.all(hull_alphas[1] <= hull_alphas[2] + 1e-12) and np.all(hull_alphas[2] <= hull_alphas[3] + 1e-12)
# An affine edit is carried back exactly, and the error of a bend halves as splats become half as wide.
assert max(misses["at rest"], misses["sheared"]) < 1e-12 and misses["bent by 180 degrees"] > 0.01
falls = np.diff(np.log2(list(bend_misses.values())), axis=1)
assert np.all((falls > -1.3) & (falls < -0.7))
# Of the three fans the first is nearest to a Gaussian; a pixel needs all of its layers.
assert profile_error(FanShape()) == min(map(profile_error, SHAPES.values()))
psnrs_of_layers = [psnr_of(image, as_gaussians) for image in peeled.values()]
assert np.all(np.diff(psnrs_of_layers) > 5) and psnrs_of_layers[-1] > 25
# The mean keeps the light wherever a needle lies, a sample does not.
assert np.isclose(averaged.sum(), whole, rtol=1e-6) and abs(sampled.sum() / whole - 1) > 0.1
assert np.ptp(light["centre"]) > 1 and np.abs(np.array(light["integral, logistic"]) - 1).max() < 0.02
assert min(light["dilation"]) > 2
print("all of the above holds")
