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
# twice: as matrices in NumPy, to be read, and as scalars for fast loops, to be used. Each form is tested against the
# other. This notebook is the guide: a first result, the stages in pictures, the folders, the reading order, and the
# choices in which renderers differ.
#
# First the result. A ray tracer renders fourteen tiny photographs of a room and samples points on its surfaces. Each
# point becomes a Gaussian, sixty gradient steps fit them to the photographs, and a view that the training never saw is
# rendered. All of that is the next cell, in ten lines.

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
from figures import BLUE, GREEN, GREY, covariances2d, ellipse_axes, show, show_pixels
from minisplat_ref.constants import GSPLAT_MAIN, PROFILES
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import get_recipe
from minisplat_ref.metrics import psnr
from minisplat_ref.reference.tiling import bin_gaussians
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.types import TileGrid

# %%
scene = make_scene("room", n_views=14, width=64, height=48, n_points=1500, supersampling=3).scene
recipe = get_recipe("3dgs", iterations=60)
rates = recipe.learning_rates.change(log_scales=0.03, opacity_logits=0.3, sh_dc=0.02)
recipe = recipe._replace(learning_rates=rates, events=(), sh_milestones=())
view = scene.test_views[1]
state, losses = initial_state(scene, recipe, seed=0), []
start, _ = render(state.gaussians, view.camera, backend=REFERENCE)
train(scene, recipe, seed=0, state=state, backend=REFERENCE, on_step=lambda report: losses.append(report.loss))
output, tape = render(state.gaussians, view.camera, backend=REFERENCE)

# %%
photograph = view.image / 255
quality = {name: psnr(np.clip(o.image, 0, 1), photograph) for name, o in (("start", start), ("end", output))}
figure, panels = plt.subplots(1, 4, figsize=(11, 2.4), width_ratios=(1, 1, 1, 1.1))
for axes, picture, title in (
    (panels[0], photograph, "photograph, held out"),
    (panels[1], start.image, f"before: {quality['start']:.1f} dB"),
    (panels[2], output.image, f"after {recipe.iterations} steps: {quality['end']:.1f} dB"),
):
    show(axes, picture, title)
panels[3].plot(range(1, len(losses) + 1), losses, color=BLUE)
panels[3].set(xlabel="step", title="training loss", ylim=(0, None))
plt.show()

# %% [markdown]
# PSNR is $10 \log_{10}(1 / \text{mean squared error})$ in dB; higher is better. This ran on the NumPy reference, which
# needs no compilation. `backend=CPU`, the default, is the fast one; it compiles its kernels during the first call,
# which takes about half a minute, once. The learning rates are raised because sixty steps are few, and the density
# control of 3DGS (`events`) is left out. `minisplat-ref demo` does the same properly on the fast backend, with density
# control and a report.
#
# Every notebook shows its pictures before its formulas, and ends with a cell to play with, two exercises with hidden
# solutions, and assertions of what it has shown.
#
# ## The stages in pictures
#
# Below is what `render` did with that view, stage by stage. Image coordinates are in pixels, x right and y down; the
# centre of the top-left pixel is (0.5, 0.5). Depth is the camera's z, here in metres.

# %%
projection, camera = tape.projection, view.camera
visible = np.flatnonzero(projection.radii[:, 0])
visible = visible[np.argsort(-projection.depths[visible])]  # far ones first
grid = TileGrid(camera.width, camera.height, 16, 16)
n_pairs = np.diff(bin_gaussians(projection, grid, GSPLAT_MAIN).tile_offsets).reshape(grid.n_tiles_y, grid.n_tiles_x)
colors = np.clip(REFERENCE.sh_colors(*state.gaussians[:1], *state.gaussians[4:], camera, 0, projection.radii), 0, 1)

figure, panels = plt.subplots(2, 2, figsize=(9.5, 6.4))
points, ellipses, tiles, image = panels.ravel()
steps_of_depth = plt.get_cmap("viridis_r", 8)
drawn = points.scatter(*projection.means2d[visible].T, c=projection.depths[visible], s=5, cmap=steps_of_depth)
figure.colorbar(drawn, ax=points, label="depth [m]")
points.set_title("1. project: means fall on pixels")
sigmas, angles = ellipse_axes(covariances2d(projection))
for n in visible:
    shape = Ellipse(projection.means2d[n], *(2 * sigmas[n]), angle=angles[n], facecolor=colors[n])
    shape.set(edgecolor="black", linewidth=0.2, alpha=float(projection.opacities[n]))
    ellipses.add_patch(shape)
