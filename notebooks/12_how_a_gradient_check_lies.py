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
# # 12 How a gradient check lies
#
# A gradient is checked by moving a parameter and looking at what the image does. That sounds too simple to go wrong,
# and it goes wrong in both directions: right gradients look wrong, and wrong ones pass. This notebook shows five ways,
# with errors that were found in real renderers, and what `minisplat-ref oracle gradients` does about each.
#
# The first picture shows the reason for most of them: **the image jumps**. A hit whose alpha is below 1/255 is skipped.
# So when a Gaussian moves, pixels at its rim switch on and off, and each of them changes by up to 1/255 **at once**.
# Below are 12 Gaussians; one of them moves to the right, and the loss is a fixed random weighting of the image.

# %%
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap

from figures import BLUE, GREEN, GREY, RED, YELLOW, show_code
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.oracle.differences import (
    CENTRAL,
    SIXTH_ORDER,
    STEPS,
    Point,
    ThresholdCrossed,
    careful_derivative,
    derivative,
    inner,
)
from minisplat_ref.oracle.gradients import inner_product_case, jacobian_case
from minisplat_ref.oracle.pieces import tiny_setting
from minisplat_ref.oracle.planted import PLANTED, plant
from minisplat_ref.oracle.setting import Setting, make_setting
from minisplat_ref.oracle.stages import composite_stage, project_stage, render_stage, sh_stage
from minisplat_ref.oracle.tolerances import GRADIENT_REL, GRADIENT_REL_NEAR_THRESHOLD
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Gaussians

# %%
rng = np.random.default_rng(4)
setting = make_setting(rng, 12, 28, 20, GSPLAT_MAIN, sh_degree=0)
smaller = setting.gaussians._replace(log_scales=setting.gaussians.log_scales - 0.8)
setting = setting._replace(gaussians=smaller)
stage = render_stage(REFERENCE, setting)
inputs, names = list(stage.inputs.values()), list(stage.inputs)
image, alpha = stage.function(*inputs).outputs
weights = [rng.normal(size=image.shape), rng.normal(size=alpha.shape)]
MOVED = 4  # the Gaussian that moves
to_the_right = np.zeros_like(inputs[0])
to_the_right[MOVED, 0] = 1


def moved(x):
    """Scene with one Gaussian moved by x world units."""
    return [inputs[0] + x * to_the_right, *inputs[1:]]


def loss_and_hits(x):
    point = stage.function(*moved(x))
    return inner(weights, point.outputs), int(point.sides[2].sum())


def is_same(a, b):
    return all(np.array_equal(p, q) for p, q in zip(a.sides, b.sides, strict=True))


# Find a threshold to the right by halving the interval that it is in.
low, high = 0.0, 2e-3
while is_same(stage.function(*moved(0.0)), stage.function(*moved(high))):
    high *= 2
for _ in range(45):
    middle = (low + high) / 2
    is_before = is_same(stage.function(*moved(0.0)), stage.function(*moved(middle)))
    low, high = (middle, high) if is_before else (low, middle)
jump_at = high

wide, narrow = np.linspace(0, 0.05, 160), jump_at + np.linspace(-4e-5, 4e-5, 61)
wide_losses, wide_hits = np.array([loss_and_hits(x) for x in wide]).T
narrow_losses, _ = np.array([loss_and_hits(x) for x in narrow]).T
jump = loss_and_hits(high)[0] - loss_and_hits(low)[0]

figure, axes = plt.subplots(1, 3, figsize=(11, 3), width_ratios=(1, 1.3, 1.3))
axes[0].imshow(np.clip(image[:, :, :3], 0, 1), interpolation="nearest")
axes[0].set(title="the scene", xticks=[], yticks=[])
axes[1].plot(wide, wide_losses, color=BLUE)
axes[1].set(title="the loss on the way", xlabel="Gaussian moved to the right, world units", ylabel="loss")
hits_axis = axes[1].twinx()
hits_axis.step(wide, wide_hits, color=YELLOW, where="post")
hits_axis.set_ylabel("blended hits", color=YELLOW)
axes[2].plot((narrow - jump_at) * 1e6, narrow_losses - narrow_losses[0], ".", color=BLUE, markersize=4)
axes[2].axvline(0, color=RED, linewidth=1)
axes[2].set(title="a thousand times closer", xlabel="distance from a threshold, 1e-6 world units", ylabel="change")
plt.show()
print(f"{len(np.unique(wide_hits)) - 1} changes of the hit count on the way; the one on the right is {jump:.1e} high")

