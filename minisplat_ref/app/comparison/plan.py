"""The plan of a comparison, kept in ``plan.json``: the recipe, seed, folder and length of each training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.start import make_start
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import find_recipe
from minisplat_ref.io import list_scene
from minisplat_ref.io.frames import place_scene
from minisplat_ref.io.scene import build_reading, build_scene
from minisplat_ref.metrics.lpips import check_views, load_network
from minisplat_ref.training.schedule import describe
from minisplat_ref.types import Scene

PLAN = "plan.json"  # the state that `--resume` continues
PATHS = ("scene", "lpips_weights", "init")  # of a plan
POINTS_PER_RUN = 24  # of each curve: enough to see when a quality is reached, and where it falls again


RECIPE_OPTIONS = {"budget": "budget", "simplify": "choose", "scene_type": "metric"}
"""Options of ``train`` that not every recipe takes, and the setting of an event that each is."""


class Run(NamedTuple):
    """One training of the comparison."""

    recipe: str
    """Name of the recipe."""
    iterations: int
    """Its length; the recipe is scaled to it."""
    seed: int
    """Seed of all random draws."""
    eval_every: int
    """Iterations after which the test views are measured again."""
    folder: Path
    """The run folder."""
    options: dict[str, object]
    """Options of ``train`` that this recipe takes and not every one does, without those that are left to the recipe."""
    fold: int = 0
    """Number of the first photograph that is held out; above 0 only with folds."""


class Plan(NamedTuple):
    """A comparison, checked: every recipe with every seed and fold."""

    scene: Path
    """Folder or file of the scene, as it was given."""
    folder: Path
    """The output folder; empty or new."""
    recipes: tuple[str, ...]
    """Names; the others are compared with the first."""
    iterations: tuple[int, ...]
    """Length of the training, per recipe."""
    seeds: tuple[int, ...]
    """Seeds, the same for every recipe."""
    downscale: int
    """Factor by which the photographs are made smaller."""
    test_every: int
    """One view of this many is held out."""
    eval_every: int | None
    """Iterations after which the test views are measured again; None for POINTS_PER_RUN times in each run."""
    budget: int | None
    """Gaussians that the recipes with a simplification keep; None for their own choice."""
    simplify: str | None
    """The choice of Gaussians in recipes with a simplification; None for their own way."""
    scene_type: str | None
    """``indoor`` or ``outdoor``, for the recipes that weigh importance; None for their own choice."""
    lpips_weights: Path | None = None
    """File of the weights of LPIPS; None: it is not measured."""
    init: Path | None = None
    """PLY of the points, or folder of the run, that every training starts from; None for the scene's own points."""
    folds: int | None = None
    """Trainings of each recipe, ``test_every`` as well, which hold out each photograph once; None: one training."""

    @property
    def files(self) -> dict[str, str]:
        """Absolute paths of the files that options of ``train`` name, of those that are given."""
        given = {"lpips_weights": self.lpips_weights, "init": self.init}
        return {name: str(file.resolve()) for name, file in given.items() if file is not None}

    def list_runs(self, recipe: str) -> list[Run]:
        """Return the trainings of one recipe, in the order of the seeds."""
        return [run for run in self.runs if run.recipe == recipe]

    @property
    def runs(self) -> list[Run]:
        """All trainings in their order: recipes alternate, so that a machine that slows down does so for each."""
        return [
            Run(
                recipe,
                iterations,
                seed,
                self.eval_every or max(1, round(iterations / POINTS_PER_RUN)),
                self.folder / f"{recipe}{'' if self.folds is None else f'-fold{fold}'}-seed{seed}",
                self._list_options(recipe),
                fold,
            )
            for seed in self.seeds
            for fold in range(self.folds or 1)
            for recipe, iterations in zip(self.recipes, self.iterations, strict=True)
        ]

    def _list_options(self, recipe: str) -> dict[str, object]:
        return {name: value for name, value in self.options.items() if _takes(recipe, name)}

    @property
    def options(self) -> dict[str, object]:
        """Options of ``train`` that have been given and that not every recipe takes."""
        given = {name: getattr(self, name) for name in RECIPE_OPTIONS}
        return {name: value for name, value in given.items() if value is not None}


