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
# # 22 What a mirror needs
#
# A mirror has no colour of its own. What it shows depends on its normal, on how rough it is, and on everything around
# it. Spherical harmonics of degree 3, the colours of 3DGS, can hold a soft shine and no reflection. This notebook takes
# a sphere of polished metal and adds what it lacks: an environment, a material, one shading per surfel or per pixel,
# and what hides the environment (Ref-Gaussian). Then: normals and materials as textures (TextureSplat), and opacities
# that follow from a distance to the surface (Discretized SDF).
#
# ## The light around
#
# The environment is an image over all directions. A rough surface sees it blurred, so it is blurred once for several
# roughnesses, and what a pixel needs is read between two of these maps.

# %%
import matplotlib.pyplot as plt
import numpy as np

from data_tools.claims import reflective as study
from figures import BLUE, GREEN, GREY, RED, YELLOW, show, show_code
from minisplat_ref.extensions.discretized_sdf.model import HALF, opacity_logits
from minisplat_ref.extensions.texture_splat.textures import REACH, find_corners, tangent_normals
from minisplat_ref.io.srgb import encode_srgb
from minisplat_ref.mechanisms.gbuffer.population import PER_PIXEL, PER_SURFEL, WITH_OCCLUSION
from minisplat_ref.mechanisms.gbuffer.prefilter import KNOTS, prefilter
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.mechanisms.gbuffer.shading import Surface, shade
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.rendering import Request
from minisplat_ref.types import Gaussians, Model, view_from

