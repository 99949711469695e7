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
# # 01 Covariance and projection
#
# A 3D Gaussian is an ellipsoid of fog, and a camera sees it as an ellipse of fog. This notebook follows one Gaussian
# from the ten numbers of its shape (a mean, a quaternion, three scales) to the pixels that it touches.
#
# Here is the whole way in one picture. Left: the surface at one standard deviation, and a camera that looks at it.
# Right: what that camera renders, with the contours at one, two and three standard deviations of the projected
# Gaussian.

# %%
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from figures import BLUE, GREEN, GREY, RED, YELLOW, draw_ellipses, show_code, show_pixels
from minisplat_ref.constants import GSPLAT_MAIN, INRIA
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.reference.compositing import composite
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.pinhole import pinhole, pinhole_jacobians, pinhole_rays, slope_limits
from minisplat_ref.reference.projection import project
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.types import Camera, TileGrid


def ellipsoid(mean, covariance, n_sigmas=1.0, n=40):
    """Surface points of an ellipsoid: any square root of the covariance maps the unit sphere onto it."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, n))
    sphere = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )  # [n, n, 3]
    return np.moveaxis(mean + n_sigmas * sphere @ np.linalg.cholesky(covariance).T, -1, 0)


def covariance2d(projection, n=0):
    """2D covariance of a projected Gaussian, from its conic."""
    a, b, c = projection.conics[n]
    return np.linalg.inv(np.array([[a, b], [b, c]]))


def splat(projection, colors, camera, conventions=GSPLAT_MAIN, background=(0.97, 0.96, 0.94)):
    """Image of projected Gaussians: the stages of notebook 03."""
    bins = bin_gaussians(projection, TileGrid(camera.width, camera.height, 16, 16), conventions)
    return composite(projection, np.array(colors, float), np.array(background), bins, conventions)


# %%
mean = np.array([[0.0, 0.0, 0.5]])
quat = np.array([[0.85, 0.30, -0.25, 0.35]])  # wxyz; its length does not matter
scale = np.array([[0.45, 0.16, 0.06]])  # standard deviations along the Gaussian's own axes, metres
opacity = np.array([0.95])
camera = look_at(np.array([1.6, -1.5, 1.3]), np.array([0.0, 0.0, 0.45]), focal=80.0, width=80, height=60)

Sigma = covariances(quat, scale)  # [1, 3, 3] world frame, square metres
projection = project(mean, quat, scale, opacity, camera, GSPLAT_MAIN)

figure = plt.figure(figsize=(9.5, 3.9))
space, image = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
space.plot_surface(*ellipsoid(mean[0], Sigma[0]), color=RED, alpha=0.85, linewidth=0)
center = camera.center
corners = np.array([[0, 0], [80, 0], [80, 60], [0, 60], [0, 0]])
rays = pinhole_rays(*corners.T, camera) @ camera.cam_from_world_R
for ray in rays:
    space.plot(*np.stack([center, center + 0.8 * ray]).T, color=BLUE, linewidth=0.8)
space.plot(*(center + 0.8 * rays).T, color=BLUE)
space.text(*np.add(center, [0, 0, 0.3]), "camera", color=BLUE, ha="center")
space.set(xlabel="x [m]", ylabel="y [m]", title="world frame: the ellipsoid")
space.set(xlim=(-0.6, 1.7), ylim=(-1.7, 0.6), zlim=(0, 1.6), xticks=(0, 1), yticks=(-1, 0), zticks=(0, 1))
space.set_box_aspect((2.3, 2.3, 1.6), zoom=1.25)
space.view_init(elev=18, azim=25)
show_pixels(image, splat(projection, [[0.82, 0.29, 0.25]], camera).image, "image: the splat and its ellipses")
for n_sigmas in (1, 2, 3):
    draw_ellipses(image, projection.means2d[0], covariance2d(projection), n_sigmas, color=BLUE, linewidth=1)
image.plot(*projection.means2d[0], "+", color=BLUE)
plt.show()

# %% [markdown]
# | file | what it holds | equation |
# |---|---|---|
# | `minisplat_ref/reference/covariance.py` | from quaternion and scales to a covariance | 3DGS (6) |
# | `minisplat_ref/reference/pinhole.py` | from the camera frame to a pixel, and the derivative of that map | EWA (29) |
# | `minisplat_ref/reference/projection.py` | from 3D covariance to 2D covariance, low-pass | 3DGS (5), EWA (31) |
# | `minisplat_ref/reference/extent.py` | which pixels to visit | |
#
# *3DGS* is Kerbl et al. 2023, *EWA* is Zwicker et al. 2002. **Frames and units:** the world frame has no unit of its
# own; here one unit is a metre and z points up. The camera frame is x right, y down, z forward. Image coordinates are
# pixels, x right, y down, and the centre of the top-left pixel is (0.5, 0.5).
#
# ## Covariance from a quaternion and three scales
#
# Three scales and a rotation give every ellipsoid there is, from a ball to a needle or a disc:

# %%
s = np.sin(np.radians(25))
shapes = {
    "sphere\nscales 0.3, 0.3, 0.3": ([1, 0, 0, 0], [0.3, 0.3, 0.3]),
    "needle\nscales 0.5, 0.05, 0.05": ([1, 0, 0, 0], [0.5, 0.05, 0.05]),
    "disc\nscales 0.45, 0.45, 0.04": ([1, 0, 0, 0], [0.45, 0.45, 0.04]),
    "the same disc,\nturned by 50° about y": ([np.sqrt(1 - s * s), 0, s, 0], [0.45, 0.45, 0.04]),
}
figure, panels = plt.subplots(1, 4, figsize=(10, 3), subplot_kw={"projection": "3d"})
for axes, (title, (q, scales)), color in zip(panels, shapes.items(), (YELLOW, RED, GREEN, BLUE), strict=True):
    matrix = covariances(np.array([q], float), np.array([scales]))[0]
    axes.plot_surface(*ellipsoid(np.zeros(3), matrix, n=28), color=color, linewidth=0)
    axes.set(xlim=(-0.5, 0.5), ylim=(-0.5, 0.5), zlim=(-0.5, 0.5), title=title)
    axes.set(xticks=(-0.4, 0, 0.4), yticks=(-0.4, 0, 0.4), zticks=(-0.4, 0, 0.4), xlabel="x [m]", ylabel="y [m]")
    axes.tick_params(labelsize=6, pad=-1)
    axes.set_box_aspect((1, 1, 1), zoom=0.82)
plt.show()

# %% [markdown]
# The optimiser may change any of these numbers freely, and yet the covariance must stay symmetric and must never
# contain a negative variance. So the covariance is not stored. It is built from a rotation $R$ and a diagonal matrix
# $S$ of standard deviations,
#
# $$\Sigma = R\,S\,S^\top R^\top \qquad \text{3DGS (6)}$$
#
# and this product is positive semi-definite for all quaternions and all scales.

# %%
show_code(covariances)

# %% [markdown]
# ## A camera bends what it projects; its derivative does not
#
# The pinhole $p = f\,x/z + c$ divides by depth, so the exact image of a Gaussian is not a Gaussian. Splatting replaces
# the map by its first-order expansion at the mean. With the rotation $W$ of the camera (the package writes `R`) and the
# Jacobian $J$ of the pinhole at the mean,
#
# $$\Sigma' = J\,W\,\Sigma\,W^\top J^\top \quad \text{3DGS (5), EWA (31)}, \qquad
# J = \begin{pmatrix} f_x/z & 0 & -f_x x/z^2 \\ 0 & f_y/z & -f_y y/z^2 \end{pmatrix} \quad \text{EWA (29)}$$
#
# Below, the dots are samples of the 3D Gaussian after the exact pinhole, and the line is the ellipse at two standard
# deviations that the expansion predicts. For a small Gaussian the two agree. For a large one near the camera they do
# not, because its near side is magnified more than its far side.

# %%
show_code(pinhole_jacobians)

# %%
axis_camera = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 60.0, 45.0, 120, 90)  # camera frame = world frame
unrotated = np.array([[1.0, 0.0, 0.0, 0.0]])
rng = np.random.default_rng(0)
covariance_error = {}
figure, panels = plt.subplots(1, 2, figsize=(10, 3.8))
for axes, title, position, scales in (
    (panels[0], "small: 5 cm along the view, 3 m away", [0.6, 0.3, 3.0], [0.25, 0.12, 0.05]),
    (panels[1], "large: 60 cm along the view, 1.6 m away", [0.25, 0.12, 1.6], [0.12, 0.08, 0.60]),
):
    means, scales = np.array([position]), np.array([scales])
    samples = rng.multivariate_normal(means[0], covariances(unrotated, scales)[0], size=4000)
    pixels = pinhole(samples[samples[:, 2] > 0.2], axis_camera)
    sharp = GSPLAT_MAIN._replace(eps2d=0.0)  # without the low-pass of the next section
    footprint = project(means, unrotated, scales, opacity, axis_camera, sharp)
    axes.plot(*pixels.T, ".", markersize=1.2, color=YELLOW, label="exact: samples through the pinhole")
    draw_ellipses(axes, footprint.means2d[0], covariance2d(footprint), 2, color=BLUE, linewidth=1.8, zorder=3)
    axes.plot([], [], color=BLUE, label="first order, two standard deviations")
    axes.set(xlim=(0, 120), ylim=(90, 0), aspect="equal", title=title, xlabel="x [px]", ylabel="y [px]")
    axes.legend(loc="upper left", fontsize=8, markerscale=6)
    exact = np.cov(pixels.T)
    covariance_error[title.split(":")[0]] = np.linalg.norm(covariance2d(footprint) - exact) / np.linalg.norm(exact)
plt.show()
for name, error in covariance_error.items():
    print(f"{name} Gaussian: the predicted 2D covariance is off by {100 * error:.0f} %")

# %% [markdown]
# ## The 0.3 px low-pass, and what it does to a needle
#
# A Gaussian thinner than a pixel can fall between two pixel centres and vanish, and it flickers when the camera moves.
# 3DGS therefore adds 0.3 square pixels to both variances:
#
# $$\Sigma'_\text{drawn} = \Sigma' + 0.3\,\mathrm{px}^2\,I$$
#
# No splat is then narrower than $\sqrt{0.3} \approx 0.55$ px. But a thin splat becomes wider *without becoming
# fainter*, so it covers more than it should. Mip-Splatting compensates: it multiplies the opacity by
# $\sqrt{\det \Sigma' / \det \Sigma'_\text{drawn}}$, which preserves the total.

# %%
small_camera = Camera(np.eye(3), np.zeros(3), 40.0, 40.0, 16.0, 10.0, 32, 20)
needle_mean, needle_quat = np.array([[0.01, -0.01, 2.0]]), np.array([[np.cos(0.11), 0, 0, np.sin(0.11)]])
needle_scale = np.array([[0.35, 0.008, 0.008]])  # 0.008 m at 2 m and 40 px focal length: 0.16 px
choices = {
    "no low-pass": GSPLAT_MAIN._replace(eps2d=0.0),
    "low-pass 0.3 px$^2$ (default)": GSPLAT_MAIN,
    "low-pass, compensated": GSPLAT_MAIN._replace(is_antialiased=True),
}
figure, panels = plt.subplots(2, 2, figsize=(10, 5.6))
panels = panels.ravel()
for axes, (title, conventions) in zip(panels, choices.items(), strict=False):
    footprint = project(needle_mean, needle_quat, needle_scale, opacity, small_camera, conventions)
    show_pixels(axes, splat(footprint, [[0.82, 0.29, 0.25]], small_camera, conventions).image, title)
    draw_ellipses(axes, footprint.means2d[0], covariance2d(footprint), 2, color=BLUE, linewidth=0.8)

widths_px = np.geomspace(0.03, 3, 25)  # standard deviation across the needle
drawn = {}
for (title, conventions), color, line_width in zip(
    choices.items(), ("#cfcac3", RED, GREEN), (5, 1.5, 1.5), strict=True
):
    footprints = [
        project(needle_mean, needle_quat, np.array([[0.35, w / 20, w / 20]]), opacity, small_camera, conventions)
        for w in widths_px
    ]
    drawn[title] = np.array([splat(f, [[0.0]], small_camera, conventions, (1.0,)).alpha.sum() for f in footprints])
    panels[3].loglog(widths_px, drawn[title], color=color, linewidth=line_width, label=title)
panels[3].set(xlabel="true width [px, one st. dev.]", ylabel="sum of alpha over pixels", title="how much is drawn")
panels[3].legend(fontsize=8)
plt.show()

# %% [markdown]
# Without the low-pass the needle breaks into dots wherever it passes between pixel centres. With the low-pass it is
# whole, but every needle thinner than half a pixel weighs as much as one of half a pixel. With the compensation it is
# whole and weighs what it should.
#
# ## The clamp of the Jacobian
#
# The last column of $J$ grows with the slope $x/z$. For a Gaussian far outside the image but close to the camera plane
# the expansion predicts an enormous ellipse that sweeps over the whole picture. The 3DGS code therefore clamps the
# slope inside $J$, and only there, a little outside the image: at 1.3 times the half field of view. When the principal
# point is off centre, gsplat measures the margin from each edge of the image, and INRIA's rasteriser from the optical
# axis.

# %%
off_center = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 45.0, 45.0, 120, 90)
slopes = np.linspace(-2.2, 2.2, 221)
points = np.column_stack([slopes, np.zeros_like(slopes), np.ones_like(slopes)])  # camera frame, one metre deep
limits = {name: slope_limits(off_center, c, np.dtype(float)) for name, c in (("gsplat", GSPLAT_MAIN), ("INRIA", INRIA))}
no_limit = np.full(2, np.inf)
columns = {
    "true derivative": pinhole_jacobians(points, off_center, -no_limit, no_limit)[:, 0, 2],
    "clamped as in gsplat": pinhole_jacobians(points, off_center, *limits["gsplat"])[:, 0, 2],
    "clamped as in INRIA's": pinhole_jacobians(points, off_center, *limits["INRIA"])[:, 0, 2],
}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4))
left.axvspan(-0.45, 0.75, color=YELLOW, alpha=0.25, label="inside the image")
for (label, values), style in zip(columns.items(), ("--", "-", ":"), strict=True):
    left.plot(slopes, values, style, color=GREY if style == "--" else BLUE if style == "-" else RED, label=label)
left.set(xlabel="slope x / z of the mean", ylabel="$J_{xz}$ [px per metre]", title="one entry of J, at z = 1 m")
left.legend(fontsize=8)

aside = np.array([[3.0, 0.0, 1.0]])  # camera frame: 3 m to the right, 1 m deep
ball = covariances(unrotated, np.array([[0.3, 0.3, 0.3]]))[0]
right.add_patch(Rectangle((0, 0), 120, 90, color=YELLOW, alpha=0.4, linewidth=0, label="image"))
samples = rng.multivariate_normal(aside[0], ball, size=3000)
right.plot(*pinhole(samples[samples[:, 2] > 0.2], off_center).T, ".", markersize=1.5, color=GREY, label="exact")
reach = {}
for label, (low, high), style, color in (
    ("true derivative", (-no_limit, no_limit), "--", GREY),
    ("clamped as in gsplat", limits["gsplat"], "-", BLUE),
):
    J = pinhole_jacobians(aside, off_center, low, high)[0]
    draw_ellipses(right, pinhole(aside, off_center)[0], J @ ball @ J.T, 3, color=color, linestyle=style, label=label)
    reach[label] = pinhole(aside, off_center)[0, 0] - 3 * np.sqrt((J @ ball @ J.T)[0, 0])
right.set(xlim=(-40, 800), ylim=(290, -200), aspect="equal", xlabel="x [px]", ylabel="y [px]")
right.set(title="a ball beside the image, three st. dev.")
right.legend(fontsize=8, loc="upper right", markerscale=5)
plt.show()

# %% [markdown]
# Right: a ball of 0.3 m, 3 m beside the axis and 1 m deep. No sample of it lands in the image, yet the true derivative
# predicts an ellipse that reaches into it. The ellipse of the clamped one stays outside.
#
# ## Which pixels to visit
#
# A Gaussian never quite ends, but its alpha falls below 1/255, where it can no longer change an 8-bit image. Solving
# $o\,e^{-r^2/2} = 1/255$ for the radius in standard deviations gives $r = \sqrt{2\ln(255\,o)}$, so a faint Gaussian
# needs a smaller box. INRIA's first rasteriser always takes three standard deviations of the longer axis, in whole
# tiles of 16 pixels. That is far too much for a faint Gaussian, and it can cut off a rim of an opaque one that is still
# visible.

# %%
edge_mean, edge_scale = np.array([[-0.368, 0.0, 2.0]]), np.array([[0.16, 0.07, 0.07]])
boxes, n_cut = {}, {}
figure, panels = plt.subplots(1, 2, figsize=(10, 4))
for axes, o in zip(panels, (0.95, 0.03), strict=True):
    visible = {}
    for conventions, color, name in ((INRIA, RED, "INRIA"), (GSPLAT_MAIN, GREEN, "full support")):
        footprint = project(edge_mean, unrotated, edge_scale, np.array([o]), axis_camera, conventions)
        output = splat(footprint, [[0.82, 0.29, 0.25]], axis_camera, conventions)
        visible[name] = output.alpha > 0
        x0, y0, x1, y1 = boxes[o, conventions.name] = footprint.boxes[0]
        label = f"{name}: {(x1 - x0) * (y1 - y0)} pixels"
        axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color=color, linewidth=1.8, label=label))
    n_sigmas = np.sqrt(2 * np.log(255 * o))
    draw_ellipses(axes, footprint.means2d[0], covariance2d(footprint), n_sigmas, color=BLUE, label="alpha = 1/255")
    show_pixels(axes, output.image, f"opacity {o}: visible up to {n_sigmas:.2f} st. dev.")
    axes.set(xticks=range(0, 121, 16), yticks=range(0, 91, 16))
    axes.grid(color=GREY, linewidth=0.4)
    axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
    n_cut[o] = np.sum(visible["full support"] & ~visible["INRIA"])
plt.show()
print(f"visible pixels that INRIA's rule cuts off: {n_cut[0.95]} at opacity 0.95, {n_cut[0.03]} at 0.03")

# %% [markdown]
# ## Play
#
# Change a number and run the cell again. What to look for:
#
# * `my_quat`: which rotations change the ellipse, and which leave it as it is?
# * `my_scale`: the first scale is the one that you see; when do you see the third?
# * `distance`: double it. The ellipse shrinks to half its size, but not below the low-pass.
# * `sideways`: how far can the Gaussian move before it is culled?

# %%
my_quat = np.array([[1.0, 0.0, 0.4, 0.0]])
my_scale = np.array([[0.4, 0.1, 0.1]])
distance, sideways = 3.0, 0.5

mine = project(np.array([[sideways, 0.0, distance]]), my_quat, my_scale, np.array([0.9]), axis_camera, GSPLAT_MAIN)
figure, axes = plt.subplots(figsize=(5, 3.6))
show_pixels(axes, splat(mine, [[0.21, 0.38, 0.55]], axis_camera).image, "yours")
if mine.radii[0, 0] > 0:  # zero when culled
    draw_ellipses(axes, mine.means2d[0], covariance2d(mine), 2, color=RED)
plt.show()
print(f"depth {mine.depths[0]:.2f} m, radii {mine.radii[0]} px, box {mine.boxes[0]}")

# %% [markdown]
# ## Exercises
#
# **1.** A Gaussian of scales 0.02 m stands 4 m in front of a camera with a focal length of 100 px. How large are the
# variances of its ellipse, with the low-pass and without? Work it out with a pencil first.
#
# <details>
# <summary>Solution</summary>
#
# On the axis $J$ is diagonal, so the standard deviation is $f s / z = 100 \cdot 0.02 / 4 = 0.5$ px. The variances are
# 0.25 px² without the low-pass and 0.55 px² with it: here the low-pass is the larger part.
#
# ```python
# tiny = project(np.array([[0.0, 0.0, 4.0]]), unrotated, np.full((1, 3), 0.02), opacity, axis_camera, GSPLAT_MAIN)
# assert np.allclose(covariance2d(tiny), 0.55 * np.eye(2), rtol=1e-12)
# ```
#
# </details>
#
# **2.** Quaternions $q$ and $-q$ are the same rotation. Are there different rotations that give the same covariance?
# Find one, and say how many there are for three different scales.
#
# <details>
# <summary>Solution</summary>
#
# A half turn about one of the Gaussian's own axes flips the signs of two columns of $R$, and $R S S^\top R^\top$
# contains every column twice. There are four such rotations: no turn, and a half turn about each axis. In quaternions,
# a half turn about the first axis is a multiplication by $i$ from the right.
#
# ```python
# w, x, y, z = quat[0]
# half_turned = np.array([[-x, w, z, -y]])  # (w + xi + yj + zk) i
# assert np.allclose(covariances(half_turned, scale), Sigma, rtol=1e-12)
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked
#
# The last cell of every notebook asserts what the pictures claim.

# %%
# Equation (6): the variances of Sigma are the squared scales, whatever the rotation, and Sigma is symmetric.
assert np.allclose(np.sort(np.linalg.eigvalsh(Sigma[0])), np.sort(scale[0] ** 2), rtol=1e-12)
assert np.array_equal(Sigma, np.swapaxes(Sigma, 1, 2)) and abs(Sigma[0, 0, 1]) > 1e-3
# The length of a quaternion does not matter.
assert np.allclose(covariances(7 * quat, scale), Sigma, rtol=1e-12)

# A Gaussian on the axis, by hand: x and y variances are (f s / z)^2 + 0.3.
on_axis = project(
    np.array([[0.0, 0.0, 2.0]]), unrotated, np.array([[0.2, 0.1, 0.3]]), opacity, axis_camera, GSPLAT_MAIN
)
assert np.allclose(covariance2d(on_axis), np.diag([10.0**2 + 0.3, 5.0**2 + 0.3]), rtol=1e-12)

# The expansion is accurate for the small Gaussian and far off for the large one.
assert covariance_error["small"] < 0.1 < 0.3 < covariance_error["large"]

# With the low-pass, thin needles weigh as much as one of half a pixel; the compensation takes that weight away again.
default, compensated = drawn["low-pass 0.3 px$^2$ (default)"], drawn["low-pass, compensated"]
assert default[0] > 0.9 * default[widths_px < 0.2][-1] and np.all(compensated <= default)
assert compensated[0] < 0.1 * default[0]

# The clamp: equal inside the image, constant outside, and different for the two rules off centre.
true, gsplat, inria = columns.values()
inside = (slopes > -0.45) & (slopes < 0.75)
assert np.array_equal(true[inside], gsplat[inside]) and np.all(np.abs(gsplat[~inside]) <= np.abs(true[~inside]))
assert np.isclose(gsplat[-1], -100 * (0.75 + 0.3 * 0.6)) and np.isclose(inria[-1], -100 * 1.3 * 0.6)
# Without the clamp the ellipse reaches into the image (columns 0 to 120), with it it does not.
assert reach["true derivative"] < 120 < reach["clamped as in gsplat"]

# Full support shrinks for a faint Gaussian; INRIA's rule does not, and consists of whole tiles.
areas = {key: (x1 - x0) * (y1 - y0) for key, (x0, y0, x1, y1) in boxes.items()}
assert areas[0.03, "GSPLAT_MAIN"] < 0.5 * areas[0.95, "GSPLAT_MAIN"]
assert areas[0.03, "INRIA"] == areas[0.95, "INRIA"] == 64 * 64
# Yet INRIA's larger box loses visible pixels of the opaque Gaussian, because it ends at a tile's edge.
assert n_cut[0.95] > 0 == n_cut[0.03]
