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
# # 14 Speed against error
#
# It is easy to make a renderer faster: fewer digits, a shorter exponential, ellipses that end earlier. Each of these
# changes the image. This notebook looks at the changes first and at the clock last, because a time without its error
# says nothing.
#
# Here are 20,000 Gaussians with the sizes and opacities of trained ones, rendered in six ways. The float64 reference
# gives the answer. All six receive the same numbers, which are float32 numbers even where they are stored as float64.
# The other panels show where, and by how much, five renderers differ from the reference. Mind the scale: it is
# logarithmic and spans ten powers of ten.

# %%
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

from figures import BLUE, GREEN, GREY, RED, YELLOW, show
from minisplat_ref.app.reports.bench_figure import pareto_figure
from minisplat_ref.bench.benchmark import benchmark
from minisplat_ref.bench.contenders import all_contenders
from minisplat_ref.bench.exponentials import EXPONENTIALS, relative_errors
from minisplat_ref.bench.judging import backward, expect, failure, forward, judge
from minisplat_ref.bench.judging import relative_errors as by_parameter
from minisplat_ref.bench.workloads import synth
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.oracle.planted import plant
from minisplat_ref.oracle.tolerances import BENCH_FLOAT32_GRADIENT, BENCH_FLOAT32_IMAGE, BENCH_FLOAT64
from minisplat_ref.reference.hits import tile_hits
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import TileGrid

# %% tags=["rounding"]
workload = synth(20_000, width=256, height=144, focal=213.0)
expected = expect(workload, REFERENCE)
contenders = all_contenders()
NAMES = ("cpu-f64", "cpu-f32", "cpu-f32-exp3", "cpu-f32-3-sigma", "cpu-f32-cut-1/64")
images = {name: forward(contenders[name], workload)[0] for name in NAMES}
errors = {name: np.abs(image - expected.image).max(axis=2) for name, image in images.items()}

figure, axes = plt.subplots(2, 3, figsize=(10, 4.1))
show(axes[0, 0], expected.image, "the reference, float64")
digits = {"cmap": plt.get_cmap("magma", 9), "vmin": -10, "vmax": -1}  # a colour for each power of ten
for panel, (name, error) in zip(axes.flat[1:], errors.items(), strict=True):
    shown = show(panel, np.log10(np.maximum(error, 1e-17)), f"{name}: at most {error.max():.1e}", **digits)
figure.colorbar(shown, ax=axes, label="log10 of the error", shrink=0.8)
plt.show()

# %% [markdown]
# The float64 kernels agree with the reference to the last digits (black). float32 is off by $10^{-7}$ to $10^{-6}$
# wherever there is a Gaussian, with a few bright dots. A cubic exponential raises this level everywhere. Cutting a
# Gaussian off at three standard deviations, as the tiles of the 3DGS rasteriser do, leaves most pixels as they are and
# is grossly wrong along the edges of tiles, where opaque Gaussians are cut off. Skipping every hit below 1/64 is wrong
# everywhere.
#
# | file | what it holds |
# |---|---|
# | `minisplat_ref/bench/workloads.py` | what is rendered |
# | `minisplat_ref/bench/contenders.py` | what renders it |
# | `minisplat_ref/oracle/thresholds.py` | which pixels are at a threshold |
# | `minisplat_ref/bench/judging.py`, `benchmark.py` | errors, then times |
#
# **Frames and units:** images are [H, W, 3] with values in [0, 1]; an error of an image is an absolute difference, an
# error of a gradient is relative. Times are those of the machine that ran the notebook; the command
# `minisplat-ref bench` measures the full-size workloads.
#
# ## The bright dots
#
# How can a pixel be off by a thousand times the rounding error? Take the worst one. These are its hits in both
# precisions, and the threshold below which a hit is skipped.

# %% tags=["rounding"]
y, x = np.unravel_index(errors["cpu-f32"].argmax(), errors["cpu-f32"].shape)


def alphas_at(dtype):
    """Gaussians and unclamped alphas of one pixel, whether they count or not."""
    contender = contenders["cpu-f64" if dtype is np.float64 else "cpu-exact-f32"]
    _, tape = forward(contender, workload)
    projection = tape.projection
    near = GSPLAT_MAIN._replace(alpha_min=0.9 / 255)  # lists that also hold what is just below
    grid = TileGrid(workload.camera.width, workload.camera.height, CPU.tile_width, CPU.tile_height)
    for tile in tile_hits(projection, CPU.bin_gaussians(projection, grid, near), near):
        pixel = np.flatnonzero((tile.ys == y) & (tile.xs == x))
        if len(pixel):
            return tile.ids, tile.hit.unclamped[:, pixel[0]]
    raise AssertionError("every pixel is in a tile")