# %% [markdown]
# | file | what it holds |
# |---|---|
# | `minisplat_ref/oracle/differences.py` | stencils, the refusal to cross a threshold, Jacobians block by block |
# | `minisplat_ref/oracle/stages.py`, `setting.py` | every stage as a function with its gradient, and a scene for them |
# | `minisplat_ref/oracle/planted.py` | backends that are wrong in one formula, on purpose |
# | `minisplat_ref/oracle/gradients.py` | the whole proof, and what does not count as one |
#
# **Frames and units:** means are in the world frame, positions in the image in pixels. `v_x` is the derivative of the
# loss with respect to `x`. Everything here is float64 and runs on the NumPy reference.
#
# ## A step across a jump
#
# A difference quotient that spans such a jump approximates nothing. It is off by *jump / 2h*, and the smaller the step,
# the more. On the left of the next figure the Gaussian stands $3 \cdot 10^{-6}$ from the threshold: every larger step
# gives a wrong slope. A check that does not know this calls the right gradient wrong.
#
# The oracle's functions return, beside their outputs, **on which side of every threshold** each value lies: which
# Gaussians are in which list, which hits are blended or clamped, which slopes the Jacobian clamps. A stencil whose
# points disagree is refused, and a smaller step is tried.

# %% tags=["rounding"]
near = moved(jump_at - 3e-6)
near_setting = setting._replace(gaussians=setting.gaussians._replace(means=near[0]))
true_slope = float(render_stage(REFERENCE, near_setting).vjp(*weights)[0][MOVED, 0])
steps = np.logspace(-9, -2.5, 40)


def quotient(function, at, step, stencil):
    return inner(weights, derivative(function, at, 0, to_the_right, step, stencil))


def blind(*arrays):
    """The same function without its sides: nothing is refused."""
    return Point(stage.function(*arrays).outputs)


blind_errors = np.array([abs(quotient(blind, near, h, CENTRAL) / true_slope - 1) for h in steps])
refused = np.zeros(len(steps), dtype=bool)
for k, h in enumerate(steps):
    try:
        quotient(stage.function, near, h, CENTRAL)
    except ThresholdCrossed:
        refused[k] = True
careful, used = careful_derivative(stage.function, near, 0, to_the_right)
careful_error = abs(inner(weights, careful) / true_slope - 1)

figure, axes = plt.subplots(1, 2, figsize=(11, 3.4))
axes[0].loglog(steps[~refused], blind_errors[~refused], ".", color=GREEN, label="one side")
axes[0].loglog(steps[refused], blind_errors[refused], "x", color=RED, label="refused: a hit switches on")
axes[0].loglog(
    steps[refused], abs(jump / true_slope) / (2 * steps[refused]), color=GREY, linewidth=1, label="jump / 2h"
)
axes[0].plot(used, careful_error, "*", color=BLUE, markersize=12, label="what the oracle does")
axes[0].set(title="near a threshold", xlabel="step h", ylabel="relative error of the quotient")
axes[0].legend()

# Projection has no jumps here: the other two errors, alone.
smooth = project_stage(REFERENCE, setting)


def projected(*arrays):
    return Point(smooth.function(*arrays).outputs)


smooth_inputs = list(smooth.inputs.values())
cotangents = [rng.normal(size=y.shape) for y in smooth.function(*smooth_inputs).outputs]
smooth_slope = float(smooth.vjp(*cotangents)[0][MOVED, 0])
smooth_steps = np.logspace(-13, -0.8, 62)
curves = {}
for label, stencil in (("two points", CENTRAL), ("six points", SIXTH_ORDER)):
    quotients = (derivative(projected, smooth_inputs, 0, to_the_right, h, stencil) for h in smooth_steps)
    curves[label] = np.abs(np.array([inner(cotangents, q) for q in quotients]) / smooth_slope - 1) + 1e-17
for (label, errors), color in zip(curves.items(), (RED, BLUE), strict=True):
    axes[1].loglog(smooth_steps, errors, color=color, label=label)
