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
# # 18 Order, rays, light
#
# 3DGS sorts whole Gaussians, and flattens each on the image plane. Both are approximations of what a ray through the
# pixel would meet. This notebook removes them one after the other: each pixel gets an order of its own, footprints move
# to planes that turn with the eye, rays become fewer where nobody looks, and in the end nothing is projected: rays are
# traced, and go on behind mirrors and glass.
#
# ## A picture that pops
#
# A red disc lies a little nearer than a blue one, as the camera's z measures it. The camera stands still and turns by
# one degree. Nothing has moved, so nothing that a ray sees should change. On the right is the colour of one ray,
# through the place where the discs overlap.

# %%
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

from data_tools.claims.pixel_order import ANGLES, BARE, cloud, orders, peak_responses, projection_errors
from data_tools.claims.rays.demo import (
    BIAS,
    CENTRE,
    LAMP,
    MIRROR_CORNER,
    MIRROR_SIDES,
    ball,
    concatenate_populations,
    discs,
    floor,
    world_of,
)
from figures import BLUE, GREEN, GREY, PLUM, RED, YELLOW, draw_ellipses, show
from minisplat_ref.constants import GSPLAT_MAIN, SH_C0
from minisplat_ref.extensions.pixel_order.model import ORDERED
from minisplat_ref.extensions.rays.lights import (
    GLASS,
    MIRROR,
    Surroundings,
    concatenate_surfaces,
    make_surfaces,
    parallelogram,
    shade,
)
from minisplat_ref.extensions.rays.model import build_tree, whiten_model
from minisplat_ref.extensions.vr.foveation import Gaze, eccentricities, render_foveated, zone_begins, zone_weights
from minisplat_ref.mechanisms.meshes.mesh import Mesh
from minisplat_ref.mechanisms.rays.pixel_rays import pixel_rays
from minisplat_ref.mechanisms.tangent.rays import ewa_hits, ray_colors, tangent_hits, yaw_camera
from minisplat_ref.reference.covariance import covariances
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import SPLATTING, Request, activate
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Model, Primitives, view_from

# %%
SIZE = 64
camera = Camera(np.eye(3), np.zeros(3), 80.0, 80.0, SIZE / 2, SIZE / 2, SIZE, SIZE)
PAINT = np.array([[0.85, 0.2, 0.15], [0.15, 0.35, 0.75]])
FACING = np.tile([0.0, 0.0, 1.0], (2, 1))
APART = 0.03  # in depth
pair = discs(np.array([[-0.3, 0.0, 4.0], [0.3, 0.0, 4.0 + APART]]), FACING, 0.45, PAINT)
FLIP = np.arctan(APART / 0.6)  # the yaw at which both means have the same camera z
TURNS = FLIP + np.radians([-0.5, 0.5])
WAYS = {"3DGS: one order for all": SPLATTING, "an order for each pixel": ORDERED.renderer}


def pictured(gaussians, renderer, view_camera, background=1.0, render=None):
    """Return the picture of Gaussians by a renderer of the reference, over grey or white."""
    request = Request(np.full(3, background), backend=REFERENCE)
    return (render or renderer.render)(Model(gaussians), view_from(view_camera), request)[0].image


seen = {name: [pictured(pair, renderer, yaw_camera(camera, yaw)) for yaw in TURNS] for name, renderer in WAYS.items()}
yaws = FLIP + np.radians(np.linspace(-3, 3, 61))
ray = np.array([[0.0, 0.0, 1.0]])  # of the world: it stays where it is
on_ray = {
    name: np.concatenate(
        [ray_colors(way, activate(pair), PAINT, yaw_camera(camera, yaw), ray, GSPLAT_MAIN) for yaw in yaws]
    )
    for name, way in zip(WAYS, ("3DGS: EWA, by z", "tangent planes, exact order"), strict=True)
}

figure = plt.figure(figsize=(11, 4.3))
panels = figure.subplot_mosaic([["a0", "a1", "ad", "curve"], ["b0", "b1", "bd", "curve"]], width_ratios=(1, 1, 1, 1.6))
for row, (name, images) in zip("ab", seen.items(), strict=True):
    show(panels[f"{row}0"], images[0], name)
    show(panels[f"{row}1"], images[1], "one degree later")
    change = np.abs(images[1] - images[0]).max(axis=2)
    show(panels[f"{row}d"], change, f"change: at most {change.max():.2f}", cmap="magma", vmin=0, vmax=0.5)
