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
# A polished ball shows a highlight that moves when you move. A Gaussian imitates this with a colour that depends on the
# direction from which it is seen: a sum of at most 16 fixed functions on the sphere, each with its own RGB coefficient.
#
# Read alongside: `minisplat_ref/reference/spherical_harmonics.py`, after section 3 of 3DGS (Kerbl et al. 2023).
#
# **Frames and units:** directions are unit vectors in the world frame, here with z up. They point *from the camera to
# the Gaussian*. Colours are sRGB values in [0, 1], blended as they are, without conversion to linear light.

# %%
import matplotlib.pyplot as plt
import numpy as np

from figures import show_code
from minisplat_ref.backends import REFERENCE
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.datasets.synthetic.cameras import look_at
from minisplat_ref.reference.compositing import composite
from minisplat_ref.reference.spherical_harmonics import sh_basis, sh_colors
from minisplat_ref.rendering import render
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


# %% [markdown]
# ## The sixteen functions
#
# Each row is one degree $l$. Red is positive, blue negative. Degree 0 is a constant, degree 1 tells one side from the
# other, and each further degree adds finer detail and $2l+1$ coefficients per channel. The spheres are seen from a
# little above, with z upwards.
#
# $$c(d) = \tfrac12 + \sum_{l=0}^{L} \sum_{m=-l}^{l} k_{lm}\,Y_{lm}(d), \qquad L \le 3 \qquad \text{3DGS sec. 3}$$

# %%
points, is_disc = globe()
values = sh_basis(points[is_disc], degree=3)  # [P, 16]
figure, panels = plt.subplots(4, 7, figsize=(9.5, 5.4))
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
# The functions are polynomials in the three components of the direction. Their order and signs are those of the 3DGS
# PLY files, so that a file can be read without shuffling.

# %%
show_code(sh_basis)

# %% [markdown]
# ## They are orthonormal
#
# Integrated over the sphere, the product of two different functions is 0 and the square of each is 1. So a coefficient
# can be read off a colour function by one integral, and leaving out high degrees leaves the best fit that the lower
# degrees can give. A product of two functions has degree 6 at most; Gauss-Legendre nodes in z with equal steps in
# azimuth integrate that exactly, and the picture below holds no approximation.

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
#
# $$d = \frac{\mu - o}{|\mu - o|}, \qquad o = -R^\top t, \qquad \text{colour} = \max\bigl(0,\; c(d)\bigr)$$

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
    for channel, color in enumerate(("#d2493f", "#3f8f6b", "#35608c")):
        axes.plot(np.degrees(fine), seen[strength][:, channel], color=color, label=("red", "green", "blue")[channel])
    axes.axhspan(1, 1.6, color="#8a8580", alpha=0.15)
    axes.set(xlabel="camera azimuth [degrees]", ylabel="colour", xticks=range(0, 361, 60), ylim=(-0.1, 1.6))
    axes.set_title(f"coefficient {strength}" + (": the sum goes below 0 and is cut" if strength > 1 else ""))
    axes.legend(loc="upper center", ncols=3, fontsize=8)
plt.show()

# %% [markdown]
# Below zero a colour is cut, and a cut channel passes no gradient. Above one it is not: in the grey band a display
# clips it, but the loss still sees it.

# %%
show_code(sh_colors)

# %% [markdown]
# ## A glossy ball
#
# A red ball of 1,500 flat Gaussians under one lamp. Its true colour is matte shading plus a highlight,
# $0.6\,(n\cdot h)^{p}$ with the normal $n$, the direction $h$ halfway between lamp and viewer, and the shininess $p$.
# For each Gaussian the coefficients are fitted by least squares to 100 random directions from which it can be seen.
# Then the ball is rendered from one viewpoint.

# %%
shininess = 40.0  # play: 5 is satin, 200 is lacquer
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

figure, panels = plt.subplots(1, 5, figsize=(10.5, 2.5))
error = {degree: np.sqrt(np.mean((picture - truth) ** 2)) for degree, picture in pictures.items()}
for axes, (title, picture) in zip(
    panels,
    [("exact colours", truth)]
    + [(f"degree {d}: {(d + 1) ** 2} per channel\nRMS error {error[d]:.3f}", p) for d, p in pictures.items()],
    strict=True,
):
    axes.imshow(np.clip(picture, 0, 1))
    axes.set_title(title, fontsize=9)
    axes.axis("off")
plt.show()

# %% [markdown]
# The highlight sharpens with each degree. What one Gaussian near it has learnt, as the camera passes the mirror
# direction:

# %%
n_bright = np.argmax(exact[:, 1])  # the one whose highlight is brightest in the picture above
mirror = 2 * (normals[n_bright] @ lamp) * normals[n_bright] - lamp
side = np.cross(mirror, normals[n_bright]) / np.linalg.norm(np.cross(mirror, normals[n_bright]))
sweep = np.radians(np.linspace(-50, 50, 101))
towards = np.cos(sweep)[:, None] * mirror + np.sin(sweep)[:, None] * side  # unit vectors
figure, axes = plt.subplots(figsize=(6.5, 3))
axes.plot(np.degrees(sweep), glossy_color(normals[n_bright], towards)[:, 1], "k", linewidth=2, label="exact")
for degree, color in zip(range(4), ("#d9d2c7", "#e0a526", "#d2493f", "#35608c"), strict=True):
    curve = 0.5 + sh_basis(-towards, degree) @ coefficients[degree][n_bright, : (degree + 1) ** 2, 1]
    axes.plot(np.degrees(sweep), curve, color=color, label=f"degree {degree}")
axes.set(xlabel="angle from the mirror direction [degrees]", ylabel="green channel", title="one Gaussian of the ball")
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## Play
#
# Set `shininess` to 5 or to 200 and run the two cells above again. The finest bumps of degree 3 are about 60 degrees
# wide, so a lacquered highlight stays out of its reach. Training then blurs it, or puts Gaussians behind the surface
# that imitate the mirror image.
#
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

# Each degree comes closer to the glossy ball, and even the last is not there.
assert error[0] > error[1] > error[2] > error[3] > 0.002
assert error[3] < 0.5 * error[0]
