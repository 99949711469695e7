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
# # 02 Spherical harmonics
#
# A polished ball has a highlight that moves when you move. A Gaussian imitates it with a colour that depends on the
# direction from which it is seen: a sum of at most 16 fixed functions on the sphere, each with an RGB coefficient of
# its own.
#
# Here are the sixteen functions. Each row is one degree $l$; red is positive and blue is negative. Degree 0 is a
# constant, degree 1 tells one side from the other, and each further degree adds finer detail and $2l+1$ coefficients
# per channel. The spheres are seen from slightly above, and z points up.

# %%
import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREEN, GREY, RED, YELLOW, show, show_code
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.reference.compositing import composite
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_colors
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Gaussians, TileGrid


def globe(n=90, azimuth=-50.0, elevation=25.0):
    """Unit vectors on the near side of a sphere for an n x n picture of it, and the mask of its disc."""
    a, e = np.radians([azimuth, elevation])
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])  # from the centre to the viewer
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    v, u = np.meshgrid(np.linspace(1.05, -1.05, n), np.linspace(-1.05, 1.05, n), indexing="ij")
    is_disc = u * u + v * v < 1
    depth = np.sqrt(np.maximum(1 - u * u - v * v, 0))
    points = u[..., None] * right + v[..., None] * np.cross(towards, right) + depth[..., None] * towards
    return points, is_disc


# %%
points, is_disc = globe(n=56)
values = sh_basis(points[is_disc], degree=3)  # [P, 16]
figure, panels = plt.subplots(4, 7, figsize=(9, 5.2))
for axes in panels.flat:
    axes.axis("off")
for k in range(16):
    degree = int(np.sqrt(k))
    order = k - degree * degree - degree
    axes = panels[degree, 3 + order]
    picture = np.full(is_disc.shape, np.nan)
    picture[is_disc] = values[:, k]
    drawn = axes.imshow(picture, cmap="RdBu_r", vmin=-0.75, vmax=0.75)
    axes.set_title(f"$Y_{{{degree},{order}}}$", pad=2)
figure.colorbar(drawn, ax=panels, shrink=0.6, label="value")
plt.show()

# %% [markdown]
# The colour of a Gaussian, seen in direction $d$, is their sum with coefficients $k_{lm}$, one for each channel:
#
# $$c(d) = \tfrac12 + \sum_{l=0}^{L} \sum_{m=-l}^{l} k_{lm}\,Y_{lm}(d), \qquad L \le 3 \qquad \text{3DGS sec. 3}$$
#
# Read alongside: `minisplat_ref/reference/spherical_harmonics.py`, after section 3 of 3DGS (Kerbl et al. 2023).
# **Frames and units:** directions are unit vectors in the world frame. They point *from the camera to the Gaussian*.
# Colours are sRGB values in [0, 1] and are blended as they are, without a conversion to linear light.
#
# The functions are polynomials in the three components of the direction. Their order and signs are those of
# 3DGS's PLY files, so a file can be read without a permutation.

# %%
show_code(sh_basis)

# %% [markdown]
# ## They are orthonormal
#
# The integral over the sphere of the product of two different functions is 0, and that of the square of each is 1. So
# one integral extracts a coefficient from a colour function, and what remains without the high degrees is the best fit
# that the lower degrees can give. A product of two functions has at most degree 6; Gauss-Legendre nodes in z with equal
# steps in azimuth integrate it exactly, so the picture below contains no approximation.

# %%
nodes, node_weights = np.polynomial.legendre.leggauss(8)
azimuths = 2 * np.pi * np.arange(16) / 16
z, phi = np.meshgrid(nodes, azimuths, indexing="ij")
directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1).reshape(-1, 3)
area_weights = np.repeat(node_weights, 16) * 2 * np.pi / 16  # they sum to 4 pi
basis = sh_basis(directions, 3)  # [128, 16]
gram = basis.T @ (area_weights[:, None] * basis)
figure, axes = plt.subplots(figsize=(3.8, 3.2))
drawn = axes.imshow(gram, cmap="RdBu_r", vmin=-1, vmax=1)
axes.set(title="integral of $Y_j Y_k$ over the sphere", xlabel="k", ylabel="j", xticks=range(0, 16, 3))
axes.set_yticks(range(0, 16, 3))
figure.colorbar(drawn, shrink=0.8)
plt.show()
print(f"largest deviation from the identity: {np.abs(gram - np.eye(16)).max():.1e}")

