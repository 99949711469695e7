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
# # 24 Networks and time
#
# Some things do not fit into the numbers of a Gaussian. How opaque a pane of glass is depends on where one looks from;
# where a Gaussian is depends on when. This notebook shows two answers: a small network that every Gaussian asks (VDGS),
# and a smooth warp that moves them all (Lucas-Kanade).
#
# ## A network in thirty lines
#
# A network is products with matrices and a maximum with zero in between. Its gradient goes back through the same
# products. That is all of it; no framework is needed.

# %%
import matplotlib.pyplot as plt
import numpy as np

from data_tools.claims.lucas_kanade import trainings as motion_study
from data_tools.claims.lucas_kanade.body import film, make_body
from data_tools.claims.vdgs import pane as pane_study
from figures import BLUE, GREY, RED, show, show_code
from minisplat_ref.extensions.lucas_kanade.pyramid import optical_flow
from minisplat_ref.mechanisms.networks.mlp import forward, forward_vjp, make_network, train_step, zero_moments
from minisplat_ref.mechanisms.networks.networks import IN_NUMPY

# %%
show_code(forward)
show_code(forward_vjp)

# %% [markdown]
# ## Why places are encoded first
#
# A small network of x alone is smooth, and learns a step slowly. If it is given sines and cosines of x at several
# frequencies, it can follow. Below: 300 steps of Adam for the same two layers.

# %%
rng = np.random.default_rng(0)
x = np.linspace(-1, 1, 256)
target = np.where(np.sin(7 * x) > 0, 0.8, 0.2) + 0.1 * np.sin(40 * x)
inputs = {
    "x alone": x[:, None],
    "sines of x": IN_NUMPY.fourier(np.column_stack([x, 0 * x, 0 * x]), 6),
}
fits, losses = {}, {}
for name, encoded in inputs.items():
    network = make_network((encoded.shape[1], 32, 1), np.random.default_rng(1))
    moments = zero_moments(network)
    for step in range(1, 301):
        losses[name] = train_step(network, encoded, target[:, None], 1e-2, moments, step)
    fits[name] = forward(network, encoded)[0][:, 0]
figure, axes = plt.subplots(figsize=(7, 2.4))
axes.plot(x, target, color=GREY, label="target")
for (name, fit), color in zip(fits.items(), (BLUE, RED), strict=True):
    axes.plot(x, fit, color=color, label=f"{name}: loss {losses[name]:.4f}")
axes.legend()
_ = figure

# %% [markdown]
# ## A pane of glass
#
# Glass mirrors more the flatter one looks at it: Schlick's formula. The scene is a pane in front of a coloured wall,
# photographed from many directions. Harmonics give each Gaussian a colour that depends on the direction, and one
# opacity; the network changes the opacity with the direction. Dots are learned opacities at held-out views.

# %%
records, curves = pane_study.measure(0, 300)
figure, axes = plt.subplots(1, 3, figsize=(10.5, 2.6), sharey=True)
line = np.linspace(0, 85, 100)
for axis, (name, color) in zip(axes, pane_study.COLORS.items(), strict=True):
    axis.plot(curves["angles"].ravel(), curves[name].ravel(), ".", color=color, markersize=2)
    axis.plot(line, pane_study.schlick(np.cos(np.radians(line))), color=GREY)
    axis.set(title=name, xlabel="angle from the normal (degrees)", ylim=(0, 1))
axes[0].set_ylabel("opacity")
errors = {record["arm"]: record["opacity_rmse"] for record in records}
print(", ".join(f"{name}: error {error:.3f}" for name, error in errors.items()))
_ = figure

# %% [markdown]
# ## A body that turns and grows
#
# A dome of Gaussians turns by one radian and grows by a quarter while one camera films it. Between two frames the
# brightness of a moving point stays: from this one equation per pixel, and the assumption that neighbours move alike,
# Lucas and Kanade find the flow, from coarse to fine.