for (name, colors), style in zip(on_ray.items(), ("-", "--"), strict=True):
    for channel, color in ((0, RED), (2, BLUE)):
        panels["curve"].plot(np.degrees(yaws - FLIP), colors[:, channel], style, color=color)
    panels["curve"].plot([], [], style, color=GREY, label=name)
panels["curve"].set(xlabel="yaw [degrees]", title="one ray's red and blue", ylim=(0, 1))
panels["curve"].legend(loc="upper left")
plt.show()

# %% [markdown]
# Where the discs overlap, 3DGS shows red in front, and one degree later blue. All pixels change at once, because the
# camera's z of the two *means* has changed its order. That is popping. In the lower row the picture shifts by one
# degree, which leaves a change along the rims, and the ray keeps its colour to rounding.
#
# A pixel with an order of its own asks where *on its ray* $t\,d$ each Gaussian, with mean $x$ and covariance $C$ in the
# camera's frame, is densest, and sorts its hits by that:
#
# $$ t = \frac{d^T C^{-1} x}{d^T C^{-1} d} . $$
#
# | folder, file | what it holds |
# |---|---|
# | `minisplat_ref/extensions/pixel_order/` | exact order, k-buffer, tangent planes (StopThePop, Optimal Projection) |
# | `minisplat_ref/mechanisms/tangent/planes.py` | the formulas of both |
# | `minisplat_ref/extensions/vr/` | the same on a small model, with foveation (VRSplat) |
# | `minisplat_ref/extensions/rays/` | tracing with a tree; shadows, mirrors, glass (RaySplats) |
#
# **Frames and units:** camera axes are x right, y down, z forward; lengths are world units, angles degrees. A *hit* is
# a Gaussian whose alpha at a pixel is at least 1/255.
#
# ## Who is in front depends on the pixel
#
# Now the two discs cross like the sheets of an open book. The plan from above shows three rays with their two
# densest points. On the left of the crossing red comes first, on the right blue. One order for the whole picture cannot
# be right on both sides.

# %%
LEAN = np.radians(35)
normals = np.array([[np.sin(LEAN), 0.0, -np.cos(LEAN)], [-np.sin(LEAN), 0.0, -np.cos(LEAN)]])
crossed = discs(np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 4.0 + 1e-3]]), -normals, 0.5, PAINT)
precisions = np.linalg.inv(covariances(crossed.quats, np.exp(crossed.log_scales)))


def densest(d):
    """Return t of the densest point of each Gaussian on rays d [P, 3] from the origin: [N, P]."""
    return np.einsum("pi,nij,nj->np", d, precisions, crossed.means) / np.einsum("pi,nij,pj->np", d, precisions, d)


figure, axes = plt.subplots(1, 3, figsize=(11, 3), width_ratios=(1.6, 1, 1))
for mean, C, color in zip(crossed.means, covariances(crossed.quats, np.exp(crossed.log_scales)), PAINT, strict=True):
    flat = C[np.ix_([0, 2], [0, 2])]
    draw_ellipses(axes[0], mean[[0, 2]], flat, 2, fill=True, facecolor=color, alpha=0.5)
fan = np.array([[slope, 0.0, 1.0] for slope in (-0.12, 0.0, 0.12)])
for d, ts in zip(fan, densest(fan).T, strict=True):
    axes[0].plot([2.6 * d[0], 5.2 * d[0]], [2.6, 5.2], color=GREY, linewidth=0.8)
    for t, color in zip(ts, PAINT, strict=True):
        axes[0].plot(t * d[0], t, "o", color=color, markeredgecolor="black")
axes[0].set(
    aspect="equal", xlim=(-1.5, 1.5), ylim=(2.8, 5.2), xlabel="x", ylabel="z, away from the eye", title="from above"
)
books = [pictured(crossed, renderer, camera) for renderer in WAYS.values()]
for panel, image, name in zip(axes[1:], books, WAYS, strict=True):
    show(panel, image, name)
plt.show()

# %% [markdown]
# Sorting all hits of all pixels is expensive, so StopThePop keeps a small buffer: a pixel reads the list, which is
# sorted by distance, holds back $k$ hits, and always blends the nearest of those. How many are enough? Below is a cloud
# of 80 overlapping Gaussians. The error is the difference from the exact order.