ellipses.set_title("2. project, colour: ellipses at one standard deviation")
drawn = tiles.imshow(n_pairs, extent=(0, 16 * grid.n_tiles_x, 16 * grid.n_tiles_y, 0), cmap=plt.get_cmap("inferno", 8))
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
# Beside each function `f` is `f_vjp`, which takes the derivative of the loss with respect to the result of `f` and
# returns the derivative with respect to its arguments; `v_x` is the derivative of the loss with respect to `x`.
# `render` and `render_vjp` chain them.
#
# ## The map of the package
#
# A module may import only from rows below its own; a check enforces the list that is drawn here. Start with the green
# box. The blue boxes hold the fast form of the same formulas and never import the green one: two derivations that agree
# are worth more than one that agrees with itself.

# %%
pyproject = next(p / "pyproject.toml" for p in (Path.cwd(), *Path.cwd().parents) if (p / "pyproject.toml").exists())
contracts = tomllib.loads(pyproject.read_text())["tool"]["importlinter"]["contracts"]
rows = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
exists = {module.name for module in pkgutil.iter_modules(minisplat_ref.__path__)} | {"__main__"}
layers = [[name.strip(" ()") for name in re.split("[|:]", row)] for row in rows]
layers = [[name for name in layer if name in exists] for layer in layers]
layers = [layer for layer in layers if layer and layer != ["__main__"]]
notes = {
    "app": "commands, runs and their folders, comparison, viewer, reports",
    "bench": "speed beside error",
    "testing": "the oracle for other tests",
    "extensions": "relatives of 3DGS; no layer below imports them",
    "mechanisms": "what several relatives are made of",
    "oracle": "correctness only",
    "datasets": "scenes to train on",
    "methods": "one per paper: its events and their dates",
    "training": "the loop, and what an iteration changes",
    "strategy": "edits of a population",
    "metrics": "metrics",
    "io": "files",
    "gsplat": "gsplat's call",
    "rendering": "from parameters to an image and back",
    "cuda": "the same loops on a GPU",
    "cpu": "loops over all Gaussians, all pixels",
    "reference": "the formulas as matrices",
    "scalar": "the same for one Gaussian or pixel",
    "jit": "compiling, lanes",
    "validation": "checks of input",
    "types": "arrays",
    "constants": "conventions",
    "errors": "bad input",
    "interface": "options, bars, tables",
    "memory": "estimates",
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
    axes.text(8.15, level + 0.5, "; ".join(notes[name] for name in layer), va="center", color="#5d5853", fontsize=8)
axes.annotate("", (-0.25, 0.2), (-0.25, len(layers) - 0.2), arrowprops={"arrowstyle": "->", "color": GREY})
axes.text(-0.45, len(layers) / 2, "imports", rotation=90, va="center", ha="center", color=GREY)
axes.set(xlim=(-0.7, 12.3), ylim=(0, len(layers)))
axes.axis("off")
plt.show()

# %% [markdown]
# Here is the same as a table; the words are the first line of each module's docstring.


# %%
def first_line(name):
    """First line of a module's docstring, with its markup made Markdown's."""
    path = Path(minisplat_ref.__path__[0], name)
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
    line = ast.get_docstring(ast.parse(source)).splitlines()[0]
    return re.sub(r":\w+:`~?([^`]*)`|``([^`]*)``", lambda match: f"`{match[1] or match[2]}`", line)


modules = [name for layer in layers for name in layer]
table = [f"| `{name}` | {first_line(name)} |" for name in modules]
display(Markdown("\n".join(["| module | its docstring |", "|---|---|", *table])))

# %% [markdown]
# ## Reading order
#
# This is the table of `docs/ARCHITECTURE.md`, with paths below `minisplat_ref/`. Everything in its first two parts is
# NumPy and can be read without Numba.

# %%
page = (pyproject.parent / "docs" / "ARCHITECTURE.md").read_text()
order = page.partition("<!-- reading order: begin -->")[2].partition("<!-- reading order: end -->")[0].strip()
display(Markdown(order))

# %% [markdown]
# Names are those of the field: `means`, `quats` (wxyz, any length), `log_scales` and `opacity_logits` are trained;
# `scales` and `opacities` are the results of the activations. Transforms read from right to left: `cam_from_world_R`
# turns world vectors into camera vectors.
#
# ## Conventions
#
# There is no single 3DGS rasteriser: released programs differ in small choices, and a scene that was trained with one
# set of choices looks slightly wrong with another. There are four named sets of `Conventions`. The default is
# `GSPLAT_MAIN`: it cuts off nothing visible, honours the principal point, and its gradients are derivatives of what it
# computes. Choices that differ from the default are in bold.


# %%
def bold(value, default):
    """Text of a value, bold where it is not the default's."""
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if value == default else f"**{text}**"


fields = [field for field in GSPLAT_MAIN._fields if field != "name"]
table = [["choice", *PROFILES], ["---"] * (1 + len(PROFILES))]
for field in fields:
    default = getattr(GSPLAT_MAIN, field)
    table.append([f"`{field}`", *(bold(getattr(profile, field), default) for profile in PROFILES.values())])
display(Markdown("\n".join("| " + " | ".join(row) + " |" for row in table)))

# %% [markdown]
# `constants.py` explains each of them.
#
# ## Play
#
# Is a choice visible? Below is the trained view with the conventions of another profile, and the difference from the
# default. What to look for:
#
# * `name`: try `GSPLAT_1_5` and `MINI_SPLATTING2`. Which differs in fewest pixels?
# * Where are the differences: in the middle of Gaussians, at their rims, or along the edges of tiles?

# %%
name = "INRIA"
other, _ = render(state.gaussians, camera, conventions=PROFILES[name], backend=REFERENCE)
difference = np.abs(other.image - output.image).max(axis=2)
figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 2.9))
show_pixels(left, other.image, name)
drawn = show_pixels(right, difference, f"largest difference from {GSPLAT_MAIN.name}", cmap="magma")
for axes in (left, right):
    axes.set(xticks=range(0, 65, 16), yticks=range(0, 49, 16))  # the edges of tiles