axes[1].axhline(GRADIENT_REL, color=GREY, linewidth=1)
axes[1].annotate("what the oracle asks for", (2e-13, 1.8e-9), color=GREY)
axes[1].axvline(STEPS[0], color=YELLOW, linewidth=1, label="the oracle's first step")
axes[1].set(title="without thresholds", xlabel="step h", ylabel="relative error of the quotient")
axes[1].legend()
plt.show()

# %% [markdown]
# ## A step too large, a step too small
#
# On the right there is no threshold, and two errors are left. **Truncation** falls with the step, as $h^2$ for two
# points and as $h^6$ for six. **Rounding** grows as $10^{-16} / h$. Two points leave a narrow valley whose floor is
# where a tight tolerance would have to be. Six points leave a wide one, several digits deeper. A tolerance of
# $10^{-3}$, which is what a check in single precision can afford, lets every error pass that happens to be small in the
# direction of the check.

# %%
show_code(derivative)

# %% [markdown]
# ## Nothing is easy to get right
#
# The most common way to pass a check is that there is nothing to check. Here are three scenes, and for each the
# gradient of `transposed-rs`, an error that a released renderer has, compared with
# `allclose(analytic, numeric, rtol=1e-3, atol=1e-6)`.

# %%
small = tiny_setting()
tiny_gaussians = small.gaussians
scenes = {
    "opacities of 1e-4": small._replace(gaussians=tiny_gaussians._replace(opacity_logits=np.full(5, -9.0))),
    "all behind the camera": small._replace(gaussians=tiny_gaussians._replace(means=tiny_gaussians.means * [1, 1, -1])),
    "as it should be": small,
}
wrong_backend = plant("transposed-rs", REFERENCE)
vacuous = {}
figure, axes = plt.subplots(1, 3, figsize=(9, 2.6))
for axis, (name, scene) in zip(axes, scenes.items(), strict=True):
    view = render_stage(wrong_backend, scene)
    arrays = list(view.inputs.values())
    outputs = view.function(*arrays).outputs
    v = [np.ones_like(y) for y in outputs]
    index = list(view.inputs).index("quats")
    analytic, numeric = view.vjp(*v)[index], np.zeros((5, 4))
    for k in range(numeric.size):
        unit = np.zeros((5, 4))
        unit.flat[k] = 1
        numeric.flat[k] = inner(v, careful_derivative(view.function, arrays, index, unit)[0])
    case = jacobian_case(view)
    vacuous[name] = np.allclose(analytic, numeric, rtol=1e-3, atol=1e-6), case
    axis.imshow(np.clip(outputs[0][:, :, :3], 0, 1), interpolation="nearest", vmin=0, vmax=1)
    axis.set(title=f"{name}\nallclose {'passes' if vacuous[name][0] else 'fails'}", xticks=[], yticks=[])
plt.show()
for name, (_, case) in vacuous.items():
    print(f"{name:22} the oracle: {'passed' if case.passed else 'FAILED'}, {case.note[:88]}")

# %% [markdown]
# Zero equals zero. So the oracle fails a check in which a whole gradient is zero or the image is all but empty, and
# says which.
#
# ## A direction that cancels
#
# Instead of every entry one can check one random direction at a time,
# $\langle v, \mathrm{d}f(d) \rangle = \langle g, d \rangle$. Below are 400 directions for the quaternions: with the
# right gradient, and with one in which the part of a single Gaussian is off by 1 %. The two sides are compared relative
# to $\langle g, d \rangle$, as is usual, and relative to the sum of the sizes of its terms, $\sum |g_i d_i|$.

# %% tags=["rounding"]
index = names.index("quats")
gradient = stage.vjp(*weights)[index]
tainted = gradient.copy()
tainted[0] *= 1.01
step = 1e-6
relative, by_terms = {}, {}
directions = rng.uniform(-1, 1, size=(400, *gradient.shape))
columns = np.zeros(gradient.shape)
for k in range(gradient.size):  # the numeric gradient once; then every direction is a product
    unit = np.zeros(gradient.shape)
    unit.flat[k] = 1
    columns.flat[k] = inner(weights, careful_derivative(stage.function, inputs, index, unit, STEPS[2:])[0])