# %%
CLOUD_CAMERA = Camera(np.eye(3), np.zeros(3), 48.0, 48.0, 24.0, 24.0, 48, 48)
primitives, cloud_colors = cloud(80, np.random.default_rng(1))
logits = np.log(primitives.opacities / (1 - primitives.opacities))
cloudy = pair._replace(
    means=primitives.means,
    quats=primitives.quats,
    log_scales=np.log(primitives.scales),
    opacity_logits=logits,
    sh_dc=(cloud_colors - 0.5) / SH_C0,
    sh_rest=np.zeros((80, 0, 3)),
)
BUFFERS = (1, 4, 16)
exact = pictured(cloudy, ORDERED.renderer, CLOUD_CAMERA, 0.0)
buffered = {
    k: pictured(cloudy, None, CLOUD_CAMERA, 0.0, partial(ORDERED.renderer.render, buffer_size=k)) for k in BUFFERS
}
every = np.stack(np.meshgrid(np.arange(0, 48, 4) + 0.5, np.arange(0, 48, 4) + 0.5), axis=-1).reshape(-1, 2)
shares = {row["order"]: row["misordered"] for row in orders(primitives, cloud_colors, CLOUD_CAMERA, every)}

figure, axes = plt.subplots(1, 5, figsize=(11, 2.6), width_ratios=(1, 1, 1, 1, 1.3))
show(axes[0], exact, "exact order")
for panel, (k, image) in zip(axes[1:4], buffered.items(), strict=True):
    error = np.abs(image - exact).max(axis=2)
    title = "list by distance" if k == 1 else f"buffer of {k}"
    show(panel, error, f"{title}: {error.max():.2f}", cmap="magma", vmin=0, vmax=0.1)
axes[4].barh(list(shares), [100 * share for share in shares.values()], color=BLUE)
axes[4].invert_yaxis()
axes[4].set(title="pairs of hits out of order [%]")
plt.show()

# %% [markdown]
# ## Footprints at the edge of a wide picture
#
# Five equal balls stand on a circle around the eye. A wide camera stretches what lies at its edges, and so it should:
# on a large screen in front of the eye a ball at 56 degrees must be an ellipse. The top row is what rays meet, and
# below it is what two footprints add to that (red) or lack (blue). 3DGS expands the perspective at the ball's centre on
# the *image plane* (notebook 01) and errs more and more; a plane that *touches the unit sphere* in the direction of the
# ball does not know where the image plane is.

# %%
ROUND = np.radians([-56, -31, 0, 31, 56])
wide = Camera(np.eye(3), np.zeros(3), 60.0, 60.0, 120.0, 30.0, 240, 60)
balls = Primitives(
    np.column_stack([np.sin(ROUND), np.zeros(5), np.cos(ROUND)]),
    np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)),
    np.full((5, 3), 0.12),
    np.ones(5),
)
ys, xs = np.mgrid[: wide.height, : wide.width] + 0.5
rays_of_pixels = pinhole_rays(xs.ravel(), ys.ravel(), wide)
strips = {"rays": peak_responses(balls, rays_of_pixels)}
for name, hits in (("EWA", ewa_hits), ("tangent planes", tangent_hits)):
    found = hits(balls, wide, rays_of_pixels, BARE)
    strips[name] = np.zeros_like(strips["rays"])
    strips[name][found.ids] = found.hit.unclamped
off_axis = projection_errors(4, seed=0)

figure = plt.figure(figsize=(11, 4.2))
panels = figure.subplot_mosaic(
    [["rays", "graph"], ["EWA", "graph"], ["tangent planes", "graph"]], width_ratios=(2.3, 1)
)
size = wide.height, wide.width
show(panels["rays"], strips["rays"].max(axis=0).reshape(size), "alpha on rays", cmap="magma", vmin=0, vmax=1)
for name in ("EWA", "tangent planes"):
    error = (strips[name].max(axis=0) - strips["rays"].max(axis=0)).reshape(size)
    drawn = show(
        panels[name], error, f"{name}: error up to {np.abs(error).max():.2f}", cmap="RdBu_r", vmin=-0.2, vmax=0.2
    )
    panels[name].contour(strips["rays"].max(axis=0).reshape(size), [0.3], colors=GREEN, linewidths=0.8)
for (name, errors), color in zip(off_axis.items(), (RED, BLUE), strict=True):
    panels["graph"].plot(ANGLES, 100 * np.array(errors), "o-", color=color, label=name)
