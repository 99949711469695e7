"""Compare the stages with the truth in order; name the first that diverges, and report them all.

The order is forward from the projection to the image and the loss, then the gradients from the image back to the scene.
The report has one line for each stage, over all scenes.
"""

from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.oracle.cases import Case, Figure, Report
from minisplat_ref.oracle.comparison.doubts import doubts
from minisplat_ref.oracle.comparison.hints import Hint, Scene, find_hints, in_words
from minisplat_ref.oracle.comparison.measures import Bounds, Difference, compare_bounds, compare_lists, difference
from minisplat_ref.oracle.comparison.trials import BY_ROW, NOT_OF_FAULTS, Evidence, comparable, shown_rows
from minisplat_ref.oracle.golden.format import SPECS, STAGE_COTANGENTS, STAGE_INPUTS, Arrays, Golden, names_of
from minisplat_ref.oracle.renderer import ComparedRenderer
from minisplat_ref.types import Bools

Status = Literal["agrees", "diverges", "harmless", "not given"]

STAGES: dict[str, tuple[str, ...]] = {
    "means2d": ("means2d",),
    "depths": ("depths",),
    "conics": ("conics",),
    "opacities2d": ("opacities2d",),
    "radii": ("radii", "boxes"),
    "tile lists": ("gaussian_ids", "tile_offsets"),
    "colors": ("colors",),
    "T": ("alpha",),
    "image": ("image",),
    "loss": ("loss", "masked_loss"),
    "features": ("feature_image", "accumulated_depth"),
    "statistics": ("blend_weight_sum", "blend_weight_max", "hit_count", "dominant_count", "dominant_ids"),
    "median depth": ("median_depth",),
    "surface": ("surface_points", "surface_depths"),
    "Adam": ("adam_values_after", "adam_first_after", "adam_second_after"),
    "v_image_of_loss": ("v_image_of_loss", "v_image_of_masked_loss"),
    "v_colors": ("v_colors",),
    "v_background": ("v_background",),
    "v_means2d": ("v_means2d",),
    "v_conics": ("v_conics",),
    "v_opacities2d": ("v_opacities2d",),
    "v_means": ("v_means_projection", "v_means_colors", "v_means"),
    "v_quats": ("v_quats",),
    "v_scales": ("v_scales",),
    "v_opacities": ("v_opacities",),
    "v_sh": ("v_sh_dc", "v_sh_rest"),
    "v_R": ("v_R_projection", "v_R_colors", "v_R"),
    "v_t": ("v_t_projection", "v_t_colors", "v_t"),
    "v_features": (
        *("v_features", "v_feature_background", "v_depths_features"),
        *("v_means2d_features", "v_conics_features", "v_opacities2d_features"),
    ),
    "v_surface": ("v_means_surface", "v_quats_surface", "v_scales_surface"),
    "view": ("view", "view_alpha"),
    "v_view": (
        *("v_means_view", "v_quats_view", "v_scales_view", "v_opacities_view"),
        *("v_sh_dc_view", "v_sh_rest_view", "v_viewmat", "v_background_view"),
    ),
}
"""Arrays of each stage; T is compared by alpha = 1 - T. The view comes last: it is the whole renderer in one call."""
ONE_FUNCTION = {"features": "composite", "statistics": "composite"}
"""Stages of the golden format that a function of another stage computes."""
FLIPPING = ("T", "image", "features", "statistics", "median depth", "view")  # flips are counted
SLIGHT = 5.0  # times the tolerance, up to which a difference in few values counts as rounding
CLEAR = 0.1  # of the largest error, from which on a scene shows it as well
FEW = 0.01  # of the values of the arrays that are off


class Row(NamedTuple):
    """One stage of one scene."""

    scene: str
    stage: str
    status: Status
    difference: Difference | None
    """Of the array with the largest error; None where nothing was given or no numbers were compared."""
    bounds: Bounds | None = None
    """For radii and tile lists."""
    n_candidates: int = 0
    """Pixels that rounding decides, or Gaussians, where flips are counted."""
    arrays: tuple[str, ...] = ()
    """Names of those that diverge."""
    note: str = ""
    """One line."""
    evidence: Evidence | None = None
    """What the renderer gave for the whole scene."""