# %% [markdown]
# ## A colour that turns with the viewing direction
#
# One Gaussian at the origin and twelve cameras in a circle around it. It stores a grey constant and one coefficient of
# degree 1, that of $Y_{1,1} = -\sqrt{3/4\pi}\,x$, with opposite signs for red and blue. A camera at +x looks along -x,
# so there $Y_{1,1}$ is positive.

# %%
dc = (np.array([[0.55, 0.5, 0.45]]) - 0.5) / SH_C0  # [1, 3]
rest = np.zeros((1, 15, 3))
rest[0, 2] = [0.9, 0.0, -0.9]  # Y_1,1 is the third function of degree 1: rest[0] is Y_1,-1, rest[1] is Y_1,0
turning = Gaussians(
    means=np.zeros((1, 3)),
    quats=np.array([[1.0, 0.0, 0.0, 0.0]]),
    log_scales=np.full((1, 3), np.log(0.3)),
    opacity_logits=np.array([4.0]),
    sh_dc=dc,
    sh_rest=rest,
)
angles = np.radians(np.arange(0, 360, 30))
cameras = [look_at(2.0 * np.array([np.cos(a), np.sin(a), 0.3]), np.zeros(3), 30.0, 24, 24) for a in angles]
figure = plt.figure(figsize=(10, 4))
rows = figure.subfigures(2, 1, height_ratios=(1, 2))
for axes, camera, angle in zip(rows[0].subplots(1, 12), cameras, angles, strict=True):
    output, _ = render(turning, camera, background=np.ones(3), backend=REFERENCE)
    axes.imshow(np.clip(output.image, 0, 1))
    axes.set_title(f"{np.degrees(angle):.0f}°")
    axes.axis("off")

fine = np.radians(np.arange(0, 361, 5))
ring = [look_at(2.0 * np.array([np.cos(a), np.sin(a), 0.3]), np.zeros(3), 30.0, 24, 24) for a in fine]
left, right = rows[1].subplots(1, 2)
is_visible = np.ones((1, 2), dtype=int)  # radii above 0: not culled
seen = {}
for axes, strength in ((left, 0.9), (right, 1.8)):
    coefficients = rest * strength / 0.9
    seen[strength] = np.concatenate(
        [sh_colors(turning.means, dc, coefficients, camera, 3, is_visible) for camera in ring]
    )  # [73, 3]
    for channel, color in enumerate((RED, GREEN, BLUE)):
        axes.plot(np.degrees(fine), seen[strength][:, channel], color=color, label=("red", "green", "blue")[channel])
    axes.axhspan(1, 1.6, color=GREY, alpha=0.15, linewidth=0)
    axes.set(xlabel="camera azimuth [degrees]", ylabel="colour", xticks=range(0, 361, 60), ylim=(-0.1, 1.6))
    axes.set_title(f"coefficient {strength}" + (": the sum falls below 0 and is clipped" if strength > 1 else ""))
    axes.legend(loc="upper center", ncols=3)
plt.show()

# %% [markdown]
# With the centre $o$ of a camera of rotation $R$ and translation $t$, and the mean $\mu$ of the Gaussian, the colour is
#
# $$d = \frac{\mu - o}{|\mu - o|}, \qquad o = -R^\top t, \qquad \text{colour} = \max\bigl(0,\; c(d)\bigr)$$
#
# A colour is clipped below zero, and a clipped channel passes no gradient. It is not clipped above one: in the grey
# band a display clips it, but the loss still sees it.

# %%
show_code(sh_colors)

# %% [markdown]
# ## A glossy ball
#
# A red ball of 1,500 flat Gaussians under one lamp. Its true colour is a matte shading plus a highlight,
# $0.6\,(n\cdot h)^{p}$, with the normal $n$, the direction $h$ halfway between lamp and viewer, and the shininess $p$.
# The coefficients of each Gaussian are fitted by least squares to 100 random directions from which it can be seen. Then
# the ball is rendered from one viewpoint.

# %%
shininess = 40.0  # to play with: 5 is satin, 200 is lacquer
n_gaussians, n_views = 1500, 100

turn = np.pi * (3 - np.sqrt(5)) * np.arange(n_gaussians)  # the golden angle spreads points evenly
height = 1 - (2 * np.arange(n_gaussians) + 1) / n_gaussians
normals = np.stack([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height], axis=1)
lamp = np.array([0.35, -0.70, 0.62]) / np.linalg.norm([0.35, -0.70, 0.62])


