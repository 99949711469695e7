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
# # 23 Cameras that are not pinholes
#
# A pinhole is one rule: the pixel is x/z. A fisheye, a lens that bends lines, and a satellite that is so far away that
# its rays are parallel have other rules, and a hologram has no rays at all. This notebook draws the same Gaussians
# through each of them.
#
# ## One room, four cameras
#
# The room is ray-traced. Every pixel of its photographs becomes a small ball, as deep as the pixel is; nothing is
# trained.

# %%
import matplotlib.pyplot as plt
import numpy as np

from data_tools.claims.lens import footprints
from data_tools.claims.wave import measures as claims
from figures import BLUE, GREEN, GREY, RED, show, show_code
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.extensions.lens.model import THROUGH_LENS
from minisplat_ref.extensions.wave.blending import Scene, blend
from minisplat_ref.extensions.wave.model import propagate
from minisplat_ref.mechanisms.cameras.affine import orthographic, with_affine
from minisplat_ref.mechanisms.cameras.models import model_of, ray_table
from minisplat_ref.mechanisms.cameras.ray_footprints import hit
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import SPLATTING, Request
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Gaussians, Model, Optics, Primitives, view_from

# %%
made = make_scene("room", n_views=16, width=120, height=90, supersampling=1, n_points=100)
places, sizes, colors = [], [], []
for view, depth in zip(made.scene.train_views, made.train_depths, strict=True):
    camera, (y, x) = view.camera, np.nonzero(depth[::2, ::2])
    x, y = 2 * x, 2 * y
    z = depth[y, x]
    in_camera = z[:, None] * pinhole_rays(x + 0.5, y + 0.5, camera)
    places.append((in_camera - camera.cam_from_world_t) @ camera.cam_from_world_R)
    sizes.append(1.1 * z / camera.fx)
    colors.append(view.image[y, x] / 255)
n = sum(map(len, places))
room = Gaussians(
    np.concatenate(places).astype(np.float32),
    np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
    np.log(np.concatenate(sizes))[:, None].repeat(3, axis=1).astype(np.float32),
    np.full(n, 2.0, np.float32),
    ((np.concatenate(colors) - 0.5) / SH_C0).astype(np.float32),
    np.zeros((n, 0, 3), np.float32),
)
print(f"{n:,} balls")

# %% [markdown]
# From one place, with one image size of 180 x 180 pixels: a pinhole of 70 degrees, a pinhole of 130 degrees, a fisheye
# of 170 degrees, and parallel rays. The pinholes share a rule, and the wide one spends most of its pixels on its
# corners. The fisheye gives each degree as many pixels. In parallel rays, what is far is as large as what is near.

# %%
SIZE, pose = 180, made.scene.train_views[3].camera


def camera_of(focal, optics=None):
    return Camera(pose.cam_from_world_R, pose.cam_from_world_t, focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE, optics)


half = SIZE / 2
cameras = {
    "pinhole, 70 degrees": camera_of(half / np.tan(np.radians(35))),
    "pinhole, 130 degrees": camera_of(half / np.tan(np.radians(65))),
    "fisheye, 170 degrees": camera_of(half / np.radians(85), Optics("fisheye", (0.0, 0.0, 0.0, 0.0))),
    "parallel rays, 4 m wide": camera_of(SIZE / 4),
}
images = {}
for name, camera in cameras.items():
    is_parallel = name.startswith("parallel")
    renderer = THROUGH_LENS.renderer if camera.optics else SPLATTING
    request = Request(backend=with_affine(CPU, orthographic) if is_parallel else CPU)
    images[name] = renderer.render(Model(room), view_from(camera), request)[0].image
figure, axes = plt.subplots(1, 4, figsize=(10.8, 2.9))
for axis, (name, image) in zip(axes, images.items(), strict=True):
    show(axis, image, name)
_ = figure

# %% [markdown]
# ## A camera is a value with functions
#
# Every camera here answers three questions: where is a point in the image, which ray does a pixel have, and by which
# depth are Gaussians sorted. Lenses of photographs bend the rays of a pinhole by polynomials (Brown); a fisheye
# replaces tan by the angle itself, times a polynomial (Kannala and Brandt).