figure.colorbar(drawn, ax=right)
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** Start the training of the first cell from 200 points instead of 1500, and take 15 or 30 steps. What do more
# points improve, and what more steps? Guess before you run it.
#
# <details>
# <summary>Solution</summary>
#
# Points are the places for colour; steps are how long it is fitted. Fewer points leave larger Gaussians and lose detail
# that no number of steps brings back without density control.
#
# ```python
# def trained_psnr(n_points, iterations):
#     """PSNR of the held-out view after a training from so many points."""
#     fewer = scene._replace(points=scene.points[:n_points], point_colors=scene.point_colors[:n_points])
#     shorter = recipe._replace(iterations=iterations)
#     gaussians = train(fewer, shorter, seed=0, backend=REFERENCE).gaussians
#     return psnr(np.clip(render(gaussians, view.camera, backend=REFERENCE)[0].image, 0, 1), photograph)
#
# few, few_but_long = trained_psnr(200, 15), trained_psnr(200, 30)
# print(f"200 points: {few:.1f} dB after 15 steps, {few_but_long:.1f} dB after 30")
# assert few < few_but_long < quality["end"]
# ```
#
# </details>
#
# **2.** How many numbers describe a Gaussian with colours of degree 3? How many bytes are that for a million in
# float32? Compare with the PLY of any 3DGS scene.
#
# <details>
# <summary>Solution</summary>
#
# Three for the mean, four for the quaternion, three scales, one opacity and $16 \cdot 3$ coefficients of colour: 59
# numbers, 236 bytes, 236 MB for a million. The PLY of 3DGS stores three more per Gaussian, normals that are always
# zero.
#
# ```python
# widths = [int(np.prod(field.shape[1:])) for field in state.gaussians]
# degree_0 = sum(widths) - widths[-1]
# assert degree_0 == 3 + 4 + 3 + 1 + 3 and degree_0 + 15 * 3 == 59
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# After sixty steps a view that was not trained on is several dB better.
assert len(losses) == 60 and np.mean(losses[-10:]) < 0.6 * np.mean(losses[:10])
assert quality["end"] > quality["start"] + 5

# Pairs count every visible Gaussian at least once, and every module of the package is on the map.
assert n_pairs.sum() >= len(visible) > 100
assert set(modules) == exists - {"__main__"} and {"reference", "scalar", "cpu", "types"} <= set(modules)

# The reference is below everything that uses it, and beside the scalars that it is checked against.
level = {name: i for i, layer in enumerate(layers) for name in layer}
assert level["training"] < level["rendering"] < level["cpu"] < level["reference"] == level["scalar"] < level["types"]

# Every module has a note on the map, and every notebook a place in the reading order.
assert set(modules) == set(notes)
read_with = {number for row in order.splitlines() for number in re.findall(r"\d\d", row.split("|")[3])}
assert read_with == {path.name[:2] for path in (pyproject.parent / "notebooks").glob("[0-9]*.ipynb")}

# Profiles differ, in name and in pixels, but little.
assert len(set(PROFILES.values())) == len(PROFILES) == 4
assert 0 < difference.max() < 0.5 and difference.mean() < 0.02