ids, exact = alphas_at(np.float64)
ids32, single = alphas_at(np.float32)
both = np.intersect1d(ids, ids32)
exact = np.array([exact[ids == n][0] for n in both])
single = np.array([single[ids32 == n][0] for n in both], dtype=np.float64)
closest = np.abs(exact * 255 - 1).argmin()

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 2.9), width_ratios=[1.6, 1])
left.semilogy(np.sort(exact)[::-1], "o", color=BLUE, markersize=4, label="the pixel's alphas, float64")
left.axhline(1 / 255, color=RED, linewidth=1, label="1/255: below, a hit is skipped")
left.set(title=f"pixel ({x}, {y}): hits by strength", xlabel="hit", ylabel="alpha", ylim=(1e-5, 1.5), xlim=(-1, 45))
left.legend(frameon=False, loc="upper right")
offsets = np.array([exact[closest], single[closest]]) * 255 - 1
right.bar(["float64", "float32"], offsets, color=[BLUE, YELLOW])
right.axhline(0, color=RED, linewidth=1)
right.set(title=f"Gaussian {both[closest]}: 255 alpha - 1", ylabel="above or below the threshold")
plt.show()
print(f"error of the pixel: {errors['cpu-f32'][y, x]:.1e}; a hit at the threshold weighs at most {1 / 255:.1e}")

# %% [markdown]
# One hit is so near the threshold that the last digits decide on which side it falls. In float64 it is on one side, in
# float32 on the other, and a whole hit appears or disappears. This is a *flip*. It is not an error of arithmetic: any
# two renderers that round differently have some flips, and no polynomial, however long, removes them.
#
# So flips are counted separately. float64 tells in advance where they may happen: where some alpha is within $10^{-6}$
# of the threshold, where the transmittance comes as near to the stop, where two neighbours in depth are as close as the
# digits of float32. It also tells how much each of them can change. What exceeds that is an error.

# %% tags=["rounding"]
at = expected.thresholds
verdict = judge(contenders["cpu-f32"], workload, expected)
flipped = (errors["cpu-f32"] > BENCH_FLOAT32_IMAGE) & (at.allowance > 0)

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.1))
left.imshow(np.where(at.is_near, 1.0, 0.0), cmap="Greys", vmax=2, interpolation="nearest")
left.plot(*np.nonzero(flipped)[::-1], "o", color=RED, fillstyle="none", markersize=10)
left.set(title=f"at a threshold: {at.is_near.mean():.2%} of the pixels; flipped: {flipped.sum()}", xticks=[], yticks=[])
is_off = errors["cpu-f32"] > 0
right.loglog(
    errors["cpu-f32"][is_off & ~at.is_near],
    at.allowance[is_off & ~at.is_near] + 1e-9,
    ".",
    color=BLUE,
    markersize=2,
    label="no threshold near (drawn at 1e-9)",
)
right.loglog(
    errors["cpu-f32"][at.is_near], at.allowance[at.is_near] + 1e-9, "o", color=RED, markersize=3, label="at a threshold"
)
right.axvline(BENCH_FLOAT32_IMAGE, color=GREY, linewidth=0.8, linestyle=":")
right.plot([1e-8, 1e-1], [1e-8, 1e-1], color=GREY, linewidth=0.8)
right.set(
    title="what a threshold explains",
    xlabel="error in float32",
    ylabel="explained by flips",
    xlim=(1e-9, 1e-1),
    ylim=(5e-10, 1),
)
right.legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 0.1))
plt.show()
print(f"largest error {verdict.image_max:.1e}; without the pixels at thresholds {verdict.quiet_image_max:.1e}")

# %% [markdown]
# To the right of the dotted line, 2e-5, there are only pixels at thresholds, and all of them lie above the diagonal:
# their flips explain their errors. Most pixels at a threshold did not flip.
#
# **The gradient** has the same dots. A gradient is linear in the derivative $v$ of the loss with respect to the image,
# so setting $v = 0$ at the pixels in question leaves only the error of the arithmetic.

# %% tags=["rounding"]
_, tape = forward(contenders["cpu-f32"], workload)
whole = by_parameter(backward(contenders["cpu-f32"], tape, workload.v_image), expected.gradient)
quiet_v = np.where(at.is_near[:, :, None], 0, workload.v_image)
quiet = by_parameter(backward(contenders["cpu-f32"], tape, quiet_v), expected.quiet_gradient)

figure, axes_ = plt.subplots(figsize=(8, 2.8))
places = np.arange(len(whole))
axes_.bar(places - 0.2, whole.values(), 0.4, color=RED, label="all pixels")
axes_.bar(places + 0.2, quiet.values(), 0.4, color=BLUE, label="without the pixels at thresholds")
axes_.axhline(BENCH_FLOAT32_GRADIENT, color=GREY, linewidth=0.8, linestyle=":")
axes_.set(yscale="log", xticks=places, xticklabels=list(whole), ylabel="relative L2 error", title="float32 gradients")
axes_.legend(frameon=True, framealpha=1, edgecolor="none")
plt.show()