# %%
lenses = {
    "pinhole": (100.0, None, GREY),
    "barrel": (100.0, Optics("brown", (-0.2, 0.03, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), BLUE),
    "cushion": (100.0, Optics("brown", (0.15, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)), GREEN),
    "fisheye": (100.0, Optics("fisheye", (0.0, 0.0, 0.0, 0.0)), RED),
}
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), width_ratios=(1, 1.3))
line = np.column_stack([np.full(81, 0.6), np.linspace(-0.7, 0.7, 81), np.ones(81)])
radii = {}
for name, (focal, optics, color) in lenses.items():
    camera = Camera(np.eye(3), np.zeros(3), focal, focal, 0.0, 0.0, 200, 200, optics)
    model = model_of(camera)
    angles = np.radians(np.arange(0, 51 if optics and name != "fisheye" else 76))
    rays = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])
    radii[name] = model.project(rays, camera)[:, 0]
    left.plot(np.degrees(angles), radii[name], color=color, label=name)
    bent = model.project(line, camera)
    right.plot(bent[:, 0], bent[:, 1], color=color, label=name)
left.set(xlabel="angle from the axis (degrees)", title="distance from the centre (pixels)", ylim=(0, 250))
right.set(xlabel="x (pixels)", title="a straight edge, y (pixels)")
left.legend()
_ = figure

# %% [markdown]
# ## Footprints along rays
#
# 3DGS draws an ellipse: the projection is replaced by its tangent at the mean of a Gaussian (EWA). Far from the axis of
# a wide lens that is wrong, since a large Gaussian is bent over the image. The exact value of a pixel asks along its
# ray how near the Gaussian comes, in its own deviations; the lens is in the table of rays and nowhere else.

# %%
show_code(hit)

# %%
ahead = Primitives(
    np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[0.3, 0.05, 0.05]]), np.ones(1)
)
camera = footprints.camera_of("fisheye")
R = footprints.turn(60.0)
x, lengths = ahead.means @ R.T, R * ahead.scales
grid = np.arange(footprints.SIZE) + 0.5
pixels = np.stack(np.meshgrid(grid, grid), axis=-1)
table = np.moveaxis(ray_table(camera).reshape(footprints.SIZE, 3, -1)[:, :, : footprints.SIZE], 1, 2)
P = np.linalg.inv(lengths @ lengths.T)
a, b = np.einsum("hwi,ij,hwj->hw", table, P, table), table @ P @ x[0]
exact = np.where(b > 0, np.exp(-(x[0] @ P @ x[0] - b * b / a) / 2), 0)
model = model_of(camera)
J = model.jacobians(x, camera)[0]
offsets = pixels - model.project(x, camera)[0]
ewa = np.exp(-np.einsum("hwi,ij,hwj->hw", offsets, np.linalg.inv(J @ lengths @ (J @ lengths).T), offsets) / 2)
error = np.abs(ewa - exact).sum() / exact.sum()
crop = slice(60, 340), slice(180, 400)
figure, axes = plt.subplots(1, 3, figsize=(8, 3))
for axis, (name, image) in zip(
    axes, {"exact": exact, "EWA": ewa, "difference, 3 times": 3 * np.abs(ewa - exact)}.items(), strict=True
):
    show(axis, np.repeat(image[crop][..., None], 3, axis=2), name)
print(f"EWA is off by {error:.0%} of the footprint, 60 degrees off the axis of a fisheye")
_ = figure

# %% [markdown]
# ## Parallel rays
#
# The rays of a satellite at 500 km hardly diverge over a town, so its camera is affine: pixel = A x + b. Then the
# first-order expansion is exact, every ellipse has the same shape wherever it is, and once all of the room is in front
# of the camera, moving it further along its rays changes nothing.

