"""Levels of detail, as PlayCanvas streams them: ``lod-meta.json`` and the SOG files of its parts (splat-transform's).

Each level has half of the Gaussians of the one before, chosen by Mini-Splatting's blend weights: neighbours that matter
least are merged (:func:`.simplification.reduce`). A k-d tree of the finest level divides space into parts; a part has
one SOG at each level, of which a viewer shows a finer one the nearer it is. The loss of a level is measured on training
views, as it is decoded, against the run itself::

    {"version": 1, "lodLevels": L, "counts": [...], "filenames": ["0_0/meta.json", ...], "tree":
     {"bound": {"min": [...], "max": [...]}, "children": [...] or "lods": {"0": {"file": 0, "offset": 0, "count": N}}}}
"""

import json
import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref import __version__
from minisplat_ref.app.runs.conversion import VIEWS_MAX, check_population
from minisplat_ref.app.runs.opened_run import Run
from minisplat_ref.app.runs.settings import place_model, return_model
from minisplat_ref.app.runs.simplification import blend_weights, evaluate_views, reduce
from minisplat_ref.interface.progress import with_progress
from minisplat_ref.io.atomic import making_folder
from minisplat_ref.io.formats.sog import SOG
from minisplat_ref.io.other_places import SOG_LEVELS
from minisplat_ref.strategy.ops import concat, n_rows, take
from minisplat_ref.types import Bools, Floats, Gaussians, Model, some_of

N_LEVELS = 4  # ours, as are the next two
SMALLEST = 64  # Gaussians: a level of fewer shows nothing
PART = 131_072  # Gaussians of the finest level in a part, at most
REACH = 3.0  # standard deviations to which a Gaussian is seen


class Level(NamedTuple):
    """A level as it was written."""

    n_gaussians: int
    drop: float
    """dB of PSNR that it loses on the training views."""


class _Part(NamedTuple):
    """A node of the tree."""

    children: tuple["_Part", ...]
    rows: Sequence[Any]
    """For a leaf, the rows of each level; empty otherwise."""


def write_levels(run: Run, out: Path, part: int = PART) -> list[Level]:
    """Write the levels of a run into the folder of ``out``, which is made, complete or not at all.

    Parameters
    ----------
    run : Run
    out : Path
        The ``lod-meta.json`` to write.
    part : int
        Gaussians of the finest level in a part, at most.

    Returns
    -------
    list of Level
        The finest first.

    Raises
    ------
    InputError
        The population has not the six fields of 3DGS, or there is something in the folder.
    """
    check_population(run.model.gaussians, SOG, str(run.folder))
    importance = blend_weights(run)
    n = n_rows(run.model.gaussians)
    sizes = [n, *(n >> k for k in range(1, N_LEVELS) if n >> k >= SMALLEST)]
    populations = [_to_files(run, reduce(run, importance, size)) for size in sizes]
    tree = _divide(
        [population.means for population in populations], [np.ones(len(p.means), bool) for p in populations], part
    )
    filenames: list[str] = []
    decoded: list[list[Gaussians]] = [[] for _ in populations]
    with making_folder(out.absolute().parent) as folder:

        def write(node: _Part) -> dict[str, Any]:
            if node.children:
                children = [write(child) for child in node.children]
                return {"bound": _union([child["bound"] for child in children]), "children": children}
            lods: dict[str, dict[str, int]] = {}
            bounds = []
            for level, rows in enumerate(node.rows):
                chosen = take(populations[level], rows)
                if not len(chosen.means):
                    continue
                content = SOG.encode(chosen, SOG.default_level)
                name = f"{level}_{len(filenames)}"
                with zipfile.ZipFile(BytesIO(content)) as archive:
                    archive.extractall(folder / name)
                lods[str(level)] = {"file": len(filenames), "offset": 0, "count": len(chosen.means)}
                filenames.append(f"{name}/meta.json")
                bounds.append(_bound(chosen))
                decoded[level].append(SOG.decode(content, name))
            return {"bound": _union(bounds), "lods": lods}

        root = write(tree)
        counts = [sum(len(each.means) for each in level) for level in decoded]
        levels = [Level(count, drop) for count, drop in zip(counts, _measure(run, decoded), strict=True)]
        document = {
            "version": 1,
            "asset": {
                "generator": f"minisplat_ref {__version__}",
                "psnrLoss": [round(level.drop, 4) for level in levels],
            },
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "lodErrors": False,
            "filenames": filenames,
            "tree": root,
        }
        (folder / SOG_LEVELS).write_text(json.dumps(document), encoding="utf-8")
    return levels


def _to_files(run: Run, population: Gaussians) -> Gaussians:
    """Return a population in the frame of the scene's files."""
    found: Gaussians = return_model(Model(population), run.owner, run.scene.frame).gaussians
    return found


def _measure(run: Run, decoded: Sequence[Sequence[Gaussians]]) -> list[float]:
    """Return what each level loses on at most ``VIEWS_MAX`` training views, dB."""
    chosen = some_of(run.scene.train_views, VIEWS_MAX)

    def psnr(model: Model) -> float:
        return float(np.mean([view.psnr for view in evaluate_views(run, model, chosen)]))

    before = psnr(run.model)
    models = (
        place_model(run.model._replace(gaussians=concat(*parts)), run.owner, run.scene.frame) for parts in decoded
    )
    return [before - psnr(model) for model in with_progress(models, "measuring", "levels", total=len(decoded))]


def _divide(means: Sequence[Floats], inside: Sequence[Bools], part: int) -> _Part:
    """Return the tree: halves of the finest level along the longer axis, down to parts of at most ``part``."""
    finest = means[0][inside[0]]
    if len(finest) <= part:
        return _Part((), [np.flatnonzero(each) for each in inside])
    axis = int(np.ptp(finest, axis=0).argmax())
    middle = np.median(finest[:, axis])
    lower = [each & (places[:, axis] < middle) for places, each in zip(means, inside, strict=True)]
    if not lower[0].any():  # more in one place than a part holds
        return _Part((), [np.flatnonzero(each) for each in inside])
    upper = [each & ~below for each, below in zip(inside, lower, strict=True)]
    return _Part((_divide(means, lower, part), _divide(means, upper, part)), ())


def _bound(gaussians: Gaussians) -> dict[str, list[float]]:
    reach = REACH * np.exp(gaussians.log_scales.max(axis=1, keepdims=True).astype(np.float64))  # [N, 1]
    return {
        "min": (gaussians.means - reach).min(axis=0).tolist(),
        "max": (gaussians.means + reach).max(axis=0).tolist(),
    }


def _union(bounds: Sequence[dict[str, list[float]]]) -> dict[str, list[float]]:
    return {
        "min": np.min([bound["min"] for bound in bounds], axis=0).tolist(),
        "max": np.max([bound["max"] for bound in bounds], axis=0).tolist(),
    }
