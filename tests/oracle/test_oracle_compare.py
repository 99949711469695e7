"""Comparison: clean renderers pass, a planted error is named at its stage, rounding is kept apart from arithmetic."""

import json
from dataclasses import replace

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.app.cli.oracle import compare as compare_command
from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.oracle.comparison.measures import difference
from minisplat_ref.oracle.comparison.renderers import (
    ComparedRenderer,
    by_profile,
    choose_renderer,
    choose_scenes,
    from_backend,
    from_dumps,
    with_planted_error,
)
from minisplat_ref.oracle.comparison.staged import STAGES, as_report, compare_scene, first_divergence
from minisplat_ref.oracle.golden import running as golden_running
from minisplat_ref.oracle.golden.files import export
from minisplat_ref.oracle.golden.format import SPECS
from minisplat_ref.oracle.golden.running import reference_bins, run_stages
from minisplat_ref.oracle.golden.scenes import RECIPES, inputs, truth
from minisplat_ref.oracle.planted import PLANTED
from minisplat_ref.rendering.backends import CPU, CPU_EXACT, REFERENCE
from minisplat_ref.training.adam import AdamRule
from minisplat_ref.types import Projection
from tolerances import PARITY_FLOAT64

SCENES = {recipe.name: recipe for recipe in RECIPES}


@pytest.fixture(scope="module")
def ordinary():
    return truth(inputs(SCENES["ordinary"]))


@pytest.fixture(scope="module")
def odd():
    return truth(inputs(SCENES["odd-size"]))


@pytest.fixture(scope="module")
def equality():
    return {name: truth(inputs(SCENES[name])) for name in ("equality", "equality-inria")}


def by_stage(rows):
    return {row.stage: row for row in rows}


def test_every_output_and_gradient_has_a_stage():
    compared = [name for names in STAGES.values() for name in names]
    assert sorted(compared) == sorted(s.name for s in SPECS.values() if s.role in ("output", "gradient"))


@pytest.mark.parametrize("backend", [CPU, CPU_EXACT, REFERENCE], ids=lambda backend: backend.name)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_clean_backend_agrees_in_every_stage(backend, dtype, odd):
    rows = compare_scene(from_backend(backend, dtype), odd)
    assert first_divergence(rows) is None
    assert [row.stage for row in rows] == list(STAGES)
    assert all(row.status == "agrees" for row in rows if row.stage != "tile lists")
    lists = by_stage(rows)["tile lists"]  # those of cpu leave out what no pixel needs
    assert lists.status == ("agrees" if backend is REFERENCE else "harmless")
    report = as_report(from_backend(backend, dtype), rows, {})
    assert report.n_failed == 0 and f"all {len(STAGES)} stages" in report.title


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("error", PLANTED, ids=lambda error: error.name)
def test_a_planted_error_is_named_at_its_stage(error, dtype, odd):
    renderer = with_planted_error(error.name, dtype)
    rows = compare_scene(renderer, odd)
    first = first_divergence(rows)
    assert first is not None and first.stage == error.stage
    if dtype == "float64":  # a report takes ten times as long: it looks for the fault that explains the error
        assert f"diverges is {error.stage}" in as_report(renderer, rows, {}).title


DIVERGING = {
    "half-off-diagonal": ["v_conics", "v_features"],
    "unsorted-depth": ["tile lists"],
    "sh-sign": ["colors", "v_means", "v_R", "v_t"],
    "clamp-0.999": [
        *("T", "image", "features", "statistics", "median depth"),
        *("v_colors", "v_background", "v_means2d", "v_conics", "v_opacities2d", "v_features"),
    ],
}


@pytest.mark.parametrize("error", DIVERGING)
def test_an_error_stays_in_its_stage(error, ordinary):
    """What comes after the wrong stage was fed with the truth, so it agrees."""
    rows = by_stage(compare_scene(with_planted_error(error, "float64"), ordinary))
    diverging = [stage for stage in STAGES if rows[stage].status == "diverges"]
    assert diverging[0] == DIVERGING[error][0] and set(diverging) <= {*DIVERGING[error], "v_sh", "view", "v_view"}
    if error == "half-off-diagonal":
        assert rows["v_conics"].note == "only [:, 1] times 0.5"
    for stage in diverging[1:]:
        relation = "may follow from" if stage in ("view", "v_view") else "of one stage with"
        assert rows[stage].note.endswith(f"{relation} {diverging[0]}"), rows[stage]


