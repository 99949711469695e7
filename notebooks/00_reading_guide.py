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
# # 00 Reading guide
#
# `minisplat_ref` renders and trains scenes made of 3D Gaussians (3DGS, Kerbl et al. 2023). It states every formula
# twice: once as matrices in NumPy, to be read, and once as scalars for fast loops, to be used. Each form is tested
# against the other. This notebook is the map: a first result, the stages in pictures, the folders, the reading order,
# and the choices on which renderers differ.

# %%
import ast
import pkgutil
import re
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown, display
from matplotlib.patches import Ellipse, FancyBboxPatch

import minisplat_ref
from figures import BLUE, GREEN, GREY
from minisplat_ref.backends import REFERENCE
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import psnr
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import render
from minisplat_ref.training.loop import initial_state, train
from minisplat_ref.types import TileGrid

# %% [markdown]
# ## From photographs to a rendered view in ten lines
#
# A ray tracer takes fourteen tiny photographs of a room and gives points on its surfaces. Each point becomes a
# Gaussian, sixty gradient steps fit them to the photographs, and a view that the training never saw is rendered.
#
# This runs on the NumPy reference, so nothing has to be compiled. `backend=CPU`, the default, is the fast one; it
# compiles its kernels during the first call, about half a minute, once. The learning rates are raised
# because sixty steps are few, and the density control of 3DGS (`events`) is left out.

# %%
scene = make_scene("room", n_views=14, width=64, height=48, n_points=1500, supersampling=3).scene
recipe = get_recipe("3dgs", iterations=60)
rates = recipe.learning_rates.changed(log_scales=0.03, opacity_logits=0.3, sh_dc=0.02)
recipe = recipe._replace(learning_rates=rates, events=(), sh_milestones=())
view = scene.test_views[1]
state, losses = initial_state(scene, recipe, seed=0), []
start, _ = render(state.gaussians, view.camera, backend=REFERENCE)
train(scene, recipe, seed=0, state=state, backend=REFERENCE, on_step=lambda report: losses.append(report.loss))
output, tape = render(state.gaussians, view.camera, backend=REFERENCE)

# %%
photograph = view.image / 255
quality = {name: psnr(np.clip(o.image, 0, 1), photograph) for name, o in (("start", start), ("end", output))}
figure, panels = plt.subplots(1, 4, figsize=(11, 2.5), width_ratios=(1, 1, 1, 1.1))
for axes, picture, title in (
    (panels[0], photograph, "photograph, not trained on"),
    (panels[1], start.image, f"before training: {quality['start']:.1f} dB"),
    (panels[2], output.image, f"after {recipe.iterations} steps: {quality['end']:.1f} dB"),
):
    axes.imshow(np.clip(picture, 0, 1))
    axes.set_title(title)
    axes.axis("off")
panels[3].plot(range(1, len(losses) + 1), losses, color=BLUE)
panels[3].set(xlabel="step", title="training loss (one view a step)", ylim=(0, None))
plt.show()

# %% [markdown]
# PSNR is $10 \log_{10}(1 / \text{mean squared error})$ in dB; more is better. `minisplat-ref demo` does the same in
# earnest on the fast backend, with density control and a report.
#
# ## The stages in pictures
#
# What `render` did with that view, stage by stage. Image coordinates are in pixels, x right and y down; the centre of
# the top-left pixel is (0.5, 0.5). Depth is the camera's z, in metres here.

# %%
projection, camera = tape.projection, view.camera
visible = np.flatnonzero(projection.radii[:, 0])
visible = visible[np.argsort(-projection.depths[visible])]  # far ones first
grid = TileGrid(camera.width, camera.height, 16, 16)
n_pairs = np.diff(bin_gaussians(projection, grid, GSPLAT_MAIN).tile_offsets).reshape(grid.n_tiles_y, grid.n_tiles_x)
colors = np.clip(REFERENCE.sh_colors(*state.gaussians[:1], *state.gaussians[4:], camera, 0, projection.radii), 0, 1)

figure, panels = plt.subplots(2, 2, figsize=(9.5, 6.4))
points, ellipses, tiles, image = panels.ravel()
drawn = points.scatter(*projection.means2d[visible].T, c=projection.depths[visible], s=5, cmap="viridis_r")
figure.colorbar(drawn, ax=points, label="depth [m]")
points.set_title("1. project: means fall on pixels")
for n in visible:
    a, b, c = projection.conics[n]
    variances, directions = np.linalg.eigh(np.linalg.inv([[a, b], [b, c]]))
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    shape = Ellipse(projection.means2d[n], *(2 * np.sqrt(variances)), angle=angle, facecolor=colors[n])
    shape.set(edgecolor="black", linewidth=0.2, alpha=float(projection.opacities[n]))
    ellipses.add_patch(shape)