def glossy_color(normals, towards_viewer):
    """Colour [..., 3] of the true ball: red, matte, with a white highlight."""
    halfway = lamp + towards_viewer
    halfway /= np.linalg.norm(halfway, axis=-1, keepdims=True)
    lit = np.maximum(normals @ lamp, 0)
    highlight = 0.6 * np.maximum(np.sum(normals * halfway, axis=-1), 0) ** shininess * (lit > 0)
    return (0.15 + 0.6 * lit)[..., None] * np.array([0.85, 0.2, 0.2]) + highlight[..., None]


views = np.random.default_rng(0).normal(size=(n_gaussians, n_views, 3))  # directions from a Gaussian to viewers
views /= np.linalg.norm(views, axis=2, keepdims=True)
views *= np.sign(np.einsum("nvi,ni->nv", views, normals))[..., None]  # only from outside
targets = glossy_color(normals[:, None], views) - 0.5  # [N, V, 3]
bases = sh_basis(-views.reshape(-1, 3), 3).reshape(n_gaussians, n_views, 16)


def fitted_coefficients(degree):
    """Least-squares coefficients [N, 16, 3] of every Gaussian; zeros above the degree."""
    used = bases[:, :, : (degree + 1) ** 2]  # [N, V, K]
    fitted = np.zeros((n_gaussians, 16, 3))
    fitted[:, : used.shape[2]] = np.linalg.pinv(used, rcond=1e-3) @ targets
    return fitted


half_angles = np.arccos(np.clip(height, -1, 1)) / 2  # turns the disc's axis z onto the normal
quats = np.stack(
    [np.cos(half_angles), -np.sin(half_angles) * np.sin(turn), np.sin(half_angles) * np.cos(turn), 0 * turn], axis=1
)
flat = np.log(np.tile([0.05, 0.05, 0.004], (n_gaussians, 1)))
camera = look_at(np.array([1.9, -2.0, 1.4]), np.zeros(3), 110.0, 96, 96)

pictures, coefficients = {}, {}
for degree in range(4):
    coefficients[degree] = fitted_coefficients(degree)
    ball = Gaussians(
        normals, quats, flat, np.full(n_gaussians, 3.0), coefficients[degree][:, 0], coefficients[degree][:, 1:]
    )
    output, tape = render(ball, camera, background=np.ones(3), sh_degree=degree, backend=REFERENCE)
    pictures[degree] = output.image

center = camera.center
exact = glossy_color(normals, (center - normals) / np.linalg.norm(center - normals, axis=1, keepdims=True))
bins = REFERENCE.bin_gaussians(tape.projection, TileGrid(96, 96, 16, 16), GSPLAT_MAIN)
truth = composite(tape.projection, exact, np.ones(3), bins, GSPLAT_MAIN).image

figure, panels = plt.subplots(1, 5, figsize=(10.5, 2.6))
error = {degree: np.sqrt(np.mean((picture - truth) ** 2)) for degree, picture in pictures.items()}
for axes, (title, picture) in zip(
    panels,
    [("exact colours", truth)]
    + [(f"degree {d}: {(d + 1) ** 2} per channel\nRMS error {error[d]:.3f}", p) for d, p in pictures.items()],
    strict=True,
):
    show(axes, picture, title)
plt.show()

# %% [markdown]
# The highlight becomes sharper with each degree. Below is what one Gaussian in the highlight has learnt: its colour as
# the camera passes the mirror direction.

# %%
n_bright = np.argmax(exact[:, 1])  # the one whose highlight is brightest in the picture above
mirror = 2 * (normals[n_bright] @ lamp) * normals[n_bright] - lamp
side = np.cross(mirror, normals[n_bright]) / np.linalg.norm(np.cross(mirror, normals[n_bright]))
sweep = np.radians(np.linspace(-50, 50, 101))
towards = np.cos(sweep)[:, None] * mirror + np.sin(sweep)[:, None] * side  # unit vectors
figure, axes = plt.subplots(figsize=(6.5, 3))
axes.plot(np.degrees(sweep), glossy_color(normals[n_bright], towards)[:, 1], "k", linewidth=2, label="exact")
for degree, color in zip(range(4), ("#c9c2b7", YELLOW, RED, BLUE), strict=True):
    curve = 0.5 + sh_basis(-towards, degree) @ coefficients[degree][n_bright, : (degree + 1) ** 2, 1]
    axes.plot(np.degrees(sweep), curve, color=color, label=f"degree {degree}")