# %%
body = make_body(np.random.default_rng(0))
scene = film(body, 0.0)
first, second = scene.train_views[4], scene.train_views[5]
found = optical_flow(first.image, second.image)
true, is_body = motion_study.true_flow(body, first, second)
rows, columns = np.mgrid[6 : first.image.shape[0] : 9, 6 : first.image.shape[1] : 9]
figure, axes = plt.subplots(1, 3, figsize=(10.5, 2.4))
show(axes[0], first.image, f"time {first.time:.2f}")
for axis, (name, flow) in zip(axes[1:], (("true flow", true), ("flow of two photographs", found.motion)), strict=True):
    show(axis, 0.6 + 0.4 * first.image / 255, name)
    is_shown = is_body[rows, columns] & found.is_known[rows, columns]
    u, v = flow[rows, columns][is_shown].T
    axis.quiver(
        columns[is_shown], rows[is_shown], u, v, color=RED, angles="xy", scale_units="xy", scale=0.35, width=0.004
    )
flow_error = np.linalg.norm(found.motion - true, axis=2)[is_body & found.is_known].mean()
print(
    f"the flow of the photographs is off by {flow_error:.2f} pixels, the motion is {np.abs(true[is_body]).mean():.1f}"
)
_ = figure

# %% [markdown]
# ## A warp, and what the flow adds
#
# One smooth field moves all centres. Photographs alone do not say which Gaussian went where: any that has the right
# colour will do. The velocity of the warp, projected, is a flow; a loss holds it to that of the photographs.

# %%
arms = {}
for name, loss in (("photographs alone", motion_study.LOSSES[0]), ("and their flow", motion_study.LOSSES[1])):
    model = motion_study.trained(scene, body, loss, 400, 0)
    arms[name] = model, motion_study.path_errors(model, body, 0.0)[0]
figure, axes = plt.subplots(figsize=(5.5, 2.4))
for (name, (_, path)), color in zip(arms.items(), (BLUE, RED), strict=True):
    axes.plot(motion_study.TIMES, path, "o-", color=color, label=name)
axes.set(xlabel="time", title="how far centres are from their paths (pixels)", ylim=(0, None))
axes.legend()
_ = figure

# %% [markdown]
# What the loss cannot see is the motion along the rays: a still camera shows a body that grows as it shows one that
# comes nearer. [The page of Lucas-Kanade](../docs/family/lucas-kanade.md) has the figures; in space, the paths are no
# better.
#
# ## Play
#
# How far apart may two frames be, before the flow is lost?

# %%
apart = 3
later = scene.train_views[4 + apart]
lost = optical_flow(first.image, later.image)
truth, seen = motion_study.true_flow(body, first, later)
print(f"{np.linalg.norm(lost.motion - truth, axis=2)[seen & lost.is_known].mean():.2f} pixels, {apart} frames apart")

# %% [markdown]
# ## Exercises
#
# 1. Where is Schlick's opacity half way between its value straight on, 0.04, and 1?
#
# <details><summary>Solution</summary>
#
# ``(1 - cos t)^5 = 1/2``, so ``cos t = 1 - 2^(-1/5)``: 82.6 degrees.
#
# ```python
# cosine = 1 - 0.5**0.2
# assert np.isclose(pane_study.schlick(np.array([cosine]))[0], 0.5 * (1 + pane_study.F0))
# ```
#
# </details>
#
# 2. An edge moves along itself. What does Lucas-Kanade find in a window that shows nothing but the edge?
#
# <details><summary>Solution</summary>
#
# Only the motion across the edge: the matrix of gradients has rank one (the aperture problem). That is why the flow is
# known only where its smaller eigenvalue is large enough.
#
# ```python
# edge = np.repeat((np.arange(64) > 31).astype(float)[None, :, None], 64, axis=0).repeat(3, axis=2)
# assert not optical_flow(edge, edge).is_known[32, 32]
# ```
#
# </details>

# %% [markdown]
# ## What was shown

# %%
assert losses["sines of x"] < 0.3 * losses["x alone"]
v_network, _ = forward_vjp(network, forward(network, encoded)[1], np.ones((len(x), 1)))
assert np.isclose(v_network[-1].biases[0], len(x))  # the derivative of a sum with respect to the last bias
harmonics, best = errors[next(iter(errors))], min(errors.values())
assert best < 0.8 * harmonics  # one opacity for all directions is further from Schlick's
assert flow_error < 0.5
assert arms["and their flow"][1].mean() < arms["photographs alone"][1].mean()
print("all of the above holds")