ellipses.set_title("2. project, colour: ellipses at one standard deviation")
drawn = tiles.imshow(n_pairs, extent=(0, 16 * grid.n_tiles_x, 16 * grid.n_tiles_y, 0), cmap="inferno")
figure.colorbar(drawn, ax=tiles, label="Gaussians in the tile")
tiles.set_title("3. sort into tiles of 16 x 16 pixels")
image.imshow(np.clip(output.image, 0, 1), extent=(0, camera.width, camera.height, 0))
image.set_title("4. blend front to back")
for axes in panels.flat:
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal", xticks=range(0, 65, 16))
    axes.set(yticks=range(0, 49, 16), xlabel="x [px]", ylabel="y [px]")
plt.show()

# %% [markdown]
# | stage | function | from | to | notebook |
# |---|---|---|---|---|
# | shape | `covariances` | quaternions [N, 4], scales [N, 3] | world covariances [N, 3, 3] | 01 |
# | projection | `project` | means [N, 3], shapes, a camera | `Projection`: ellipses in pixels | 01 |
# | colour | `sh_colors` | coefficients [N, 3] and [N, 15, 3], directions | RGB [N, 3] | 02 |
# | tiling | `bin_gaussians` | `Projection` | `TileBins`: for each tile a list, near to far | 03 |
# | compositing | `composite` | the above | `RenderOutput`: image [H, W, D], alpha [H, W] | 03, 04 |
# | loss | `photometric_loss` | image, photograph [H, W, 3] | a number | 05 |
#
# Beside each function `f` stands `f_vjp`, which carries the derivative of the loss backwards: from `v_x` of what `f`
# returned to `v_x` of what it was given. `render` and `render_vjp` chain them.
#
# ## The map of the package
#
# A module may import only from rows below its own; a check enforces the very list that is drawn here. Start with the
# green box. The blue boxes hold the fast form of the same formulas, and never look into the green one: two
# derivations that agree are worth more than one that agrees with itself.