for label, g in (("right", gradient), ("one of 12 Gaussians 1 % off", tainted)):
    differences = np.abs(np.tensordot(directions, g - columns, 2))
    relative[label] = differences / np.abs(np.tensordot(directions, g, 2))
    by_terms[label] = differences / np.tensordot(np.abs(directions), np.abs(g), 2)

figure, axes = plt.subplots(1, 2, figsize=(11, 3.1), sharey=True)
titles = "relative to <g, d>", "relative to its terms"
for axis, results, title in zip(axes, (relative, by_terms), titles, strict=True):
    for (label, values), color in zip(results.items(), (GREEN, RED), strict=True):
        axis.hist(np.log10(values + 1e-16), bins=np.linspace(-15, 0, 61), color=color, alpha=0.75, label=label)
    axis.axvline(-3, color=GREY, linewidth=1, label="rtol = 1e-3")
    axis.axvline(np.log10(GRADIENT_REL), color=BLUE, linewidth=1, label="the oracle's tolerance")
    axis.set(title=title, xlabel="log10 of the discrepancy", ylabel="directions")
axes[0].set_ylim(0, 1.45 * axes[0].get_ylim()[1])
axes[0].legend(ncols=2, loc="upper right", frameon=True, framealpha=1, edgecolor="none")
plt.show()
passes_lazily = np.mean(relative["one of 12 Gaussians 1 % off"] < 1e-3)
print(f"the wrong gradient passes at rtol = 1e-3 in {100 * passes_lazily:.0f} % of the directions")
gap = by_terms["one of 12 Gaussians 1 % off"].min() / by_terms["right"].max()
print(f"relative to the terms, right and wrong are apart by a factor of at least {gap:.0f}")

# %% [markdown]
# A tolerance of $10^{-3}$ does not notice one Gaussian in 12. Relative to $\langle g, d \rangle$ the right gradient,
# too, has a tail of large errors, where the direction happens to cancel; relative to its terms it has none. With a
# tight tolerance and the right scale, right and wrong are far apart.
#
# ## A scene that is too nice
#
# The last lie is the scene. Below is every planted error of a gradient against three checks:
#
# * **lazy**: one random direction for each trained parameter, two points, 1 % tolerance, the sum of the image as the
#   loss; round Gaussians with unit quaternions, an untilted camera, a black background, SH degree 0, no alpha near its
#   clamp. Each of these choices is natural, and each hides something.
# * **inner products** of the whole render, and the **full Jacobian** of the stage that was changed, both as in
#   `oracle gradients`, on a scene in which every branch is taken.

# %%
n = 4
lazy_rng = np.random.default_rng(0)
nice = Setting(
    Gaussians(
        means=np.column_stack([lazy_rng.uniform(-0.3, 0.3, size=(n, 2)), np.linspace(2.5, 3.5, n)]),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        log_scales=np.full((n, 3), np.log(0.8)),
        opacity_logits=lazy_rng.uniform(-1, 0, size=n),
        sh_dc=lazy_rng.uniform(0, 1, size=(n, 3)),
        sh_rest=np.zeros((n, 0, 3)),
    ),
    Camera(np.eye(3), np.zeros(3), 30.0, 30.0, 12.0, 9.0, 24, 18),
    np.zeros(3),
    GSPLAT_MAIN,
)


def lazy_error(backend):
    """Largest relative discrepancy of a check that looks respectable."""
    view = render_stage(backend, nice)
    arrays = list(view.inputs.values())
    outputs = view.function(*arrays).outputs
    v = [np.ones_like(outputs[0]) * [1, 1, 1, 0], np.zeros_like(outputs[1])]  # the sum of the colours

    def blindly(*arrays):
        return Point(view.function(*arrays).outputs)

    rng, worst = np.random.default_rng(1), 0.0
    for index, g in enumerate(view.vjp(*v)[:5]):  # means, quats, log_scales, opacity_logits, sh_dc
        d = rng.normal(size=g.shape)
        expected = inner(v, derivative(blindly, arrays, index, d, 1e-4, CENTRAL))
        if not np.isclose(np.vdot(g, d), expected, rtol=1e-2, atol=1e-4):
            worst = max(worst, abs(np.vdot(g, d) - expected) / max(abs(expected), 1e-4))
    return worst