def compare_scene(renderer: ComparedRenderer, truth: Golden) -> list[Row]:
    """Compare one scene.

    Parameters
    ----------
    renderer : ComparedRenderer
        The renderer that is compared.
    truth : Golden
        All arrays, by the conventions that the renderer follows.

    Returns
    -------
    list of Row
        In the order of :data:`STAGES`.

    Raises
    ------
    InputError
        If an array has another shape than the truth's, or nothing was given.
    """
    given = renderer.arrays(truth)
    _check_shapes(renderer, given, truth)
    may_flip = doubts(truth)
    evidence = Evidence(given, truth, may_flip, renderer.dtype, renderer.is_staged)
    rows: list[Row] = []
    for stage, names in STAGES.items():
        if stage == "radii":
            row = _row_of_bounds(truth.name, stage, compare_bounds(given, truth))
        elif stage == "tile lists":
            row = _row_of_bounds(truth.name, stage, compare_lists(given, truth))
        else:
            row = _row_of_arrays(renderer, given, truth, stage, names, may_flip)
        first = next((r for r in rows if r.status == "diverges"), None)
        if row.status == "diverges" and first is not None:
            row = row._replace(note=", ".join(filter(None, [row.note, _relation(renderer, row, first)])))
        rows.append(row._replace(evidence=evidence))
    if all(row.status == "not given" for row in rows):
        raise InputError(f"{renderer.name} gives no array of scene {truth.name}: there is nothing to compare")
    return rows


def first_divergence(rows: Iterable[Row]) -> Row | None:
    """Return the row of the earliest stage that diverges, in the scene with the largest error; None if all agree."""
    diverging = [row for row in rows if row.status == "diverges"]
    order = list(STAGES)
    return min(diverging, key=lambda row: (order.index(row.stage), -excess(row)), default=None)


def excess(row: Row) -> float:
    """Return the largest error of a row in units of the allowed one; 0 where no numbers were compared."""
    return row.difference.excess if row.difference is not None else 0.0


def _relation(renderer: ComparedRenderer, row: Row, first: Row) -> str:
    """Describe how a difference is related to the first one; return nothing if neither can cause the other.

    It may follow from the first if it is computed from the wrong values; if the truth is the input of every stage, this
    is possible only in the view. Two results of one stage are wrong independently.
    """
    is_fed = renderer.is_staged and not any(SPECS[name].stage == "view" for name in row.arrays)
    if not is_fed and any(set(first.arrays) & _sources(name) for name in row.arrays):
        return f"may follow from {first.stage}"
    functions = [{ONE_FUNCTION.get(s, s) for s in (SPECS[name].stage for name in r.arrays)} for r in (row, first)]
    return f"of one stage with {first.stage}" if functions[0] & functions[1] else ""


def _sources(name: str) -> set[str]:
    """Return the names of all arrays from which one is computed, directly or indirectly."""
    found, new = set[str](), {name}
    while new:
        found |= new
        new = {source for known in new for source in _direct_sources(known)} - found
    return found - {name}


def _direct_sources(name: str) -> tuple[str, ...]:
    """Return the inputs of the function that computes an array; for the view, the results of its parts."""
    spec = SPECS[name]
    if spec.role in ("input", "cotangent"):
        return ()
    of_outputs = (*STAGE_INPUTS[spec.stage], *(_PARTS_OF_VIEW if spec.stage == "view" else ()))
    if spec.role == "output":
        return of_outputs
    of_gradients = _PARTS_OF_V_VIEW if spec.stage == "view" else ()
    return (*of_outputs, *names_of(spec.stage, "output"), *STAGE_COTANGENTS[spec.stage], *of_gradients)


_PARTS_OF_VIEW = (*names_of("composite", "output"), "accumulated_depth")
_PARTS_OF_V_VIEW = tuple(name for stage in ("composite", "project", "colors") for name in names_of(stage, "gradient"))


def _check_shapes(renderer: ComparedRenderer, given: Arrays, truth: Golden) -> None:
    free = ("gaussian_ids", "tile_offsets", "tile_size", "radii")  # checked where they are judged
    for name, array in given.items():
        expected = truth.arrays[name].shape
        if name not in free and array.shape != expected:
            raise InputError(
                f"{renderer.name}, scene {truth.name}: {name} has shape {list(array.shape)}, expected {list(expected)}"
            )
    n = len(truth.arrays["means"])
    if "radii" in given and given["radii"].shape not in ((n,), (n, 1), (n, 2)):
        shape = list(given["radii"].shape)
        raise InputError(f"{renderer.name}, scene {truth.name}: radii has shape {shape}, expected {[n, 2]} or {[n]}")
    if "tile_size" in given and (given["tile_size"].shape != (2,) or given["tile_size"].min() < 1):
        raise InputError(f"{renderer.name}, scene {truth.name}: tile_size must be width, height in pixels")