panels["graph"].set(title="error of random Gaussians [%]", xlabel="degrees off the axis", ylim=(0, None))
panels["graph"].legend()
plt.show()

# %% [markdown]
# The green line is where the true alpha is 0.3, in both rows. With $r = |x|$, $n = x / r$ and
# $P = I - n n^T$ the footprint on the tangent plane is
#
# $$ G = \frac{P C P}{r^2} + e P, \qquad m = \frac{d}{n \cdot d} - n, \qquad
#    \alpha = o \exp\left(-\tfrac12 m^T G^{+} m\right) . $$
#
# Only rays appear in it. What stays of the error is that of any flat footprint, and it is the same at all angles. So a
# camera that turns sees the same, whatever the angle; this and the order together are what the first picture needed.
#
# ## Fewer rays where nobody looks
#
# In a headset most pixels are far from where the eye looks. The least angle that the eye resolves grows about linearly
# with the angle to the gaze, the *eccentricity* $e$. VRSplat draws every pixel near the gaze, then one ray for blocks
# of 2 x 2 and of 4 x 4 pixels, and interpolates between them.

# %%
scene = concatenate_populations(ball(), floor())
headset = Camera(np.eye(3), np.zeros(3), 90.0, 90.0, 72.0, 54.0, 144, 108)
request = Request(np.array([0.1, 0.12, 0.16]), backend=REFERENCE)
at = headset.fx * CENTRE[:2] / CENTRE[2] + [headset.cx, headset.cy]
gaze = Gaze(float(at[0]), float(at[1]), 5.0)
foveated, zones = render_foveated(Model(scene), headset, request, gaze, None)
full = ORDERED.renderer.render(Model(scene), view_from(headset), request)[0].image
angles = eccentricities(headset, gaze.x, gaze.y)
weights = zone_weights(angles, gaze.full)

figure, axes = plt.subplots(1, 4, figsize=(11, 2.5), width_ratios=(1, 1, 1, 0.9))
show(axes[0], full, "every pixel a ray")
show(axes[1], foveated, "foveated")
for panel in axes[:2]:
    panel.plot(gaze.x, gaze.y, "+", color="white", markersize=10)
error = np.abs(foveated - full).max(axis=2)
show(axes[2], error, "difference, and where zones begin", cmap="magma", vmin=0, vmax=0.4)
axes[2].contour(angles, zone_begins(gaze.full)[1:], colors=[GREEN, YELLOW], linewidths=1)
n_rays = [zone.n_samples for zone in zones]
axes[3].bar(["all"], [headset.width * headset.height], color=GREY)
base = 0
for zone, n, color in zip(zones, n_rays, (GREEN, YELLOW, RED), strict=True):
    axes[3].bar(["foveated"], [n], bottom=base, color=color, label=f"blocks of {zone.block} x {zone.block}")
    base += n
axes[3].set(title="rays", ylim=(0, 1.5 * headset.width * headset.height))
axes[3].legend(fontsize=7.5)
plt.show()
within, beyond = (error[is_in].max() for is_in in (angles < gaze.full, angles >= gaze.full))
print(
    f"{sum(n_rays)} of {error.size} rays; largest error within {gaze.full:g} degrees {within:.1e}, beyond {beyond:.2f}"
)

# %% [markdown]
# $$ \mathrm{MAR}(e) = w + m\,e, \qquad \text{a zone begins where MAR has doubled once more.} $$
#
# Tiles are drawn whole, so that a zone takes more rays than it has pixels. On a page the blur is plain to see, because
# this picture is small and you may look anywhere in it. On a display that fills 77 degrees of your view, and as fine as
# the eye where it looks, a block is as large as what the eye cannot tell apart there.
#
# ## Nothing projected: the closest response
#
# RaySplats asks the same question as the order above, where a ray comes nearest to a Gaussian, and takes alpha there as
# well. Left: a ray, three Gaussians, and on each the point of the closest response. Right: the response along the ray,
# and what is left of the light behind each hit.