# %% [markdown]
# A handful of flipped pixels causes most of the error of a gradient over tens of thousands of pixels.
#
# ## How long must an exponential be?
#
# The kernels compute $e^x = 2^n\, 2^f$ with $|f| \le 1/2$: $n$ goes into the exponent bits, and $2^f$ is a polynomial.
# Chebyshev interpolation of degree $d$ leaves a remainder of about
#
# $$ \varepsilon_d = \frac{2}{(d+1)!} \Bigl( \frac{\ln 2}{4} \Bigr)^{d+1} $$
#
# and each further degree costs one fused multiply-add for every pixel of every Gaussian.

# %% tags=["rounding"]
xs = np.linspace(-6, 0, 1201, dtype=np.float32)
curves = {degree: relative_errors(exp, xs) for degree, exp in EXPONENTIALS.items()}
remainders = {d: 2 * (np.log(2) / 4) ** (d + 1) / np.prod(np.arange(1.0, d + 2)) for d in EXPONENTIALS}

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3))
for (degree, curve), color in zip(curves.items(), (YELLOW, GREEN, RED, BLUE), strict=True):
    left.semilogy(xs, np.maximum(curve, 1e-9), color=color, linewidth=0.7, label=f"degree {degree}")
left.axhline(2.0**-24, color=GREY, linewidth=0.8, linestyle=":", label="half a unit of float32")
left.set(title="relative error of exp(x)", xlabel="x", ylim=(1e-9, 1e-1))
left.legend(ncols=3, fontsize=8, loc="upper left", frameon=True, framealpha=1, edgecolor="none")
degrees = list(EXPONENTIALS)
right.semilogy(degrees, [curves[d].max() for d in degrees], "o-", color=RED, label="measured, largest")
right.semilogy(degrees, list(remainders.values()), "s--", color=GREY, label="Chebyshev's remainder")
degree_names = {3: "cpu-f32-exp3", 4: "cpu-f32-exp4", 5: "cpu-f32"}
verdicts = {d: judge(contenders[name], workload, expected) for d, name in degree_names.items()}
right.semilogy(list(verdicts), [v.quiet_image_max for v in verdicts.values()], "D-", color=BLUE, label="image, largest")
right.set(title="what a degree gains", xlabel="degree", xticks=degrees)
right.legend(frameon=False)
plt.show()

# %% [markdown]
# Degree 3 shows in the image. From degree 4 on the error of the image comes from elsewhere: the centres of the ellipses
# are stored as float32 pixels, and near pixel 200 their last digit is $10^{-5}$. Degree 6 gains nothing at all, because
# rounding hides it.
#
# ## The benchmark
#
# First every contender is judged: one whose error exceeds its bound, beyond what flips explain, has failed and gets no
# time. Shorter cut-offs render other images on purpose; they must agree with float64 under *their* cut-off, and the
# error in the table is the one against the default. To see that the judge works, one contender has an error planted in
# one line of its gradient.

# %% tags=["clock"]
wrong = contenders["cpu-f32"]._replace(name="planted", backend=plant("half-off-diagonal"))
small = synth(4_000, width=96, height=54, focal=80.0)
runners = [contenders[name] for name in contenders if "exp6" not in name and "exp4" not in name]
cases = benchmark(small, [*runners, wrong], repeats=3)
results = {case.name.removeprefix("synth/"): case for case in cases}
for name, case in results.items():
    f = case.figures
    time = f"{f['least both ms']:8.1f} ms" if case.passed else "   FAILED  "
    print(
        f"{name:18} {time}   image {f['image max, no flips']:.1e}   gradient {f['gradient, no flips']:.1e}  {case.note}"
    )
display(pareto_figure(cases))

# %% [markdown]
# Nothing is below and to the left of the dotted line. Read it from the left: the reference is exact and slow. The
# float64 kernels are as exact for all practical purposes. float32 gives up eight digits and is faster. Further to the
# right, another one to four digits are given up for little or no time: the tiles of three standard deviations, for one,
# hold more pairs than the exact bounds.
#
# **Why the default is what it is.** With float32 and the polynomial of degree 5 the error is still that of the digits
# and not of a formula: libm's exponential costs more and has the same error, and everything cheaper has a larger one.
# Degree 4 comes close; with degree 5 the exponential never has to be considered as the cause of an error.
#
# ## Play
#
# Compare any two contenders. What to look for:
#
# * `pair`: float64 and float32 differ by flips. Do `cpu-f32` and `cpu-exact-f32` have flips between them?
# * `scale`: with a larger image of the same scene, are there more flips per pixel or fewer?