def _row_of_bounds(scene: str, stage: str, bounds: Bounds | None) -> Row:
    if bounds is None:
        return Row(scene, stage, "not given", None)
    if bounds.n_different == 0:
        return Row(scene, stage, "agrees", None, bounds)
    if bounds.changes_image:
        note = f"{bounds.note}; the image changes"
        return Row(scene, stage, "diverges", None, bounds, note=note, arrays=STAGES[stage])
    return Row(scene, stage, "harmless", None, bounds, note=f"{bounds.note}; same image")


def _row_of_arrays(
    renderer: ComparedRenderer,
    given: Arrays,
    truth: Golden,
    stage: str,
    names: tuple[str, ...],
    may_flip: Mapping[str, Bools],
) -> Row:
    found = [name for name in names if name in given]
    if not found:
        return Row(truth.name, stage, "not given", None)
    differences = {}
    compared = {name: comparable(name, given[name], truth) for name in found}
    for name, (a, b) in compared.items():
        if name in BY_ROW:
            rows = shown_rows(given, truth)
            a, b = a[rows], b[rows]
        tolerance = SPECS[name].tolerance.of(renderer.dtype or given[name].dtype)
        differences[name] = difference(a, b, tolerance, may_flip.get(name))
    worst = max(differences, key=lambda name: differences[name].excess)
    d = differences[worst]
    notes = [worst if len(names) > 1 and d.n_over else "", _shape_of_error(*compared[worst], d)]
    wrong = tuple(name for name, of_array in differences.items() if of_array.n_over)
    return Row(
        truth.name,
        stage,
        "diverges" if wrong else "agrees",
        d,
        n_candidates=int(may_flip[names[0]].sum()) if stage in FLIPPING else 0,
        note=", ".join(filter(None, notes)),
        arrays=wrong,
    )


def _shape_of_error(given: np.ndarray, expected: np.ndarray, d: Difference) -> str:
    """Describe an error: its column, if it is in one only, and its factor, if that is constant."""
    if d.n_over == 0 or not np.isfinite(given).all():
        return "" if d.n_over == 0 else "not finite"
    given, expected = np.asarray(given, np.float64), np.asarray(expected, np.float64)
    words = ""
    if expected.ndim == 2 and expected.shape[1] <= 4:
        is_off = (np.abs(given - expected) > d.tolerance * d.scale).any(axis=0)
        if is_off.sum() == 1:
            column = int(np.flatnonzero(is_off)[0])
            words, given, expected = f"only [:, {column}]", given[:, column], expected[:, column]
    factor = float(np.vdot(given, expected) / np.vdot(expected, expected)) if expected.any() else 1.0
    is_factor = np.abs(given - factor * expected).max() <= d.tolerance * d.scale and abs(factor - 1) > d.tolerance
    return " ".join(filter(None, [words, f"times {factor:.4g}" if is_factor else ""]))