# %%
in_plane = Primitives(
    np.array([[-0.15, 0.0, 2.0], [0.25, 0.0, 3.1], [-0.1, 0.0, 4.2]]),
    np.array([[np.cos(a / 2), 0.0, np.sin(a / 2), 0.0] for a in (0.5, -0.9, 0.2)]),
    np.array([[0.5, 0.3, 0.15], [0.2, 0.3, 0.6], [0.45, 0.3, 0.3]]),
    np.array([0.6, 0.7, 0.9]),
)
three = pair._replace(
    means=in_plane.means,
    quats=in_plane.quats,
    log_scales=np.log(in_plane.scales),
    opacity_logits=np.log(in_plane.opacities / (1 - in_plane.opacities)),
)
M = whiten_model(Model(three)).maps
d = np.array([0.03, 0.0, 1.0])
p, v = np.einsum("nij,nj->ni", M, in_plane.means), M @ d
nearest = np.sum(v * p, axis=1) / np.sum(v * v, axis=1)
ts = np.linspace(1, 5.4, 400)
along = in_plane.opacities[:, None] * np.exp(-0.5 * np.sum((p[:, None] - ts[:, None] * v[:, None]) ** 2, axis=2))
alphas = in_plane.opacities * np.exp(-0.5 * np.sum((p - nearest[:, None] * v) ** 2, axis=1))
left = np.concatenate([[1], np.cumprod(1 - alphas)])

figure, axes = plt.subplots(1, 2, figsize=(11, 3), width_ratios=(1, 1.2))
sigmas = covariances(in_plane.quats, in_plane.scales)
for mean, C, t, color in zip(in_plane.means, sigmas, nearest, (RED, YELLOW, BLUE), strict=True):
    for n_sigmas in (1, 2):
        draw_ellipses(axes[0], mean[[2, 0]], C[np.ix_([2, 0], [2, 0])], n_sigmas, fill=True, facecolor=color, alpha=0.3)
    axes[0].plot(t, t * d[0], "o", color=color, markeredgecolor="black")
axes[0].plot(ts, ts * d[0], color="black", linewidth=0.8)
axes[0].set(aspect="equal", xlabel="z", ylabel="x", xlim=(1, 5.4), ylim=(-1.1, 1.1), title="a ray from the left")
for line, t, alpha, color in zip(along, nearest, alphas, (RED, YELLOW, BLUE), strict=True):
    axes[1].plot(ts, line, color=color)
    axes[1].plot(t, alpha, "o", color=color, markeredgecolor="black")
axes[1].step([1, *nearest, 5.4], [*left, left[-1]], where="post", color=PLUM, label="transmittance")
axes[1].set(xlabel="t", ylim=(0, 1.05), title="response along the ray; dots: alpha")
axes[1].legend()
plt.show()

# %% [markdown]
# With $M = \operatorname{diag}(1/s)\,R^T$, which turns the Gaussian into the unit ball,
#
# $$ p = M(\mu - O), \quad v = M d, \quad t = \frac{v \cdot p}{v \cdot v}, \quad
#    \alpha = o \exp\left(-\tfrac12 |p - t v|^2\right), \qquad C = \sum_i c_i \alpha_i \prod_{j < i} (1 - \alpha_j) . $$
#
# ## A tree, so that a ray asks few
#
# Without tiles, which Gaussians does a ray have to ask? Boxes are put into boxes, halved at the median, until at most
# eight Gaussians are in one. A ray that misses a box misses all that is in it. The plan from above shows boxes of three
# levels around the ball and its floor; then how many of the 876 Gaussians each ray asks, and how many it hits.

# %%
eye = Camera(np.eye(3), np.zeros(3), 132.0, 132.0, 60.0, 45.0, 120, 90)
tree = build_tree(whiten_model(Model(scene)), GSPLAT_MAIN)
rays = pixel_rays(eye, GSPLAT_MAIN)
n_asked, n_boxes = np.zeros(len(rays.near), int), np.zeros(len(rays.near), int)
by_level = {}


def enters(box, ids):
    """Return which rays pass through a box: between its planes on all three axes at once."""
    with np.errstate(divide="ignore", invalid="ignore"):
        times = (box.reshape(2, 1, 3) - rays.origins[ids]) / rays.directions[ids]
    return times.min(axis=0).max(axis=1) <= times.max(axis=0).min(axis=1)


def descend(node, ids, level):
    """Follow rays through both halves of a node; count what they ask."""
    for box, (first, count) in zip(tree.boxes[node], tree.children[node], strict=True):
        by_level.setdefault(level, []).append(box)
        n_boxes[ids] += 1
        inside = ids[enters(box, ids)]
        if count >= 0:
            n_asked[inside] += count
        elif len(inside):
            descend(first, inside, level + 1)