gradient_errors = [error for error in PLANTED if not error.is_forward]
forward_errors = [error for error in PLANTED if error.is_forward]
CHECKS = ("lazy", "inner products", "full Jacobian")
STAGES = {"project": project_stage, "sh_colors": sh_stage, "composite": composite_stage}
branches = tiny_setting(sh_degree=2)


def is_found(backend):
    """Whether each of the three checks finds something."""
    own = [n for n in STAGES if any(getattr(backend, f) is not getattr(REFERENCE, f) for f in (n, f"{n}_vjp"))]
    jacobians = [jacobian_case(STAGES[n](backend, branches)) for n in own or STAGES]  # of the stages that were changed
    products = inner_product_case(render_stage(backend, branches), np.random.default_rng(2))
    return lazy_error(backend) > 0, not products.passed, not all(case.passed for case in jacobians)


found = {"no error": is_found(REFERENCE)}
for error in (*gradient_errors, *forward_errors):
    found[error.name] = is_found(plant(error.name, REFERENCE))

table = np.array(list(found.values()), dtype=int)
figure, axis = plt.subplots(figsize=(6.5, 5))
axis.imshow(table, cmap=ListedColormap(["#e8e4df", GREEN]), aspect="auto", vmin=0, vmax=1)
axis.set_xticks(range(3), CHECKS)
axis.set_yticks(range(len(found)), found)
axis.xaxis.tick_top()
for y, row in enumerate(table):
    for x, is_seen in enumerate(row):
        word, color = ("found", "white") if is_seen else ("passes", GREY)
        axis.text(x, y, word, ha="center", va="center", color=color)
for y in (0.5, 0.5 + len(gradient_errors)):
    axis.axhline(y, color="black", linewidth=1)
axis.set_ylabel("errors of forward formulas      errors of gradients")
plt.show()

# %% [markdown]
# All of them pass the lazy check. Round Gaussians have no orientation, so nothing about quaternions can be wrong;
# nobody notices a forgotten background that is black; without a depth channel no gradient comes through the depths.
#
# Below the second line are errors of **forward** formulas, planted together with their own derivatives: such a gradient
# is right for what is computed. No gradient check can ever find them, however good it is. (Where the clamp of 0.999 is
# found, a stencil crossed a stop that the profile does not have there.) A comparison with another derivation finds
# them, which is what `oracle compare` and notebook 13 are about.
#
# ## And how is the checker checked?
#
# With errors that nobody chose. `tests/oracle/test_oracle_planted.py` walks the syntax trees of the reference's
# gradients, changes one sign, factor, transpose, condition or index order at a time, runs the copy, and demands that
# its stage fails. Each change that survives is listed with the reason why it changes nothing: the length of a
# quaternion, the transpose of a symmetric matrix, half of infinity.
#
# ## Play
#
# Choose one of the planted errors and a step. What to look for:
#
# * `error_name`: the errors whose `is_forward` is true have a right gradient; which are they?
# * `step`: at 1e-2 even the right gradient looks wrong, at 1e-12 too. Which error needs the best step to be seen?

# %%
error_name, step = "half-off-diagonal", 1e-5
print("choose from:", ", ".join(error.name for error in PLANTED))

gaps = {}
for label, backend in (("right", REFERENCE), (error_name, plant(error_name, REFERENCE))):
    mine = render_stage(backend, branches)

    def unguarded(*arrays, function=mine.function):
        return Point(function(*arrays).outputs)

    arrays, my_rng = list(mine.inputs.values()), np.random.default_rng(3)
    v = [my_rng.normal(size=y.shape) for y in mine.function(*arrays).outputs]
    for k, (name, g) in enumerate(zip(mine.inputs, mine.vjp(*v), strict=True)):
        d = my_rng.uniform(-1, 1, g.shape)
        slope = inner(v, derivative(unguarded, arrays, k, d, step, CENTRAL))
        gaps[label, name] = abs(slope - np.vdot(g, d)) / max(np.abs(g * d).sum(), 1e-30) + 1e-16