def test_results_of_one_stage_do_not_follow_from_each_other(odd, tmp_path):
    """A colour that is clamped at 0 has a gradient all the same: v_means and v_sh are wrong beside each other."""

    def sh_colors_vjp(means, sh_dc, *rest):
        return CPU.sh_colors_vjp(means, sh_dc + 100, *rest)

    wrong = replace(CPU, sh_colors_vjp=sh_colors_vjp)
    rows = by_stage(compare_scene(from_backend(wrong, "float64"), odd))
    assert rows["v_means"].arrays == ("v_means_colors",)
    assert rows["v_sh"].note.endswith("of one stage with v_means")
    assert rows["v_quats"].status == "agrees" and "may follow from v_means" in rows["v_view"].note

    a = odd.arrays
    arrays = {name: 1.1 * a[name] for name in ("v_means_colors", "v_means", "v_sh_dc", "v_quats")}
    rows = by_stage(compare_scene(dump(tmp_path, odd, "float64", **arrays), odd))
    assert rows["v_sh"].note.endswith("of one stage with v_means") and rows["v_quats"].note == "times 1.1"


def test_bounds_are_judged_by_the_image(ordinary):
    wide = by_stage(compare_scene(by_profile(INRIA._replace(clamp_is_symmetric=False), "float64"), ordinary))
    assert wide["radii"].status == "diverges" and "the image changes" in wide["radii"].note

    def wider(*args):
        p = REFERENCE.project(*args)
        grown = np.where(p.radii > 0, p.radii + 5, 0).astype(np.int32)
        low, high = np.maximum(p.boxes[:, :2] - 5, 0), np.minimum(p.boxes[:, 2:] + 5, (48, 32))
        return p._replace(radii=grown, boxes=np.where(p.radii[:, :1] > 0, np.hstack([low, high]), 0).astype(np.int32))

    row = by_stage(compare_scene(from_backend(replace(REFERENCE, project=wider), "float64"), ordinary))["radii"]
    assert row.status == "harmless" and row.note == "150 bounded differently; same image"