descend(0, np.arange(len(rays.near)), 0)
world = world_of(scene, Surroundings(np.zeros((0, 3)), 1.0, 0.0, concatenate_surfaces([])), request.background)
hits = world.tracer.list_hits(rays, GSPLAT_MAIN)
n_hits = np.diff(hits.offsets)

figure, axes = plt.subplots(1, 3, figsize=(11, 3), width_ratios=(1.1, 1, 1))
axes[0].plot(scene.means[:, 0], scene.means[:, 2], ",", color=GREY)
for level, color, width in ((1, RED, 1.6), (3, YELLOW, 1.2), (5, BLUE, 0.7)):
    for low_x, _, low_z, high_x, _, high_z in by_level[level]:
        style = {"fill": False, "edgecolor": color, "linewidth": width}
        axes[0].add_patch(Rectangle((low_x, low_z), high_x - low_x, high_z - low_z, **style))
axes[0].set(aspect="equal", xlabel="x", ylabel="z", title="boxes of levels 1, 3 and 5, from above")
for panel, counts, name in ((axes[1], n_asked, "asked"), (axes[2], n_hits, "hit")):
    drawn = show(
        panel, counts.reshape(eye.height, eye.width), f"Gaussians {name}: {counts.mean():.1f} a ray", cmap="magma"
    )
    figure.colorbar(drawn, ax=panel, shrink=0.8)
plt.show()
asked = f"{n_asked.mean():.0f} of {len(scene.means)} Gaussians and {n_boxes.mean():.0f} boxes"
print(f"a ray asks {asked}, and hits {n_hits.mean():.1f}")

# %% [markdown]
# ## Light: a shadow, a mirror, glass
#
# A ray that is traced may start anywhere. From each hit one more goes to the lamp, and what it meets on its way is
# shadow. At a mirror a ray goes on with $d' = d - 2 (d \cdot n)\, n$, at glass by Snell's law, and Schlick's formula
# divides the light between the two. Nothing of it needs a new formula for the Gaussians.

# %%
DARK = request.background
NO_LAMP, NO_SURFACE = np.zeros((0, 3)), concatenate_surfaces([])