# %%
pyproject = next(p / "pyproject.toml" for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").exists())
contracts = tomllib.loads(pyproject.read_text())["tool"]["importlinter"]["contracts"]
rows = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
exists = {module.name for module in pkgutil.iter_modules(minisplat_ref.__path__)} | {"__main__"}
layers = [[name.strip(" ()") for name in re.split("[|:]", row)] for row in rows]
layers = [[name for name in layer if name in exists] for layer in layers]
layers = [layer for layer in layers if layer and layer != ["__main__"]]
notes = {
    "cli": "arguments, progress, files",
    "extensions": "further methods; never imported from below",
    "datasets": "scenes to train on; what reports share",
    "methods": "a file per paper: its events and when they happen",
    "training": "the loop",
    "strategy": "who exists, how it moves, files, measures",
    "rendering": "parameters to image and back",
    "splatting": "the stages in a row",
    "backends": "one function for every stage",
    "cpu": "loops over all Gaussians, all pixels",
    "reference": "the formulas, as matrices and as scalars",
    "validation": "checks of what comes from outside",
    "types": "arrays with shape, frame and unit; every number",
}
figure, axes = plt.subplots(figsize=(10.5, 0.48 * len(layers) + 0.3))
for level, layer in enumerate(reversed(layers)):
    width = 8.0 / len(layer)
    for position, name in enumerate(layer):
        color = {"reference": GREEN, "scalar": BLUE, "cpu": BLUE, "cuda": BLUE}.get(name, "#efebe4")
        corner = (position * width + 0.06, level + 0.12)
        box = FancyBboxPatch(corner, width - 0.12, 0.76, boxstyle="round,pad=0,rounding_size=0.1", facecolor=color)
        axes.add_patch(box)
        is_dark = name in ("reference", "scalar", "cpu", "cuda")
        axes.text(
            (position + 0.5) * width, level + 0.5, name, ha="center", va="center", color="white" if is_dark else "black"
        )
    note = next((notes[name] for name in layer if name in notes), "")
    axes.text(8.15, level + 0.5, note, va="center", color="#5d5853")
axes.annotate("", (-0.25, 0.2), (-0.25, len(layers) - 0.2), arrowprops={"arrowstyle": "->", "color": GREY})
axes.text(-0.45, len(layers) / 2, "imports", rotation=90, va="center", ha="center", color=GREY)
axes.set(xlim=(-0.7, 12.3), ylim=(0, len(layers)))
axes.axis("off")
plt.show()

# %% [markdown]
# The same as a table; the words are the first line of each module's own docstring.


# %%
def first_line(name):
    """First line of a module's docstring, with its markup made Markdown's."""
    path = Path(minisplat_ref.__path__[0], name)
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
    line = ast.get_docstring(ast.parse(source)).splitlines()[0]
    return re.sub(r":\w+:`~?([^`]*)`|``([^`]*)``", lambda match: f"`{match[1] or match[2]}`", line)


modules = [name for layer in layers for name in layer]
table = [f"| `{name}` | {first_line(name)} |" for name in modules]
display(Markdown("\n".join(["| module | what it says of itself |", "|---|---|", *table])))

# %% [markdown]
# ## Reading order
#
# | step | read | notebook | you will know |
# |---|---|---|---|
# | 1 | `types.py`, `constants.py` | this one | what is passed around, in which frames and units |
# | 2 | `reference/covariance.py`, `pinhole.py`, `projection.py`, `extent.py` | 01 | from ellipsoid to ellipse |
# | 3 | `reference/spherical_harmonics.py` | 02 | how a colour depends on the viewing direction |
# | 4 | `reference/tiling.py`, `hits.py`, `compositing.py` | 03 | how ellipses become pixels |
# | 5 | the `_vjp` functions beside them | 04 | how a pixel's error reaches every parameter |
# | 6 | `reference/loss.py`, `depth.py` | 05 | what is minimised |
# | 7 | `rendering.py`, `training/loop.py`, `methods/`, `strategy/initialization.py` | 06 | how a scene is trained |
# | 8 | `strategy/clone_split.py`, `blur_split.py` | 07 | density control and blur split: who becomes two |
# | 9 | `strategy/depth_reinit.py` | 08 | depth reinitialisation: where surfaces are, and what fools it |
# | 10 | `strategy/importance.py`, `simplify.py` | 09 | importance and simplification: who may go |
# | 11 | `strategy/aggressive_clone.py`, `visibility.py` | 10 | aggressive clone and visibility culling |
# | 12 | `methods/mini_splatting.py`, `mini_splatting2.py` | 11 | three recipes side by side |
# | 13 | `oracle/differences.py`, `gradients.py`, `planted.py` | 12 | how a gradient check lies |
# | 14 | `oracle/golden/`, `comparison/`, `thresholds.py` | 13 | comparing a backend with the oracle |
# | 15 | `scalar/`, then `cpu/` | 15 | how the same formulas run fast: eight pixels at a time |
# | 16 | `bench/` | 14 | speed against error |
#
# Names are the field's own: `means`, `quats` (wxyz, any length), `log_scales`, `opacity_logits` are what is trained;
# `scales` and `opacities` are what comes out of the activations. `v_x` is the derivative of the loss by `x`.
# Transforms read right to left: `cam_from_world_R` turns world vectors into camera vectors.
#
# ## Conventions
#
# There is no single 3DGS rasteriser: released programs differ in small choices, and a scene trained under one set
# looks slightly wrong under another. `Conventions` names four sets. The default is `GSPLAT_MAIN`: it cuts nothing
# visible, respects the principal point, and its gradients are derivatives of what it computes. Choices that differ
# from the default are in bold.


# %%
def show(value, default):
    """Text of a value, bold where it is not the default's."""
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if value == default else f"**{text}**"


fields = [field for field in GSPLAT_MAIN._fields if field != "name"]
table = [["choice", *PROFILES], ["---"] * (1 + len(PROFILES))]
for field in fields:
    default = getattr(GSPLAT_MAIN, field)
    table.append([f"`{field}`", *(show(getattr(profile, field), default) for profile in PROFILES.values())])
display(Markdown("\n".join("| " + " | ".join(row) + " |" for row in table)))

# %% [markdown]
# What each of them means is written in `constants.py`. Does a choice show? Below, the trained view under INRIA's
# conventions, and the difference on a colour scale of its own.

# %%
name = "INRIA"  # play: GSPLAT_1_5, MINI_SPLATTING2
other, _ = render(state.gaussians, camera, conventions=PROFILES[name], backend=REFERENCE)
difference = np.abs(other.image - output.image).max(axis=2)
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 2.9))
left.imshow(np.clip(other.image, 0, 1), extent=(0, 64, 48, 0))
left.set(title=name, xlabel="x [px]", ylabel="y [px]", xticks=range(0, 65, 16), yticks=range(0, 49, 16))
drawn = right.imshow(difference, extent=(0, 64, 48, 0), cmap="magma")
right.set(title=f"largest channel difference from {GSPLAT_MAIN.name}", xlabel="x [px]")
right.set(xticks=range(0, 65, 16), yticks=range(0, 49, 16))
figure.colorbar(drawn, ax=right)
plt.show()

# %% [markdown]
# ## What was shown, checked
#
# The last cell of every notebook asserts what it has shown.

# %%
# Sixty steps bring a view that was not trained on several dB closer.
assert len(losses) == 60 and np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])
assert quality["end"] > quality["start"] + 5

# Pairs count every visible Gaussian at least once, and every module of the package is on the map.
assert n_pairs.sum() >= len(visible) > 100
assert set(modules) == exists - {"__main__"} and {"reference", "scalar", "cpu", "types"} <= set(modules)

# The reference stands below everything that uses it, and beside the scalars that it is checked against.
level = {name: i for i, layer in enumerate(layers) for name in layer}
assert (
    level["training"] < level["rendering"] < level["backends"] < level["reference"] == level["scalar"] < level["types"]
)

# Profiles differ, in name and in pixels, but little.
assert len(set(PROFILES.values())) == len(PROFILES) == 4
assert 0 < difference.max() < 0.5 and difference.mean() < 0.02