# %%
camera = cameras["parallel rays, 4 m wide"]
request = Request(backend=with_affine(CPU, orthographic))
away = [camera._replace(cam_from_world_t=camera.cam_from_world_t + np.array([0, 0, z])) for z in (20.0, 21.0)]
seen = [SPLATTING.render(Model(room), view_from(c), request)[0].image for c in away]
distance = np.abs(seen[1] - seen[0]).max()
figure, axis = plt.subplots(figsize=(2.9, 2.9))
show(axis, seen[0], "the room from outside")
print(f"a metre along the rays: the image changes by at most {distance:.1e}")
_ = figure

# %% [markdown]
# ## No rays at all
#
# A hologram stores a wave. Below, three flat Gaussians lie 4 mm before, in and behind the plane of a hologram. The wave
# in that plane is computed once; carried on by 4 mm in either direction, it shows what a lens would see that is focused
# there.

# %%
at = np.array([4e-3, 0.0, -4e-3])
flats = claims.facing(np.column_stack([[-2.5e-4, 0.0, 2.5e-4], np.zeros(3), at]), np.full(3, 1.0e-5))
field = blend(Scene(flats, np.ones(3), np.ones((3, 3))), claims.USUAL, claims.GREEN_LIGHT, 1)
stack = {z: np.abs(propagate(field, claims.USUAL, claims.GREEN_LIGHT, z)) ** 2 for z in at}
figure, axes = plt.subplots(1, 3, figsize=(8, 2.6))
for axis, (z, image) in zip(axes, stack.items(), strict=True):
    show(axis, np.repeat(image[32:96, :, None], 3, axis=2) ** 0.5, f"focused at {1e3 * z:+.0f} mm")
_ = figure

# %% [markdown]
# ## Play
#
# Bend the lens. Beyond some strength a barrel folds over, and a point has no pixel any more.

# %%
k1, view_angle = -0.25, 90
lens = camera_of(half / np.tan(np.radians(view_angle / 2)), Optics("brown", (k1, 0.03, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
figure, axis = plt.subplots(figsize=(2.9, 2.9))
show(axis, THROUGH_LENS.renderer.render(Model(room), view_from(lens), Request())[0].image, f"k1 = {k1:g}")
_ = figure

# %% [markdown]
# ## Exercises
#
# 1. A pinhole and an equidistant fisheye have the same focal length. By which factor is a patch 60 degrees off the axis
#    longer, along the radius, in the pinhole's image?
#
# <details><summary>Solution</summary>
#
# The radius is f tan(t) and f t, so the factor is 1 / cos^2(t) = 4.
#
# ```python
# pinhole, fisheye = np.gradient(radii["pinhole"])[60], np.gradient(radii["fisheye"])[60]
# assert abs(pinhole / fisheye - 4) < 0.01
# ```
#
# </details>
#
# 2. Where does a barrel with k1 = -0.2 fold over, as a tangent of the angle, if all other coefficients are zero?
#
# <details><summary>Solution</summary>
#
# At the maximum of r (1 - 0.2 r^2): 1 = 0.6 r^2.
#
# ```python
# r = np.linspace(0, 2, 20001)
# assert abs(r[np.argmax(r * (1 - 0.2 * r**2))] - (1 / 0.6) ** 0.5) < 1e-3
# ```
#
# </details>

# %% [markdown]
# ## What was shown

# %%
assert radii["barrel"][40] < radii["pinhole"][40] < radii["cushion"][40]
assert np.allclose(radii["fisheye"], 100 * np.radians(np.arange(76)))
assert np.allclose(radii["pinhole"], 100 * np.tan(np.radians(np.arange(76))))
assert 0.05 < error < 1  # EWA, 60 degrees off the axis
assert distance < 1e-3 < 0.1 < np.abs(images["pinhole, 70 degrees"] - images["pinhole, 130 degrees"]).max()
for z, place in zip(at, (-2.5e-4, 0.0, 2.5e-4), strict=True):  # each is sharpest where it is
    own = np.abs(claims.USUAL.x - place) < 8e-5
    assert max(stack, key=lambda plane, own=own: stack[plane][:, own].max()) == z
assert images["fisheye, 170 degrees"].mean() > 0.1
print("all of the above holds")