def cube(centre, half, yaw):
    """Return the mesh of a cube that is turned about the vertical; its normals point outwards."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([triangle for a, b, c, e in sides for triangle in ((a, b, c), (a, c, e))])
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return Mesh(centre + half * corners @ turn.T, faces)


mirror = make_surfaces(parallelogram(MIRROR_CORNER, MIRROR_SIDES), MIRROR, np.array([0.9, 0.9, 0.95]))
block = make_surfaces(cube(np.array([0.15, 0.58, 3.3]), 0.3, 0.5), GLASS, np.array([0.95, 1.0, 0.97]), 1.5)
around = {
    "as it was photographed": Surroundings(NO_LAMP, 1.0, 0.0, NO_SURFACE),
    "a lamp": Surroundings(LAMP[None], 0.35, BIAS, NO_SURFACE),
    "a mirror": Surroundings(LAMP[None], 0.35, BIAS, concatenate_surfaces([mirror])),
    "a block of glass": Surroundings(LAMP[None], 0.35, BIAS, concatenate_surfaces([mirror, block])),
}
lit = {
    name: shade(world_of(scene, these, DARK), rays).reshape(eye.height, eye.width, 3) for name, these in around.items()
}
figure, axes = plt.subplots(1, 4, figsize=(11, 2.4))
for panel, (name, image) in zip(axes, lit.items(), strict=True):
    show(panel, image, name)
plt.show()

# %% [markdown]
# The ball's shadow lies on the floor and, in the mirror, once more. The block of glass shows what is behind it shifted,
# and folded where a ray leaves by another side than the opposite one. Its dark parts are rays that end, because three
# surfaces are the most that a ray follows, or that see nothing but the background. A Gaussian's colour holds the light
# under which it was photographed, and the lamp's shadow comes on top of that: this is a sketch of new light and no
# relighting.
#
# ## Play
#
# Two discs, one behind the other, and a turning camera. What to look for:
#
# * `apart`: at which yaw does 3DGS pop? Set it to 0.3: can you still make it pop?
# * `lean`: turn both discs so that they cross. Which of the two renderers changes its mind by pixels?

# %%
apart, lean, yaw = 0.06, 0.0, 7.0  # world units, degrees, degrees

leaning = np.array([[np.sin(np.radians(s * lean)), 0.0, np.cos(np.radians(lean))] for s in (-1, 1)])
two = discs(np.array([[-0.3, 0.0, 4.0], [0.3, 0.0, 4.0 + apart]]), leaning, 0.45, PAINT)
figure, axes = plt.subplots(1, 4, figsize=(11, 2.7))
for panel, (degrees, (name, renderer)) in zip(axes, [(a, way) for way in WAYS.items() for a in (0, yaw)], strict=True):
    show(panel, pictured(two, renderer, yaw_camera(camera, np.radians(degrees))), f"{name}, yaw {degrees:g}")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** What a mirror shows is what another camera would see without it. Where does that camera stand, and how is it
# turned? `mirror_difference` compares the two pictures of random Gaussians behind the eye.
#
# <details>
# <summary>Solution</summary>
#
# At the mirror image of the eye, $O' = O - 2\,((O - q) \cdot n)\, n$ for a point $q$ of the mirror, with all its axes
# mirrored: its frame is left-handed. Nothing in tracing asks for a right-handed one. The ray that leaves the mirror
# keeps its $t$, so that its origin is that camera, exactly.
#
# ```python
# from data_tools.claims.rays.measures import mirror_difference
#
# assert mirror_difference(40, seed=0) < 1e-9
# ```
#
# </details>
#
# **2.** How large must the buffer be, so that the cloud above is drawn exactly? Is there a bound that needs no
# measurement?
#
# <details>
# <summary>Solution</summary>
#
# A buffer that holds all hits of a pixel sorts them all, so that the largest number of hits is enough; usually far less
# is. 64 hits are enough for these 80 Gaussians, since none of the pixels has more.
#
# ```python
# roomy = partial(ORDERED.renderer.render, buffer_size=64)
# assert np.array_equal(pictured(cloudy, None, CLOUD_CAMERA, 0.0, roomy), exact)
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# One ray's colour jumps in 3DGS as its order changes, and stays, to rounding, with an order by rays.
jumps = {name: np.abs(np.diff(colors, axis=0)).max() for name, colors in on_ray.items()}
assert jumps["3DGS: one order for all"] > 0.4 and jumps["an order for each pixel"] < 1e-9
# Of the crossed discs 3DGS puts one in front everywhere; by pixel, red wins on one side and blue on the other.
is_red = [image[SIZE // 2, :, 0] > image[SIZE // 2, :, 2] for image in books]
middle = slice(SIZE // 2 - 6, SIZE // 2 + 6)
assert len(set(is_red[0][middle])) == 1 and len(set(is_red[1][middle])) == 2
ts_of_fan = densest(fan)
assert ts_of_fan[0, 0] < ts_of_fan[1, 0] and ts_of_fan[0, 2] > ts_of_fan[1, 2]
# Larger buffers are nearer to the exact order.
errors = [np.abs(image - exact).max() for image in buffered.values()]
assert errors[0] > errors[1] > errors[2] and shares["exact"] == 0
assert shares["list by z"] > shares["buffer of 4"] > shares["buffer of 16"]
# EWA's error grows with the angle, that of tangent planes does not.
ewa, tangent = (np.array(found) for found in off_axis.values())
assert ewa[-1] > 2 * ewa[0] and np.ptp(tangent) < 0.01 * tangent[0] and abs(ewa[0] - tangent[0]) < 0.02
# Near the gaze every pixel is as before, and fewer rays are drawn in all.
assert within < 1e-9 and beyond > 0.05
assert sum(n_rays) < 0.7 * headset.width * headset.height and np.allclose(sum(weights), 1)
# The closest response is the largest on the ray.
assert np.allclose(along.max(axis=1), alphas, atol=1e-3) and np.all(along.max(axis=1) <= alphas + 1e-12)
# A ray asks few, and never fewer than it hits.
assert np.all(n_asked >= n_hits) and n_asked.mean() < 0.15 * len(scene.means) and n_hits.max() > 1
# A lamp only takes light away; the mirror changes nothing where it is not seen.
assert np.all(lit["a lamp"] <= lit["as it was photographed"] + 1e-12)
assert (lit["as it was photographed"] - lit["a lamp"]).max() > 0.2
changed = np.abs(lit["a mirror"] - lit["a lamp"]).max(axis=2) > 0.02
assert 0.02 < changed.mean() < 0.4 and not changed[:, : eye.width // 2].any()
assert np.abs(lit["a block of glass"] - lit["a mirror"]).max() > 0.1
print("all of the above holds")