def as_report(renderer: ComparedRenderer, rows: list[Row], settings: Mapping[str, Any]) -> Report:
    """Return one case for each stage that was given, with the scene of the largest error."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    first = first_divergence(rows)
    given = [stage for stage in STAGES if any(r.stage == stage and r.status != "not given" for r in rows)]
    unknown = "" if first is None else _describe_unknown(renderer, first, given)
    verdict = (
        f"all {len(given)} stages that it gives agree"
        if first is None
        else f"the first stage that diverges is {first.stage}, in scene {first.scene}{unknown}"
    )
    where = f"scene {scenes[0]}" if len(scenes) == 1 else f"{len(scenes)} scenes"
    cases = [_case([row for row in rows if row.stage == stage], first) for stage in given]
    details = [{"scene": row.scene, "stage": row.stage, "result": row.status, **_figures([row])} for row in rows]
    return Report(
        title=f"{renderer.name} against the reference, {where}: {verdict}",
        cases=tuple(cases),
        settings={
            **settings,
            "renderer": renderer.name,
            "fed_with_truth": renderer.is_staged,
            "not_given": [stage for stage in STAGES if stage not in given],
            "looks_like": slight(rows) or hints_of(rows)[1],
            "first_divergence": None if first is None else {"stage": first.stage, "scene": first.scene},
            "scenes": [{k: _finite(v) for k, v in detail.items()} for detail in details],
        },
    )


def hints_of(rows: Iterable[Row]) -> tuple[list[Hint], list[str]]:
    """Return the planted faults that look like what differs, the likeliest first, and lines that say so.

    Both are empty where nothing differs, or nothing that a fault could change.
    """
    rows = list(rows)
    first = first_divergence(rows)
    if first is None:
        return [], []
    scenes = {row.scene: Scene(row.evidence, frozenset()) for row in rows if row.evidence is not None}
    for row in rows:
        if row.scene in scenes and row.status == "diverges":
            scenes[row.scene] = scenes[row.scene]._replace(wrong=scenes[row.scene].wrong | set(row.arrays))
    compared = list(scenes.values())
    if not any(SPECS[name].stage not in NOT_OF_FAULTS for scene in compared for name in scene.wrong):
        return [], []
    hints, telling = find_hints(compared, list(scenes).index(_choose_scene(rows, first, scenes)))
    return hints, in_words(compared, hints, telling)


def _choose_scene(rows: Iterable[Row], first: Row, scenes: Mapping[str, Scene]) -> str:
    """Return the smallest scene that shows the first difference about as clearly as the one where it is largest."""
    same = [row for row in rows if row.stage == first.stage and row.status == "diverges"]
    clear = [row.scene for row in same if excess(row) >= CLEAR * excess(first)]

    def work(name: str) -> int:
        arrays = scenes[name].evidence.truth.arrays
        return len(arrays["means"]) * int(np.prod(arrays["image_size"]))

    return min(clear, key=work)


def slight(rows: Iterable[Row]) -> list[str]:
    """Return a note if the differences are those of rounding: a few values, little above the tolerance.

    An error in a formula is wrong in most values; a fault like it would be looked for in noise.
    """
    wrong = [row for row in rows if row.status == "diverges"]
    found = [row.difference for row in wrong if row.difference is not None]
    if not found or len(found) < len(wrong):
        return []
    n_over, n, most = sum(d.n_over for d in found), sum(d.n for d in found), max(d.excess for d in found)
    if most > SLIGHT or n_over > FEW * n:
        return []
    return [
        f"{n_over} of {n:,} values are off, by up to {most:.1f} times what is allowed: a loss of precision rather than"
        " a wrong formula, which is wrong in most values"
    ]


def _describe_unknown(renderer: ComparedRenderer, first: Row, given: Iterable[str]) -> str:
    """Name the stages before the first one that are not given: the error may be in one of them."""
    if renderer.is_staged:
        return ""
    sources = {source for array in first.arrays or STAGES[first.stage] for source in _sources(array)}
    unknown = [s for s, arrays in STAGES.items() if s not in given and s != first.stage and sources & set(arrays)]
    return f"; or the error is in {', '.join(unknown)}, which it does not give" if unknown else ""


def _case(rows: list[Row], first: Row | None) -> Case:
    """One stage over all scenes."""
    order: tuple[Status, ...] = ("diverges", "harmless", "agrees", "not given")
    worst = min(rows, key=lambda row: (order.index(row.status), -excess(row)))
    is_first = first is not None and worst.stage == first.stage
    where = f"{worst.scene}: " if len(rows) > 1 and worst.status in ("diverges", "harmless") else ""
    return Case(
        name=worst.stage,
        passed=worst.status != "diverges",
        figures={"result": "DIVERGES FIRST" if is_first else worst.status, **_figures(rows)},
        note=f"{where}{worst.note}".removesuffix(": ") if worst.note or where else "",
    )


def _figures(rows: list[Row]) -> dict[str, Figure]:
    """Largest errors and summed counts of a stage."""
    figures: dict[str, Figure] = {}
    differences = [row.difference for row in rows if row.difference is not None]
    bounds = [row.bounds for row in rows if row.bounds is not None]
    if differences:
        worst = max(differences, key=lambda d: d.excess)
        figures = {
            "max error": worst.max_error,
            "RMS": worst.rms_error,
            "relative": worst.relative,
            "allowed": worst.tolerance,
            "over": sum(d.n_over for d in differences),
            "of": sum(d.n for d in differences),
        }
    if bounds:
        figures = {"over": sum(b.n_different for b in bounds), "of": sum(b.n for b in bounds)}
    if any(row.stage in FLIPPING for row in rows) and differences:
        figures["flips"] = sum(d.n_flips for d in differences)
        figures["candidates"] = sum(row.n_candidates for row in rows)
    return figures


def _finite(value: Any) -> Any:
    return str(value) if isinstance(value, float) and not np.isfinite(value) else value
