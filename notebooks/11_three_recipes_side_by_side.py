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
# # 11 Three recipes side by side
#
# One scene, one start, three methods: `3dgs-accel` adds Gaussians where gradients ask for them and keeps them;
# `mini-splatting` adds more, then draws a few by importance; `mini-splatting2` does the same much sooner, so that most
# of the time is spent on few. The stages are those of notebooks 06 to 10; here is how they work together.
#
# First the result, on a view that training never saw. How each recipe got there, event by event, follows below.

# %%
import itertools
import time
from functools import partial

import matplotlib.pyplot as plt
import numpy as np

from figures import BLUE, GREEN, RED, show, show_error
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.methods import RECIPES
from minisplat_ref.metrics import evaluate
from minisplat_ref.rendering import RenderSettings, render
from minisplat_ref.training.initial_state import initial_state
from minisplat_ref.training.loop import train
from minisplat_ref.training.recipe_settings import configure
from minisplat_ref.training.schedule import DatedEvent, During, Every, SmallerViews, scale_recipe

# %%
ITERATIONS = 900
NAMES = ("3dgs-accel", "mini-splatting", "mini-splatting2")
COLORS = dict(zip(NAMES, (RED, BLUE, GREEN), strict=True))


def named(action):
    """The function inside a partial, and what is bound to it."""
    action = action if isinstance(action, partial) else partial(action)
    return action.func.__name__, action.keywords