figure, axis = plt.subplots(figsize=(8, 2.8))
for offset, (label, color) in zip((-0.2, 0.2), (("right", BLUE), (error_name, RED)), strict=True):
    heights = [gaps[label, name] for name in mine.inputs]
    axis.bar(np.arange(len(mine.inputs)) + offset, heights, 0.38, color=color)
axis.set(
    yscale="log", ylim=(1e-14, 1), ylabel="relative to the terms", title=f"two points, step {step:g}; red: {error_name}"
)
axis.set_xticks(range(len(mine.inputs)), mine.inputs, rotation=20)
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** With which step $h$ are two points best, if the function has a third derivative $f'''$ and is known to a
# relative error $\epsilon$? What remains as the error in float64 and in float32?
#
# <details>
# <summary>Solution</summary>
#
# The error is about $h^2 |f'''| / 6 + \epsilon |f| / h$. It is smallest at $h \approx \epsilon^{1/3}$ and is then about
# $\epsilon^{2/3}$: $10^{-11}$ in float64, and $10^{-5}$ at best in float32. The figure above has its two-point valley
# there.
#
# ```python
# steps_1d = np.logspace(-12, -1, 200)
# slopes = (np.exp(1 + steps_1d) - np.exp(1 - steps_1d)) / (2 * steps_1d)
# best = steps_1d[np.argmin(np.abs(slopes - np.e))]
# assert 1e-7 < best < 1e-3  # the cube root of 1e-16 is 5e-6
# ```
#
# </details>
#
# **2.** A cosine between the right and a wrong gradient is 0.999. Is the wrong one good enough? Construct one of cosine
# 0.999 that has the wrong sign for one parameter of twenty.
#
# <details>
# <summary>Solution</summary>
#
# Let the entries be of very different sizes, as they are for means, scales and colours: the small ones hardly enter the
# cosine. With entries of size 1 and a single one of size 0.02, its sign changes the cosine by less than $10^{-4}$, and
# this parameter moves away from its optimum forever. Compare parameter by parameter.
#
# ```python
# right_one = np.append(np.ones(19), 0.02)
# wrong_one = np.append(np.ones(19), -0.02)
# assert right_one @ wrong_one / np.linalg.norm(right_one) / np.linalg.norm(wrong_one) > 0.999
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# Thresholds: the quotient across one is wrong by jump / 2h and is refused, and a smaller step is right.
assert abs(jump) > 1e-5 and len(np.unique(wide_hits)) > 3
far_off = refused & (steps < 1e-4)
assert np.allclose(blind_errors[far_off] * 2 * steps[far_off], abs(jump / true_slope), rtol=0.05)
assert blind_errors[refused].min() > 1e-4 and used < 3e-6 and careful_error < GRADIENT_REL_NEAR_THRESHOLD
assert refused[steps > 4e-6].all() and not refused[steps < 2e-6].any()

# Steps: two points reach about 1e-10, six about 1e-12 and over a wide range.
assert 1e-13 < curves["two points"].min() < 1e-9 and curves["six points"].min() < curves["two points"].min()
wide_valley = np.ptp(np.log10(smooth_steps[curves["six points"] < GRADIENT_REL]))
assert wide_valley > np.ptp(np.log10(smooth_steps[curves["two points"] < GRADIENT_REL])) + 1
assert (curves["six points"][smooth_steps < 1e-11] > 1e-7).all() and curves["two points"][-1] > 1e-5

# Nothing: a wrong gradient passes where there is nothing to see, but not with the oracle.
assert [passes for passes, _ in vacuous.values()] == [True, True, False]
assert not any(case.passed for _, case in vacuous.values())
assert "nothing was checked" in vacuous["opacities of 1e-4"][1].note

# Cancelling: no tolerance separates right from wrong without the right scale; with it the gap is wide.
assert passes_lazily > 0.5
assert by_terms["right"].max() < GRADIENT_REL < by_terms["one of 12 Gaussians 1 % off"].min()
assert by_terms["right"].max() * 10 < relative["right"].max()

# Planted: the lazy check finds none, inner products and full Jacobians find each error of a gradient.
assert found["no error"] == (False, False, False)
for error in gradient_errors:
    assert found[error.name] == (False, True, True), error.name
for error in forward_errors:
    assert error.name == "clamp-0.999" or found[error.name] == (False, False, False), error.name
print("all of the above holds")