# %%
environment = study.environment()
light = prefilter(environment)
chosen = [0, len(light.maps) // 2, len(light.maps) - 1]
figure, axes = plt.subplots(1, 4, figsize=(10.5, 1.8))
show(axes[0], encode_srgb(environment), "environment")
for axis, k in zip(axes[1:], chosen, strict=True):
    show(axis, encode_srgb(light.maps[k]), f"map {k} of {len(light.maps)}")
_ = figure

# %% [markdown]
# ## A sphere of metal
#
# The truth is traced: each ray meets the sphere, turns around its normal, and reads the environment there. Below is one
# view of it for three roughnesses.

# %%
rng = np.random.default_rng(0)
cameras = study._cameras(rng)
view = study.trace(cameras[0], light)
rough = {}
figure, axes = plt.subplots(1, 3, figsize=(9, 2.2))
for axis, roughness in zip(axes, (0.1, 0.4, 0.8), strict=True):
    n = len(view.normals)
    away = view.normals - view.camera.center
    to_camera = -away / np.linalg.norm(away, axis=1, keepdims=True)
    metal = Surface(np.full((n, 3), study.ALBEDO), np.ones(n), np.full(n, roughness), view.normals, to_camera)
    image = np.ones((*view.is_sphere.shape, 3))
    image[view.is_sphere] = encode_srgb(shade(metal, light)[0])
    rough[roughness] = image
    show(axis, image, f"roughness {roughness}")
_ = figure

# %% [markdown]
# ## Three ways to draw it
#
# Now 2,000 surfels that touch the sphere. In **harmonics**, each has the colours of degree 3 that fit its light best.
# **Per surfel**, each is shaded with its own normal and then blended. **Per pixel**, normals and materials are blended
# first and the result is shaded once, as in Ref-Gaussian and every deferred renderer.

# %%
show_code(shade)

# %%
sphere = study.sphere_of(2000, 0.0, rng)
metal, request = study.metal_of(sphere), Request(wants=frozenset({"normal"}))
images = {
    "harmonics": SURFELS.render(Model(study.fit_harmonics(sphere, light)), view_from(view.camera), request)[0].image
}
for name, stage in (("per surfel", PER_SURFEL), ("per pixel", PER_PIXEL)):
    images[name] = REFLECTIVE.render(study.model_of(metal, stage), view_from(view.camera), request)[0].image
scores = {name: study.compare([view], [image]) for name, image in images.items()}
figure, axes = plt.subplots(1, 4, figsize=(10.5, 2.2))
show(axes[0], view.image, "truth")
for axis, (name, image) in zip(axes[1:], images.items(), strict=True):
    show(axis, image[..., :3], f"{name}: {scores[name]['psnr']:.1f} dB")
_ = figure

# %% [markdown]
# Harmonics lose the stripes. Shading per pixel is the sharper one of the other two, and yet it is further from the
# truth: everything is a little out of place. Of the surfels that a pixel shows, the one in front counts most, and on a
# sphere the one in front faces the camera more. So the blended normal leans towards the camera, and a mirror doubles
# that angle.

# %%
truth = np.zeros((*view.is_sphere.shape, 3))
truth[view.is_sphere] = view.normals
blended = images["per pixel"][..., 3:6] @ view.camera.cam_from_world_R
blended /= np.maximum(np.linalg.norm(blended, axis=2, keepdims=True), 1e-12)
towards = np.zeros_like(truth)
towards[view.is_sphere] = to_camera
facing = np.sum(truth * towards, axis=2)[view.is_sphere]
leaning = np.degrees(
    np.arccos(np.clip(facing, -1, 1)) - np.arccos(np.clip(np.sum(blended * towards, axis=2)[view.is_sphere], -1, 1))
)
figure, axes = plt.subplots(figsize=(5.5, 2.4))
axes.plot(np.degrees(np.arccos(np.clip(facing, -1, 1))), leaning, ".", color=BLUE, markersize=2)
axes.axhline(0, color=GREY, linewidth=1)
axes.set(xlabel="angle between normal and camera (degrees)", title="how far the blended normal leans (degrees)")
_ = figure

# %% [markdown]
# ## What is in the way
#
# A black sphere stands beside the mirror. Without a test for what is in the way, the mirror shows the environment
# through it. Along the reflected ray of each pixel, the surfels' own opacity says how much gets through.

# %%
both = max((study.trace(camera, light, hides=True) for camera in cameras), key=lambda view: view.is_hidden.sum())
black = study.sphere_of(2000, 0.0, rng, study.OTHER)
scene = study.metal_of(Gaussians(*(np.concatenate(fields) for fields in zip(sphere, black, strict=True))))
albedo = scene.albedo_logits.copy()
albedo[len(sphere.means) :] = -study.INFINITE
scene = scene._replace(albedo_logits=albedo)
arms = {}
for name, stage in (("all of the environment", PER_PIXEL), ("with occlusion", WITH_OCCLUSION)):
    arms[name] = REFLECTIVE.render(study.model_of(scene, stage), view_from(both.camera), Request())[0].image
errors = {
    name: np.mean((np.clip(image, 0, 1) - both.image)[both.is_sphere][both.is_hidden] ** 2)
    for name, image in arms.items()
}
figure, axes = plt.subplots(1, 3, figsize=(9, 2.2))
show(axes[0], np.where(both.is_sphere[..., None], both.image, 1), "truth, the mirror alone")
for axis, (name, image) in zip(axes[1:], arms.items(), strict=True):
    show(axis, np.where(both.is_sphere[..., None], np.clip(image, 0, 1), 1), name)
_ = figure

# %% [markdown]
# ## The environment from its reflections
#
# The shading has a gradient with respect to every texel. So images of the sphere alone tell what is around it; what no
# normal reflects towards a camera stays as it was.

# %%
found = study.recover([study.trace(camera, light) for camera in cameras[:4]], rng)
print(f"RMS error of the environment: {found['error_before']:.3f} before, {found['error_after']:.3f} after")

# %% [markdown]
# ## A texture on a disc
#
# One surfel has one normal. TextureSplat gives it T x T, read linearly at the place (u, v) that the ray hits. Below is
# one disc of 4 x 4 texels with a bump, its normals shown as colours, and the same light.

# %%
T = 4
grid = np.linspace(-1, 1, T)
raw = np.stack(np.meshgrid(-1.2 * grid * (np.abs(grid) < 1), -1.2 * grid * (np.abs(grid) < 1)), axis=-1)
u, v = np.meshgrid(np.linspace(-REACH, REACH, 96), np.linspace(-REACH, REACH, 96))
corners = find_corners(u, v, T)
texels = tangent_normals(raw.reshape(-1, 2))  # the three parts along the disc's axes and its normal
read = np.einsum("khw,khwc->hwc", corners.weights, texels[corners.texels])
read /= np.linalg.norm(read, axis=2, keepdims=True)
flat = read.reshape(-1, 3)
upright = np.tile([0.0, 0.0, 1.0], (len(flat), 1))
bumps = Surface(np.full((len(flat), 3), 0.9), np.ones(len(flat)), np.full(len(flat), 0.1), flat, upright)
plain = bumps._replace(normals=upright)
shaded = {name: encode_srgb(shade(s, light)[0]).reshape(96, 96, 3) for name, s in (("T = 1", plain), ("T = 4", bumps))}
figure, axes = plt.subplots(1, 3, figsize=(8, 2.5))
show(axes[0], 0.5 + 0.5 * read, "normals")
for axis, (name, image) in zip(axes[1:], shaded.items(), strict=True):
    show(axis, image, f"shaded, {name}")
_ = figure

# %% [markdown]
# ## An opacity that knows the surface
#
# Discretized SDF stores a signed distance s with each surfel and no opacity: that is ``sech^2(gamma s / 2)``, 1 on the
# surface and less on both sides. One gamma for all says how sharp the surface is; the loss of the median asks for at
# least the gamma at which half of the surfels are half opaque.

# %%
s = np.linspace(-1, 1, 201)
figure, axes = plt.subplots(figsize=(5.5, 2.4))
opacities = {}
for gamma, color in zip((3.0, 10.0, 30.0), (GREEN, YELLOW, RED), strict=True):
    opacities[gamma] = 1 / (1 + np.exp(-opacity_logits(s, np.array([-np.log(gamma)]))))
    axes.plot(s, opacities[gamma], color=color, label=f"gamma = {gamma:g}")
axes.set(xlabel="signed distance s", title="opacity")
axes.legend()
_ = figure

# %% [markdown]
# ## Play
#
# Tilt the surfels, and run the cell: how good must normals be before a reflection is worth its name?

# %%
tilt, count = 0.05, 2000
shaken = study.metal_of(study.sphere_of(count, tilt, np.random.default_rng(1)))
figure, axes = plt.subplots(1, 2, figsize=(6, 2.2))
for axis, (name, stage) in zip(axes, (("per surfel", PER_SURFEL), ("per pixel", PER_PIXEL)), strict=True):
    image = REFLECTIVE.render(study.model_of(shaken, stage), view_from(view.camera), request)[0].image
    show(axis, image[..., :3], f"{name}: {study.compare([view], [image])['psnr']:.1f} dB")
_ = figure

# %% [markdown]
# ## Exercises
#
# 1. A normal is off by one degree. By how much is the reflected ray?
#
# <details><summary>Solution</summary>
#
# By two: the angle between ray and normal grows by one degree on either side.
#
# ```python
# d, angle = np.array([0.0, 0.0, -1.0]), np.radians([10, 11])
# n = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
# r = d - 2 * (n @ d)[:, None] * n
# assert np.isclose(np.degrees(np.arccos(r[0] @ r[1])), 2)
# ```
#
# </details>
#
# 2. Which gamma makes a surfel at the distance 0.1 half opaque?
#
# <details><summary>Solution</summary>
#
# ``sech^2(x) = 1/2`` at ``x = ln(3 + 2 sqrt 2) / 2``, so ``gamma = 1.7627 / 0.1``.
#
# ```python
# logit = opacity_logits(np.array([0.1]), np.array([-np.log(HALF / 0.1)]))
# assert np.isclose(logit[0], 0)
# ```
#
# </details>

# %% [markdown]
# ## What was shown

# %%
assert light.maps[0].std() > 1.5 * light.maps[-1].std()  # a rough surface sees less contrast
assert rough[0.1][view.is_sphere].std() > rough[0.8][view.is_sphere].std()
assert scores["harmonics"]["psnr"] + 1 < scores["per pixel"]["psnr"] < scores["per surfel"]["psnr"] - 1
is_steep = facing < np.cos(np.radians(60))
assert np.median(leaning[is_steep]) > np.median(leaning[~is_steep]) > 1  # degrees
assert errors["with occlusion"] < 0.25 * errors["all of the environment"]
assert found["error_after"] < 0.75 * found["error_before"]
assert shaded["T = 1"].std(axis=(0, 1)).max() < 1e-12 < 0.02 < shaded["T = 4"].std(axis=(0, 1)).max()
assert all(np.isclose(o[100], 1) for o in opacities.values()) and opacities[30.0][0] < 1e-10
assert KNOTS[0] == 0 and np.isclose(1 / np.cosh(HALF / 2) ** 2, 0.5)
print("all of the above holds")