def shortened(recipe, iterations=ITERATIONS):
    """Return the recipe for few views and iterations."""
    halved = [e._replace(min_gap=-(-e.min_gap // 2)) if isinstance(e, Every) else e for e in recipe.events]
    return scale_recipe(recipe._replace(events=tuple(halved)), iterations)


def due_steps(event):
    """The iterations at which an event acts."""
    return [step for step in range(1, ITERATIONS + 1) if event.is_due(step)]


recipes = {name: shortened(RECIPES[name]) for name in NAMES}

# %% tags=["rounding"]
scene = make_scene("room", n_views=24, width=88, height=66, n_points=800, seed=0).scene
held_out = scene.test_views[1]
spent = [0.0]  # seconds of measuring, of the current run


def quality(gaussians):
    """PSNR of the views that training never sees, dB."""
    start = time.perf_counter()
    result = evaluate(gaussians, scene.test_views, RenderSettings(scene.background))
    spent[0] += time.perf_counter() - start
    return result.psnr


def copied(gaussians):
    """A copy, because training works in place."""
    return gaussians._make(field.copy() for field in gaussians)


def noted(log, action, state, iteration):
    """Do what the action does, and note what it did."""
    before, psnr_before = copied(state.gaussians), quality(state.gaussians)
    action(state, iteration)
    log.append(
        {
            "step": state.step + 1,
            "action": named(action)[0],
            "gaussians": (before, copied(state.gaussians)),
            "counts": (len(before.means), len(state.gaussians.means)),
            "psnrs": (psnr_before, quality(state.gaussians)),
        }
    )


def run(recipe):
    """Train; return the state, the log of events, and the curve: step, seconds, count, PSNR, ms of the iteration."""
    log, curve, ticks = [], [], []
    events = tuple(
        event._replace(action=partial(noted, log, event.action)) if isinstance(event, DatedEvent) else event
        for event in recipe.events
    )
    state = initial_state(scene, recipe, seed=0)
    curve.append((0, 0.0, len(state.gaussians.means), quality(state.gaussians)))
    spent[0], begin = 0.0, time.perf_counter()

    def on_step(report):
        ticks.append(time.perf_counter() - begin - spent[0])
        if report.step % 20 == 0:
            n = len(report.state.gaussians.means)
            curve.append((report.step, ticks[-1], n, quality(report.state.gaussians)))

    train(scene, recipe._replace(events=events), seed=0, state=state, on_step=on_step)
    return state.gaussians, log, np.array(curve), np.diff(ticks, prepend=0.0)


train(scene, recipes["mini-splatting2"]._replace(iterations=3), seed=0)  # compiles the kernels, or loads them
results = {name: run(recipe) for name, recipe in recipes.items()}
print(f"{'recipe':<18}{'Gaussians':>10}{'at most':>10}{'PSNR (dB)':>11}{'seconds':>9}")
for name, (gaussians, log, curve, _) in results.items():
    most = max(max(entry["counts"]) for entry in log)
    print(f"{name:<18}{len(gaussians.means):>10,}{most:>10,}{curve[-1, 3]:>11.2f}{curve[-1, 1]:>9.1f}")

# %% tags=["rounding"]
truth = held_out.image / 255
figure, axes = plt.subplots(2, 4, figsize=(11, 4.3))
show(axes[0, 0], truth, "photograph, held out")
axes[1, 0].axis("off")
for column, (name, (gaussians, _, curve, _)) in enumerate(results.items(), start=1):
    image = render(gaussians, held_out.camera, background=scene.background)[0].image
    show(axes[0, column], image, f"{name}: {len(gaussians.means):,}, {curve[-1, 3]:.2f} dB")
    error = show_error(axes[1, column], image, truth)
figure.colorbar(error, ax=axes[1, 0], location="right", shrink=0.9)
plt.show()

# %% [markdown]
# | file | what it holds | where in the paper |
# |---|---|---|
# | `minisplat_ref/training/schedule.py` | what a recipe is made of: what is due when, as data | |
# | `minisplat_ref/methods/gaussian_splatting.py` | `3dgs`, `3dgs-accel` | 3DGS sec. 7.1 |
# | `minisplat_ref/methods/mini_splatting.py` | `mini-splatting`, and `-d` without simplification | MS sec. 3 |
# | `minisplat_ref/methods/mini_splatting2.py` | `mini-splatting2`, and `-d` | MS2 sec. 3 |
# | `minisplat_ref/training/state.py` | what the actions in these files change: the training state | |
#
# *3DGS* is Kerbl et al. 2023, *MS* and *MS2* are Mini-Splatting and Mini-Splatting2, both Fang and Wang 2024.
# **Frames and units:** the world is in metres; images are in pixels, the centre of the top-left one at (0.5, 0.5). The
# kernels are compiled on first use, which takes some twenty seconds once.
#
# ## The recipes
#
# A recipe is data, and scales with the number of iterations: every published date is multiplied by the same factor.
# `min_gap` keeps density control from coming so often that the gradients of most views are missing, or that the last
# event has not been repaired; then only every second published date remains, or every third. With 24 views half of the
# gap is enough. These are the dates of the three runs:

# %%
for recipe in recipes.values():
    half_size_until = sum(event.until for event in recipe.events if isinstance(event, SmallerViews))
    print(f"{recipe.name}: half size until {half_size_until}, colour degrees at {recipe.sh_milestones}")
    for event in (event for event in recipe.events if not isinstance(event, SmallerViews)):
        steps = due_steps(event)
        when = f"{steps[0]} to {steps[-1]}" if isinstance(event, During) else ", ".join(map(str, steps)) or "never"
        print(f"    {named(event.action)[0]:<26}{when}")

# %% [markdown]
# ## How they got there
#
# Here are the same three runs by iteration, by time and by number. The dots in the last panel are their ends. In the
# log each event is wrapped by a function that notes count and quality before and after it. Measuring takes time, which
# is subtracted from the clock.

# %% tags=["clock"]
figure, axes = plt.subplots(1, 4, figsize=(11, 2.9))
for name, (_, _, curve, seconds) in results.items():
    steps, clock, counts, psnrs = curve.T
    color = COLORS[name]
    axes[0].step(steps, counts, where="post", color=color, label=name)
    axes[1].plot(np.arange(10, ITERATIONS, 20), 1e3 * np.median(seconds.reshape(-1, 20), axis=1), color=color)
    axes[2].plot(clock, psnrs, color=color)
    axes[3].plot(counts, psnrs, color=color, linewidth=0.8, alpha=0.6)
    axes[3].plot(counts[-1], psnrs[-1], "o", color=color, ms=8)
axes[0].set(title="Gaussians", xlabel="iteration", ylim=(0, None))
axes[0].legend(frameon=False, fontsize=8)
axes[1].set(title="time of an iteration", xlabel="iteration", ylabel="ms", ylim=(0, None))
axes[2].set(title="PSNR over training time", xlabel="s", ylabel="dB")
axes[3].set(title="PSNR over count", xlabel="Gaussians", ylabel="dB", xlim=(0, None))
plt.show()

# %% [markdown]
# ## What each event does
#
# These are the Gaussians and the PSNR (dB, held-out views) right before and right after each event. Events that changed
# neither are not listed.

# %% tags=["rounding"]
for name, (_, log, _, _) in results.items():
    print(f"{name}\n{'iteration':>11}  {'event':<24}{'Gaussians':>18}{'PSNR (dB)':>20}")
    for entry in log:
        (n_before, n_after), (psnr_before, psnr_after) = entry["counts"], entry["psnrs"]
        if n_before != n_after or psnr_before != psnr_after:
            print(
                f"{entry['step']:>11}  {entry['action']:<24}{n_before:>8,} -> {n_after:>6,}"
                f"{psnr_before:>12.2f} -> {psnr_after:.2f}"
            )

# %% [markdown]
# Here are four of them in pictures: the same held-out view before, after, and the difference. A clone of 3DGS is as
# opaque as the original and adds to it. A clone of Mini-Splatting2 shares the opacity of the original, so that hardly
# anything changes.

# %% tags=["rounding"]
chosen = (
    ("3dgs-accel", "clone_and_split"),
    ("mini-splatting", "simplify"),
    ("mini-splatting2", "aggressive_clone"),
    ("mini-splatting2", "simplify"),
)


def last_event(name, action):
    """The log entry of a run's last such event."""
    return [entry for entry in results[name][1] if entry["action"] == action][-1]


figure, axes = plt.subplots(3, len(chosen), figsize=(10.5, 6.6))
for column, (name, action) in zip(axes.T, chosen, strict=True):
    entry = last_event(name, action)
    images = [render(g, held_out.camera, background=scene.background)[0].image for g in entry["gaussians"]]
    counts, psnrs = entry["counts"], entry["psnrs"]
    show(column[0], images[0], f"{name}\nbefore {action}\n{counts[0]:,}, {psnrs[0]:.2f} dB")
    show(column[1], images[1], f"after\n{counts[1]:,}, {psnrs[1]:.2f} dB")
    difference = show_error(column[2], *images, "", vmax=0.2)
figure.colorbar(difference, ax=axes[2], shrink=0.9)
plt.show()

# %% [markdown]
# ## Play
#
# Run one more recipe and see it next to the others. What to look for:
#
# * `budget`: with a quarter as many Gaussians, how much PSNR is lost? (`None` leaves the recipe's own share.)
# * `name`: `mini-splatting-d` simplifies nothing; is it better than `mini-splatting`?
# * `n_iterations`: raise it to 2000. Which recipe gains most?
#
# On a scene of your own, `minisplat-ref compare SCENE --recipes a,b,c` trains recipes and writes tables, figures and
# crops.

# %% tags=["rounding"]
name, n_iterations, budget = "mini-splatting2", 900, 300

settings = {} if budget is None else {"budget": budget}
mine = run(configure(shortened(RECIPES[name], n_iterations), **settings))[0]
figure, axes = plt.subplots(1, 3, figsize=(9.5, 2.7))
show(axes[0], truth, "photograph, held out")
for panel, gaussians, title in ((axes[1], results["mini-splatting2"][0], "above"), (axes[2], mine, "yours")):
    image = render(gaussians, held_out.camera, background=scene.background)[0].image
    show(panel, image, f"{title}: {len(gaussians.means):,}, {quality(gaussians):.2f} dB")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1.** What does training cost? If the time of an iteration were proportional to the number of Gaussians, which part
# of the work of `3dgs-accel` would `mini-splatting2` do? Compute it from the curves of the count, and compare with the
# seconds.
#
# <details>
# <summary>Solution</summary>
#
# The work is the area under the count. The measured share of the seconds is larger, because a part of every
# iteration does not depend on the Gaussians: loss, events, Python.
#
# ```python
# work = {name: np.trapezoid(curve[:, 2], curve[:, 0]) for name, (_, _, curve, _) in results.items()}
# share = work["mini-splatting2"] / work["3dgs-accel"]
# print(f"work {share:.2f}, seconds {results['mini-splatting2'][2][-1, 1] / results['3dgs-accel'][2][-1, 1]:.2f}")
# assert share < 0.5
# ```
#
# </details>
#
# **2.** Quality for its size: which recipe has the best PSNR *at the number of Gaussians with which* `mini-splatting2`
# *ends*? Read it off the last panel, or compute it.
#
# <details>
# <summary>Solution</summary>
#
# Look for the point of each curve whose count is nearest. On its way up `3dgs-accel` passes that count early, when it
# has trained little: equal counts are not equal training, and so this comparison flatters the recipes that come back to
# a small count at the end.
#
# ```python
# n_end = results["mini-splatting2"][2][-1, 2]
# for name, (_, _, curve, _) in results.items():
#     nearest = curve[np.argmin(np.abs(np.log(curve[:, 2] / n_end)))]
#     print(f"{name:<16}{nearest[2]:6.0f} Gaussians at iteration {nearest[0]:.0f}: {nearest[3]:.2f} dB")
# ```
#
# </details>

# %% [markdown]
# ## What was shown, checked

# %%
ends = {name: (len(gaussians.means), curve[-1, 3]) for name, (gaussians, _, curve, _) in results.items()}
for name, (_, log, curve, _) in results.items():
    # Views that training never saw came out well, and the counts add up: what one event left, the next one found.
    assert curve[-1, 3] > curve[0, 3] + 4
    assert all(entry["counts"][1] == following["counts"][0] for entry, following in itertools.pairwise(log))
    assert log[0]["counts"][0] == curve[0, 2] and log[-1]["counts"][1] == ends[name][0]
    # What only prepares later iterations leaves the picture as it is.
    for entry in log:
        if entry["action"] in ("store_sh", "restart_adam", "stop_culling"):
            assert entry["counts"][0] == entry["counts"][1] and entry["psnrs"][0] == entry["psnrs"][1]


def typical(gaussians):
    """Median PSNR of the held-out views, dB: one Gaussian in front of a camera spoils a mean of four."""
    return np.median([evaluate(gaussians, [view], RenderSettings(scene.background)).psnr for view in scene.test_views])


n_accel, psnr_accel = ends["3dgs-accel"]
for name in ("mini-splatting", "mini-splatting2"):
    # Simplification costs much at once, and training brings most of it back: far fewer Gaussians show nearly the same.
    (n, psnr), (gaussians, _, curve, _) = ends[name], results[name]
    simplified = last_event(name, "simplify")
    assert simplified["counts"][1] < 0.7 * simplified["counts"][0]
    before, after = map(typical, simplified["gaussians"])
    assert after < before - 2 and typical(gaussians) - after > 0.5 * (before - after)
    assert n < 0.5 * n_accel and psnr > psnr_accel - 3
    # The work of an iteration grows with its Gaussians.
    assert curve[:, 2].sum() < 0.5 * results["3dgs-accel"][2][:, 2].sum()

# An opacity reset costs much PSNR at once, an aggressive clone next to none.
before, after = last_event("3dgs-accel", "reset_opacity")["psnrs"]
assert after < before - 3
before, after = last_event("mini-splatting2", "aggressive_clone")["psnrs"]
assert abs(after - before) < 0.5
print("all of the above holds")