# %% tags=["rounding"]
print("choose from:", ", ".join(contenders))
pair, scale = ("cpu-f64", "cpu-f32"), 1.0

mine = synth(20_000, width=round(256 * scale), height=round(144 * scale), focal=213.0 * scale)
first, second = (forward(contenders[name], mine)[0] for name in pair)
apart = np.abs(first - second).max(axis=2)
figure, axes = plt.subplots(figsize=(6, 3))
shown = show(axes, np.log10(np.maximum(apart, 1e-17)), f"{pair[0]} and {pair[1]}", **digits)
figure.colorbar(shown, ax=axes, label="log10")
plt.show()
print(f"{np.mean(apart > 1e-5):.3%} of the pixels differ by more than 1e-5")

# %% [markdown]
# ## Exercises
#
# **1.** How many flips are to be expected? Let a pixel have $K$ Gaussians whose alphas are spread evenly on a
# logarithmic scale from $10^{-6}$ to 1, and let float32 move each alpha by a relative error of $10^{-6}$.
#
# <details>
# <summary>Solution</summary>
#
# The scale has $\ln 10^6 = 13.8$ units, of which $2 \cdot 10^{-6}$ lie within the error on either side of 1/255: a
# probability of $1.4 \cdot 10^{-7}$ per hit. With 100 Gaussians and 37,000 pixels that is half a flip per image. More
# are to be expected where alphas crowd near the threshold, and that is where the rims of all Gaussians are.
#
# ```python
# rng = np.random.default_rng(0)
# n = 4_000_000
# alpha = np.exp(rng.uniform(np.log(1e-6), 0, n))
# moved = alpha * (1 + 1e-3 * rng.uniform(-1, 1, n))  # a thousand times the error, to count some
# flips = np.mean((alpha < 1 / 255) != (moved < 1 / 255))
# assert 0.3 < flips / (1e-3 / np.log(1e6)) < 1.2
# ```
#
# </details>
#
# **2.** Why does the error of $e^x$ matter less for hits of small alpha, and where does it matter most?
#
# <details>
# <summary>Solution</summary>
#
# The error is relative, so a hit contributes $\epsilon\,\alpha\,T$: at most $\epsilon$ where one opaque Gaussian fills
# the pixel, and in a stack the errors of the hits are weighted by $w_i$, which sum to 1. The exception is the threshold
# at 1/255, where a relative error of any size decides about the whole hit.
#
# ```python
# x = np.linspace(-5, 0, 1000, dtype=np.float32)
# cubic = EXPONENTIALS[3](x)
# absolute = np.abs(cubic.astype(float) - np.exp(x.astype(float)))
# assert absolute[x < -4].max() < 0.1 * absolute.max()
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
# float64 kernels agree with the reference to 11 digits and more; float32 keeps its bound where nothing flips.
assert errors["cpu-f64"].max() < BENCH_FLOAT64
assert verdict.quiet_image_max < BENCH_FLOAT32_IMAGE and verdict.n_wrong == 0
assert not failure(contenders["cpu-f32"], verdict)

# The worst pixel is a flip: one hit on either side of 1/255, and an error of not more than that hit.
assert offsets[0] * offsets[1] < 0 and np.abs(offsets).max() < 1e-3
assert BENCH_FLOAT32_IMAGE < errors["cpu-f32"][y, x] < 1.1 / 255
assert at.is_near[y, x] and errors["cpu-f32"][y, x] <= at.allowance[y, x] + BENCH_FLOAT32_IMAGE
assert flipped.sum() >= 1 and at.is_near.mean() < 0.02

# Without flips the gradient is right to 1e-4, with them the error is far larger.
assert max(quiet.values()) < BENCH_FLOAT32_GRADIENT and max(whole.values()) > 3 * max(quiet.values())

# Degree by degree: the remainder, the image, and where a further degree gains nothing.
assert all(0.5 < curves[d].max() / remainders[d] < 2 for d in (3, 4))
assert verdicts[3].quiet_image_max > 5 * verdicts[5].quiet_image_max
assert verdicts[4].quiet_image_max < 2 * verdicts[5].quiet_image_max
assert curves[6].max() > 2.0**-24 > remainders[6]

# Shorter cut-offs are other images.
assert errors["cpu-f32-3-sigma"].max() > 1e-3 and errors["cpu-f32-cut-1/64"].max() > 1e-2

# The judge passed all but the one with the planted error, and gave that one no time.
assert [name for name, case in results.items() if not case.passed] == ["planted"]
assert results["planted"].figures["both ms"] is None and results["planted"].figures["gradient"] > 0.01
print("all of the above holds")