def test_radii_alone_are_judged_too(ordinary):
    """As gsplat gives them: no boxes, 3.33 sigma whatever the opacity; INRIA's are single numbers."""
    a = ordinary.arrays

    def give(radii):
        return ComparedRenderer("other", "float64", True, lambda truth: {"radii": radii})

    assert by_stage(compare_scene(give(a["radii"] + 4 * (a["radii"] > 0)), ordinary))["radii"].status == "harmless"
    assert by_stage(compare_scene(give(a["radii"].max(axis=1)), ordinary))["radii"].status == "harmless"
    assert by_stage(compare_scene(give(a["radii"] // 2), ordinary))["radii"].status == "diverges"
    culled = a["radii"].copy()
    culled[np.argmax(a["radii"][:, 0])] = 0
    assert "1 culled that the reference shows" in by_stage(compare_scene(give(culled), ordinary))["radii"].note


def test_a_gaussian_that_should_be_culled_is_noticed(odd):
    """Shown behind the near plane: its footprint is another's, so it is drawn with that."""
    no_planes = odd.conventions._replace(near_plane=-np.inf)
    behind = odd._replace(arrays=odd.arrays | {"means": odd.arrays["means"].copy()})
    behind.arrays["means"][0] = behind.camera.cam_from_world_R.T @ ([0, 0, -2.0] - behind.camera.cam_from_world_t)
    behind = truth(behind)
    assert behind.arrays["radii"][0, 0] == 0

    def project(*arguments):
        return REFERENCE.project(*arguments[:-1], no_planes)

    row = by_stage(compare_scene(from_backend(replace(REFERENCE, project=project), "float64"), behind))["radii"]
    assert row.status == "diverges" and "1 shown that the reference culls" in row.note


def test_lists_are_compared_as_sets_and_in_their_order(ordinary):
    a = ordinary.arrays
    ids, offsets = a["gaussian_ids"], a["tile_offsets"]

    def status(ids, offsets=offsets):
        given = {"gaussian_ids": ids, "tile_offsets": offsets}
        return by_stage(compare_scene(ComparedRenderer("other", "float64", True, lambda truth: given), ordinary))[
            "tile lists"
        ]

    assert status(ids).status == "agrees"
    backwards = ids.copy()
    backwards[: offsets[1]] = ids[: offsets[1]][::-1]
    assert status(backwards).status == "diverges" and "1 tiles in another order" in status(backwards).note
    assert status(ids[1:], np.append(0, offsets[1:] - 1)).note.startswith("1 pairs fewer")
    assert "no lists" in status(ids, np.append(1, offsets[1:])).note  # a pair that is in no list
    assert "no lists" in status(ids, offsets[:-1]).note and "no lists" in status(ids + 1000).note
    doubled = np.append(ids[:1], ids)
    assert status(doubled, np.append(0, offsets[1:] + 1)).status == "diverges"


# What stages there are to be wrong in


def changed(stage, change):
    """The cpu backend with ``change`` made to what a stage gives."""
    right = getattr(CPU, stage)

    def wrong(*args, **named):
        return change(right(*args, **named))

    return replace(CPU, **{stage: wrong})


def zero_of_depth(v):
    return v if v.colors.shape[1] == 3 else v._replace(colors=v.colors * (np.arange(v.colors.shape[1]) > 0))


def with_statistics(field, change):
    def wrong(output):
        if output.stats is None:
            return output
        return output._replace(stats=output.stats._replace(**{field: change(getattr(output.stats, field))}))

    return changed("composite", wrong)


def eps_in_the_root(values, gradient, first, second, rows, step):
    m = first + (1 - step.beta1) * (gradient - first)
    v = second + (1 - step.beta2) * (gradient**2 - second)
    chosen = slice(None) if rows is None else rows
    first[chosen], second[chosen] = m[chosen], v[chosen]
    values[chosen] -= (step.rate * m / np.sqrt(v + step.eps))[chosen]


def all_rows(values, gradient, first, second, rows, step):
    CPU.adam_update(values, gradient, first, second, None, step)


def without_mask(image, target, weight, mask=None):
    return CPU.photometric_loss(image, target, weight)


def of_256(image, target, weight, mask=None):
    target = target / 256 if target.dtype == np.uint8 else target
    return CPU.photometric_loss(image, target.astype(image.dtype), weight, mask)


def medians_from_the_front(output):
    median = output.median_depth
    return output if median is None else output._replace(median_depth=np.where(median > 0, median.min(), 0))


FURTHER = {
    "eps inside the root": (replace(CPU, adam_update=eps_in_the_root), "Adam"),
    "all rows updated": (replace(CPU, adam_update=all_rows), "Adam"),
    "mask ignored": (replace(CPU, photometric_loss=without_mask), "loss"),
    "bytes by 256": (replace(CPU, photometric_loss=of_256), "loss"),
    "loss of the mask, gradient without": (
        changed("photometric_loss_vjp", lambda v: np.where(v == 0, 1e-6, v)),
        "v_image_of_loss",
    ),
    "first of other channel counts": (changed("composite_vjp", zero_of_depth), "v_features"),
    "hits counted double": (with_statistics("hit_count", lambda n: 2 * n), "statistics"),
    "dominant by row": (with_statistics("dominant_ids", lambda ids: np.minimum(ids, 40)), "statistics"),
    "sum of weights": (with_statistics("blend_weight_sum", lambda w: 1.001 * w), "statistics"),
    "median": (changed("composite", medians_from_the_front), "median depth"),
    "surface": (changed("surface_points", lambda s: s._replace(depths=1.001 * s.depths)), "surface"),
    "surface's gradient": (changed("surface_points_vjp", lambda v: (v[0], -v[1], v[2])), "v_surface"),
}


@pytest.mark.parametrize("error", FURTHER)
def test_an_error_behind_the_image_is_named(error, odd, ordinary):
    backend, stage = FURTHER[error]
    scene = ordinary if stage == "v_features" else odd  # of five channels, and of three
    assert first_divergence(compare_scene(from_backend(backend, "float64"), scene)).stage == stage


def test_an_error_of_the_public_call_is_named(odd, monkeypatch):
    renderer = from_backend(CPU, "float64")
    with monkeypatch.context() as patch:
        patch.setattr(gsplat_compat, "expected_depth", lambda depth, alpha: depth)
        assert first_divergence(compare_scene(renderer, odd)).stage == "view"
    with monkeypatch.context() as patch:
        patch.setattr(gsplat_compat, "expected_depth_vjp", lambda depth, alpha, v: (v / np.maximum(alpha, 1e-10), 0))
        assert first_divergence(compare_scene(renderer, odd)).stage == "v_view"
    assert first_divergence(compare_scene(renderer, odd)) is None


def test_corrections_of_adam_are_those_of_the_book(odd, monkeypatch):
    monkeypatch.setattr(
        golden_running, "AdamRule", lambda rows, has_bias_correction, **named: AdamRule(rows, False, **named)
    )
    assert first_divergence(compare_scene(from_backend(CPU, "float64"), odd)).stage == "Adam"


# Equality


def by_conventions(**changes):
    def renderer(truth):
        changed = {k: v(getattr(truth.conventions, k)) if callable(v) else v for k, v in changes.items()}
        return from_backend(REFERENCE, "float64", truth.conventions._replace(**changed))

    return renderer


def up(x):
    return np.nextafter(x, np.inf)


def down(x):
    return np.nextafter(x, 0)


def last_row_first(truth):
    def bin_gaussians(projection, grid, conventions):
        slots = projection.depths - 1e-12 * np.arange(len(projection.depths))
        return REFERENCE.bin_gaussians(projection._replace(depths=slots), grid, conventions)

    return from_backend(replace(REFERENCE, bin_gaussians=bin_gaussians), "float64")


AT_EQUALITY = {
    "stops": ("equality", lambda truth: by_conventions(stops_at_equality=False)(truth), "T"),
    "does not stop": ("equality-inria", lambda truth: by_conventions(stops_at_equality=True)(truth), "T"),
    "clamped": ("equality", by_conventions(alpha_max=down), "v_opacities2d"),
    "skipped": ("equality-inria", by_conventions(alpha_min=up), "radii"),
    "near plane": ("equality", by_conventions(near_plane=down), "radii"),
    "far plane": ("equality", by_conventions(far_plane=up), "radii"),
    "order": ("equality", last_row_first, "tile lists"),
}


@pytest.mark.parametrize("rule", AT_EQUALITY)
def test_a_flipped_rule_at_equality_is_named(rule, equality):
    name, renderer, stage = AT_EQUALITY[rule]
    rows = compare_scene(renderer(equality[name]), equality[name])
    assert first_divergence(rows).stage == stage
    assert all(row.n_candidates == 0 for row in rows)


@pytest.mark.parametrize("backend", [CPU, CPU_EXACT], ids=lambda backend: backend.name)
def test_the_kernels_keep_the_rules_at_equality(backend, equality):
    for scene in equality.values():
        assert first_divergence(compare_scene(from_backend(backend, "float64"), scene)) is None


def test_scenes_of_equality_are_for_float64():
    with pytest.raises(InputError, match="can render none of the scenes equality"):
        choose_scenes(from_backend(CPU, "float32"), "equality", "reference", None)
    assert choose_scenes(from_backend(CPU, "float64"), "equality", "reference", None)[0]["equality"].is_exact


# Rounding


def one_gaussian(opacity, n=1):
    """A disc in the middle of an 17 x 17 image, n times at one place, whose covariance is 4 px^2."""
    recipe = RECIPES[0]._replace(size=(17, 17), sh_degree=0, n=n)
    scene = inputs(recipe)
    R, t = scene.camera.cam_from_world_R, scene.camera.cam_from_world_t
    means_cam = np.array([[0.0, 0.0, 2.0 + 0.01 * k] for k in range(n)])
    variance = 4 - scene.conventions.eps2d  # px^2; before the low-pass
    sizes = np.sqrt(variance) * means_cam[:, 2:] / scene.camera.fx
    arrays = {"means": (means_cam - t) @ R, "scales": np.repeat(sizes, 3, axis=1), "opacities": np.full(n, opacity)}
    arrays |= {"sh_dc": np.full((n, 3), 1.5), "intrinsics": np.array([scene.camera.fx, scene.camera.fx, 8.5, 8.5])}
    return scene._replace(name="threshold", arrays=scene.arrays | arrays)


def test_alpha_at_the_skip_threshold_is_a_flip():
    falloff = np.exp(-0.5 * 3**2 / 4)  # three pixels from the middle, covariance 4
    scene = truth(one_gaussian(GSPLAT_MAIN.alpha_min / falloff))
    a = scene.arrays
    ring = [(8, 5), (8, 11), (5, 8), (11, 8)]
    is_ring = np.zeros((17, 17), bool)
    is_ring[tuple(zip(*ring, strict=True))] = True
    assert not a["v_image"][is_ring].any() and np.count_nonzero(a["v_image"].any(axis=2)) == 17 * 17 - 4

    n_flips = 0
    for change in (-1e-12, 1e-12):  # all four hits are taken, then none
        other = GSPLAT_MAIN._replace(alpha_min=GSPLAT_MAIN.alpha_min * (1 + change))
        rows = by_stage(compare_scene(from_backend(REFERENCE, "float64", other), scene))
        for stage in ("T", "image"):
            assert rows[stage].status == "agrees" and rows[stage].n_candidates == 4
            assert rows[stage].difference.max_error < PARITY_FLOAT64
        n_flips += rows["T"].difference.n_flips
    assert n_flips == 4  # the reference takes as many as rounding lets it
    wrong = {name for stage, row in rows.items() if stage.startswith("v_") for name in row.arrays}
    assert wrong <= {"v_quats_view"}, "gradients saw a flip"  # a ball's is 0 but for rounding


def test_transmittance_at_the_stop_threshold_is_a_flip():
    """Two hits at the clamp leave exactly (1 - 0.99)^2 = 1e-4: the second is blended, or not."""
    scene = truth(one_gaussian(1.0, n=2))
    other = from_backend(REFERENCE, "float64", GSPLAT_MAIN._replace(transmittance_min=1e-4 * (1 - 1e-9)))
    third = from_backend(REFERENCE, "float64", GSPLAT_MAIN._replace(transmittance_min=1e-4 * (1 + 1e-9)))
    rows = [by_stage(compare_scene(renderer, scene))["T"] for renderer in (other, third)]
    assert [row.n_candidates for row in rows] == [1, 1]
    assert sorted(row.difference.n_flips for row in rows) == [0, 1]
    assert all(row.status == "agrees" for row in rows)


def test_an_error_beside_a_flip_is_an_error(ordinary):
    def composite(*args, **kwargs):
        output = REFERENCE.composite(*args, **kwargs)
        image = output.image.copy()
        image[3, 4, 1] += 1e-6
        return output._replace(image=image)

    rows = by_stage(compare_scene(from_backend(replace(REFERENCE, composite=composite), "float64"), ordinary))
    assert rows["image"].status == "diverges" and rows["image"].difference.n_over == 1
    assert rows["T"].status == "agrees"


def test_differences_by_hand():
    expected, given = np.array([[1.0, -4.0], [2.0, 0.0]]), np.array([[1.0, -4.0], [2.5, 1e-12]])
    d = difference(given, expected, 1e-9)
    assert (d.max_error, d.scale, d.relative, d.n_over, d.n) == (0.5, 4.0, 0.125, 1, 4)
    assert d.rms_error == pytest.approx(0.25)
    aside = difference(given, expected, 1e-9, np.array([False, True]))
    assert (aside.max_error, aside.n_over, aside.n, aside.n_flips) == (0.0, 0, 2, 1)
    assert difference(np.array([np.nan]), np.array([1.0]), 1e-9).max_error == np.inf
    assert difference(np.zeros((0, 3)), np.zeros((0, 3)), 1e-9).n_over == 0


# Dumps


def dump(folder, truth, dtype="float32", **changes):
    """What another renderer would write: all it has computed end to end, in one file."""
    arrays = {n: a for n, a in run_stages(CPU_EXACT, truth, dtype).items()} | changes
    (folder / truth.name).mkdir(parents=True)
    np.savez(folder / truth.name / "all.npz", **{n: a for n, a in arrays.items() if a is not None})
    return from_dumps(folder)


def test_a_dump_is_compared_by_its_own_dtype(odd, tmp_path):
    rows = compare_scene(dump(tmp_path, odd), odd)
    assert first_divergence(rows) is None and all(row.status in ("agrees", "harmless") for row in rows)
    assert by_stage(rows)["image"].difference.tolerance == SPECS["image"].tolerance.float32
    strict = compare_scene(from_dumps(tmp_path, "float64"), odd)
    assert first_divergence(strict).stage == "means2d"


def test_an_exported_folder_agrees_with_itself(odd, tmp_path):
    export(tmp_path / "golden", {"odd-size": odd})
    renderer = from_dumps(tmp_path / "golden")
    scenes, _ = choose_scenes(renderer, "all", str(tmp_path / "golden"), None)
    rows = compare_scene(renderer, scenes["odd-size"])
    assert all(row.status == "agrees" and not (row.difference and row.difference.max_error) for row in rows)
    (tmp_path / "golden" / "odd-size" / "tiles.npz").write_bytes(b"")
    with pytest.raises(InputError, match="SHA-256"):
        from_dumps(tmp_path / "golden")


def test_what_is_missing_is_not_given_and_does_not_pass(odd, tmp_path):
    arrays = {"image": odd.arrays["image"], "v_means": odd.arrays["v_means"]}
    renderer = ComparedRenderer("other", None, False, lambda truth: arrays)
    rows = compare_scene(renderer, odd)
    report = as_report(renderer, rows, {})
    assert [case.name for case in report.cases] == ["image", "v_means"]
    assert len(report.settings["not_given"]) == len(STAGES) - 2
    assert "all 2 stages that it gives agree" in report.title


def test_later_differences_may_follow_from_the_first(odd, tmp_path):
    a = odd.arrays
    rows = by_stage(compare_scene(dump(tmp_path, odd, "float64", conics=1.1 * a["conics"], image=a["image"] + 1), odd))
    assert first_divergence(rows.values()).stage == "conics"
    assert rows["conics"].note == "times 1.1" and rows["image"].note == "may follow from conics"


BAD_DUMPS = {
    "unknown name": ({"mean2d": np.zeros(3)}, "'mean2d' is no array of the golden format"),
    "shape": ({"means2d": np.zeros((150, 3), np.float32)}, r"means2d has shape \[150, 3\], expected \[150, 2\]"),
    "transposed image": ({"image": np.zeros((3, 23, 37), np.float32)}, r"image has shape \[3, 23, 37\]"),
    "dtype": ({"conics": np.zeros((150, 3), np.float16)}, "conics has dtype float16; write float32 or float64"),
    "integers": ({"radii": np.zeros((150, 2))}, "radii has dtype float64; write integers"),
    "radii": ({"radii": np.zeros((150, 3), int)}, r"radii has shape \[150, 3\]"),
    "tile size": ({"tile_size": np.array([0, 16])}, "tile_size must be"),
    "another scene": ({"means": np.zeros((150, 3))}, "its means is not that of the golden scene 'odd-size'"),
}


@pytest.mark.parametrize("bad", BAD_DUMPS)
def test_bad_dumps_are_refused_in_one_line(bad, odd, tmp_path):
    arrays, message = BAD_DUMPS[bad]
    with pytest.raises(InputError, match=message) as caught:
        compare_scene(dump(tmp_path, odd, **arrays), odd)
    assert "\n" not in str(caught.value)


def test_damaged_and_doubled_files_are_refused(odd, tmp_path):
    renderer = dump(tmp_path, odd)
    np.savez(tmp_path / "odd-size" / "more.npz", image=odd.arrays["image"])
    with pytest.raises(InputError, match="image was already in another file"):
        compare_scene(renderer, odd)
    (tmp_path / "odd-size" / "more.npz").write_bytes(b"PK not a zip")
    with pytest.raises(InputError, match=r"more\.npz is not an \.npz"):
        compare_scene(renderer, odd)


def test_what_is_not_finite_diverges(odd, tmp_path):
    image = odd.arrays["image"].copy()
    image[2, 3] = np.nan
    row = by_stage(compare_scene(dump(tmp_path, odd, image=image), odd))["image"]
    assert row.status == "diverges" and row.difference.max_error == np.inf and "not finite" in row.note


# Choosing


def test_renderers_by_their_names(tmp_path):
    assert choose_renderer("cpu", None).dtype == "float64" and choose_renderer("cpu", "float32").dtype == "float32"
    assert choose_renderer("profile:inria", None).name == "reference float64 by INRIA"
    for name, message in {
        "opensplat": "neither a folder of dumps nor a renderer",
        "planted:nothing": "planted error 'nothing' is unknown",
        "profile:nothing": "profile 'nothing' is unknown",
        str(tmp_path): "holds no SCENE/",
    }.items():
        with pytest.raises(InputError, match=message):
            choose_renderer(name, None)
    for name in ("gsplat", "inria"):  # no CUDA device here, or not installed
        with pytest.raises(InputError, match="float32"):
            choose_renderer(name, "float64")


def test_scenes_by_their_names(odd, tmp_path):
    renderer = dump(tmp_path / "mine", odd)
    scenes, left_out = choose_scenes(renderer, "all", "reference", None)
    assert list(scenes) == ["odd-size"] and left_out == ()
    with pytest.raises(InputError, match="has no scene 'sh3'; it has odd-size"):
        choose_scenes(renderer, "sh3", "reference", None)
    with pytest.raises(InputError, match="scene 'nothing' is unknown"):
        choose_scenes(renderer, "nothing", "reference", None)
    (tmp_path / "mine" / "odd-size").rename(tmp_path / "mine" / "odd")
    with pytest.raises(InputError, match="'odd' is no golden scene"):
        choose_scenes(from_dumps(tmp_path / "mine"), "all", "reference", None)


def test_the_truth_follows_the_renderers_rules():
    def rules(asked):
        return asked._replace(alpha_max=GSPLAT_1_5.alpha_max) if asked.has_full_support else None

    renderer = from_backend(REFERENCE, "float64")._replace(rules=rules, ignores=("v_depths",))
    scenes, left_out = choose_scenes(renderer, "all", "reference", None)
    assert left_out == ("inria", "equality-inria") and scenes["sh3"].conventions.alpha_max == 0.999
    assert not scenes["sh3"].arrays["v_depths"].any()
    forced, _ = choose_scenes(renderer, "inria", "reference", "GSPLAT_MAIN")
    assert forced["inria"].conventions == GSPLAT_MAIN
    with pytest.raises(InputError, match="can render none of the scenes inria"):
        choose_scenes(renderer, "inria", "reference", None)


def test_the_help_names_every_scene(capsys):
    assert compare_command.SCENES == tuple(SCENES)
    with pytest.raises(SystemExit):
        main(["oracle", "compare", "--help"])
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100


def test_the_command_names_the_stage_and_writes_json(tmp_path, capsys):
    file = tmp_path / "out.json"
    arguments = ["oracle", "compare", "planted:transposed-rs", "--scene", "odd-size", "--json", str(file)]
    assert main(arguments) == 1
    out = capsys.readouterr().out
    assert "the first stage that diverges is v_quats, in scene odd-size" in out and "DIVERGES FIRST" in out
    result = json.loads(file.read_text())
    assert result["settings"]["first_divergence"] == {"stage": "v_quats", "scene": "odd-size"}
    assert [case["name"] for case in result["cases"] if not case["passed"]] == ["v_quats", "v_scales", "v_view"]
    assert len(result["settings"]["scenes"]) == len(STAGES)
    assert main(["oracle", "compare", "cpu", "--scene", "odd-size", "--dtype", "float32"]) == 0
    assert "all 32 cases passed" in capsys.readouterr().out
    assert main(["oracle", "compare", "nothing"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_transmittance_read_from_alpha_in_float32_is_as_far_off_as_gsplats_gradients():
    """1 - alpha is off by 3e-8, and T = 1e-4, where blending stops, by 3e-4: 2.3e-4 of the largest gradient."""
    scenes, _ = choose_scenes(choose_renderer("cpu", "float32"), "odd-size", "reference", None)
    scene = scenes["odd-size"]
    a = scene.arrays
    given = Projection(*(a[name] for name in ("means2d", "depths", "conics", "opacities2d", "radii", "boxes")))
    blended = given, a["colors"], a["background"], reference_bins(a, scene.conventions, (16, 16)), scene.conventions
    output = REFERENCE.composite(*blended)
    T = 1 - a["alpha"]
    factor = (1 - a["alpha"].astype(np.float32)).astype(np.float64) / T  # of every weight in the pixel
    correct, off = (
        REFERENCE.composite_vjp(*blended, output, v, a["v_alpha"]).colors
        for v in (a["v_image"], factor[..., None] * a["v_image"])
    )
    assert T.min() < 1.1e-4 and np.abs(factor - 1).max() == pytest.approx(2.9e-4, abs=1e-5)
    assert np.abs(off - correct).max() / np.abs(correct).max() == pytest.approx(2.3e-4, abs=1e-5)