axes.set(xlabel="angle from the mirror direction [degrees]", ylabel="green channel", title="one Gaussian of the ball")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Play
#
# One Gaussian with coefficients of your choice, drawn as the colour that it shows to viewers all around it. What to
# look for:
#
# * Move a number from one row of `mine` to another: which functions differ only by a turn of the sphere?
# * Put a number into the first row. It shifts the colour and changes nothing else.
# * Make a number so large that the sum falls below 0: the clipped area becomes flat.
#
# Then set `shininess`, two cells further up, to 5 or to 200 and run both cells again. The finest bumps of degree 3 are
# about 60 degrees wide, so a lacquered highlight is out of their reach. Training then blurs it, or puts Gaussians
# behind the surface that imitate the mirror image.

# %%
mine = np.zeros((16, 3))  # [coefficient, channel]
mine[2] = [0.8, 0.8, 0.0]  # Y_1,0: yellow from above and dark from below, or the other way round?
mine[6] = [0.0, 0.0, 0.6]  # Y_2,0

picture = np.ones((*is_disc.shape, 3))
picture[is_disc] = np.maximum(0.5 + values @ mine, 0)
figure, axes = plt.subplots(figsize=(3.2, 3.2))
show(axes, picture, "colour as a function of d")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** A Gaussian is to look red from above and blue from below, and purple from the side. Which coefficients does it
# need? Mind the direction of $d$.
#
# <details>
# <summary>Solution</summary>
#
# Purple is the constant: $k_{00} = (\text{purple} - \tfrac12) / 0.2821$. The change from top to bottom is $Y_{1,0} =
# \sqrt{3/4\pi}\,z$. Seen from above, $d$ points *down*, so $Y_{1,0}$ is negative there and red needs a negative
# coefficient.
#
# ```python
# k = np.zeros((1, 4, 3))
# k[0, 0] = (np.array([0.5, 0.0, 0.5]) - 0.5) / SH_C0
# k[0, 2] = np.array([-0.5, 0.0, 0.5]) / np.sqrt(3 / (4 * np.pi))
# from_above, from_below = 0.5 + sh_basis(np.array([[0, 0, -1.0], [0, 0, 1.0]]), 1) @ k[0]
# assert np.allclose(from_above, [1, 0, 0]) and np.allclose(from_below, [0, 0, 1])
# ```
#
# </details>
#
# **2.** Degree 3 leaves an RMS error of the glossy ball at `shininess = 40`. How large is the part of the highlight
# alone, as a function on the sphere, that no function of degree 3 or less can represent? (Hint: the functions are
# orthonormal, so the energy of a function is the sum of its squared coefficients plus the energy of the rest.)
#
# <details>
# <summary>Solution</summary>
#
# Take $f = (\cos\theta)^{p}$ on the upper half of the sphere, the highlight around its own axis. Its energy is
# $2\pi / (2p + 1)$. Around the axis only the four functions with $m = 0$ contribute. For $p = 40$ they hold about a
# third of the energy.
#
# ```python
# p = 40
# cosines, weights_1d = np.polynomial.legendre.leggauss(100)
# highlight = np.maximum(cosines, 0) ** p
# axis = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=1)
# k = 2 * np.pi * (weights_1d * highlight) @ sh_basis(axis, 3)[:, [0, 2, 6, 12]]
# share = (k**2).sum() / (2 * np.pi / (2 * p + 1))
# print(f"degree 3 holds {share:.0%} of the energy of the highlight")
# assert 0.25 < share < 0.4
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# Orthonormal, to rounding.
assert np.allclose(gram, np.eye(16), atol=1e-13)

# Degree 0 is 1 / (2 sqrt(pi)); at the north pole every function of order m != 0 vanishes.
pole = sh_basis(np.array([[0.0, 0.0, 1.0]]), 3)[0]
assert np.isclose(pole[0], 0.5 / np.sqrt(np.pi)) and np.isclose(pole[2], np.sqrt(3 / (4 * np.pi)))
assert np.count_nonzero(pole) == 4

# The turning colour: red seen from +x, blue from -x, green the same from everywhere, nothing below zero.
red, green, blue = seen[0.9].T
assert red[0] > blue[0] + 0.5 and blue[36] > red[36] + 0.3 and np.ptp(green) < 1e-12
assert seen[1.8].min() == 0.0 and seen[1.8].max() > 1.0

# By hand, for the camera at azimuth 0: d = -(1, 0, 0.3) / |...|, and Y_1,1 = -sqrt(3 / 4 pi) d_x.
by_hand = 0.55 + 0.9 * np.sqrt(3 / (4 * np.pi)) / np.sqrt(1.09)
assert np.isclose(red[0], by_hand, rtol=1e-12)

# Each degree comes closer to the glossy ball, and the last one still misses it.
assert error[0] > error[1] > error[2] > error[3] > 0.002
assert error[3] < 0.5 * error[0]