def check_free(folder: Path) -> None:
    """Refuse a folder for a new comparison that already holds something.

    Raises
    ------
    InputError
        As for :func:`run_folder.check_free`; for a comparison it explains how to continue it.
    """
    if (folder / PLAN).exists():
        raise InputError(
            f"{folder} already holds a comparison: give another --out, or continue it with compare --resume {folder}"
        )
    run_folder.check_free(folder)


def check(plan: Plan) -> Scene:
    """Refuse a plan that cannot be carried out, before anything is written; return the scene.

    Raises
    ------
    InputError
        A recipe is unknown or named twice, there is no length for each, no recipe takes an option, the scene cannot be
        loaded, has no test views or too few to train on, or fewer photographs than folds, or the weights of LPIPS or
        the points to start from are damaged.
    """
    for name, values in (("--recipes", plan.recipes), ("--seeds", plan.seeds)):
        _refuse_repetition(name, values)
    recipes = [find_recipe(name) for name in plan.recipes]
    if len(plan.iterations) != len(recipes):
        raise InputError(
            f"--iterations has {len(plan.iterations)} numbers for {len(recipes)} recipes: give one for all or one each"
        )
    for option in plan.options:
        if not any(_takes(recipe.name, option) for recipe in recipes):
            raise InputError(f"--{option.replace('_', '-')} means nothing to {', '.join(plan.recipes)}: leave it out")
    if plan.folds is not None:
        _check_folds(plan.scene, plan.folds)
    scene = load_fold(plan)  # the first fold leaves the fewest photographs to train on
    if not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to compare on: give --test-every above 0")
    if plan.lpips_weights is not None:
        measured = scene.test_views if plan.folds is None else (*scene.train_views, *scene.test_views)
        check_views(load_network(plan.lpips_weights), measured)
    for recipe in recipes:
        make_start(plan.init, scene, recipe, seed=0)
    return scene


def load_fold(plan: Plan, fold: int = 0) -> Scene:
    """Load the scene as the trainings of a fold have it: as photographed if all recipes render lenses."""
    listing = list_scene(plan.scene, plan.test_every, offset=fold)
    takes_optics = all(find_recipe(name).representation.takes_optics for name in plan.recipes)
    reading = build_reading(plan.downscale, None, False, listing.alpha_is_mask, takes_optics)
    return place_scene(build_scene(listing, reading))


def _check_folds(scene: Path, folds: int) -> None:
    last = list_scene(scene, folds, offset=folds - 1)
    if not last.test_photos:
        n = len(last.train_photos)
        raise InputError(f"{scene} has {n} photographs for {folds} folds: give --folds of at most {n}")


def _refuse_repetition(option: str, values: Sequence[object]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise InputError(f"{option} names {value} more than once: each has one folder")


def _takes(recipe: str, option: str) -> bool:
    return any(RECIPE_OPTIONS[option] in event["settings"] for event in describe(find_recipe(recipe))["events"])


def save_plan(plan: Plan) -> None:
    """Write ``plan.json``, from which :func:`load_plan` continues anywhere on the machine."""
    content = {**plan._asdict(), **plan.files, "scene": str(plan.scene.resolve())}
    del content["folder"]  # where the file is
    run_folder.write_json(plan.folder / PLAN, content)


def remove_if_unused(folder: Path) -> None:
    """Remove the folder of a comparison whose first training was refused: there is nothing to continue."""
    if [path.name for path in folder.iterdir()] == [PLAN]:
        (folder / PLAN).unlink()
        folder.rmdir()


def load_plan(folder: Path) -> Plan:
    """Read a file of :func:`save_plan`.

    Raises
    ------
    InputError
        There is no comparison in the folder, or one of another version.
    """
    path = folder / PLAN
    if not path.is_file():
        raise InputError(f"{folder} holds no comparison, {PLAN} is missing: give the --out folder of a comparison")
    content = run_folder.read_json_object(path)
    content = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
    try:
        paths: dict[str, Any] = {name: Path(content[name]) for name in PATHS if content.get(name) is not None}
        return Plan(**{**content, **paths, "folder": folder})
    except (KeyError, TypeError) as error:
        raise InputError(f"{path} is not the plan of a comparison of this version: {error}") from error
