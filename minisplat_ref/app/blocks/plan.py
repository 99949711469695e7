"""The plan of a training in blocks: the settings, the blocks, and their trainings; and its files in the folder.

::

    DIR/plan.json            the grid; once it is planned, the blocks
    DIR/plan.png             the plan seen from above
    DIR/blocks/config.json   the requested settings
    DIR/blocks/coarse/       run folder of the coarse model
    DIR/blocks/0-1.json      the part that block 0-1 trains on, and 0-1.npz
    DIR/blocks/0-1/          its run folder
    DIR/...                  an ordinary run folder, of the merged model
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.app.blocks.coverage import Coarse, cover
from minisplat_ref.app.blocks.grid import Block, divide, ground_plane
from minisplat_ref.app.listing_file import select
from minisplat_ref.app.runs import run_folder
from minisplat_ref.app.runs.continued_part import find_beginning
from minisplat_ref.app.runs.options import Settings
from minisplat_ref.app.runs.scene_part import Part, Plane, Region, box_from_json
from minisplat_ref.app.runs.scoring import choose_render_settings
from minisplat_ref.app.runs.settings import configure_recipe, load, load_model
from minisplat_ref.errors import InputError
from minisplat_ref.io.scene import Listing
from minisplat_ref.types import Floats, Scene

PLAN = "plan.json"
COARSE = "coarse"
COARSE_RECIPE = "3dgs-accel"  # every recipe can start from its Gaussians
COARSE_PART = 4  # a quarter of the iterations of a training of the whole
JOINT_PART = 5  # a fifth of them, the last, for the merged model, so that blocks fit together where they touch; ours
COARSE_ITERATIONS = 1000  # for recipes that decide their own length
CONTINUED = frozenset({"3dgs", COARSE_RECIPE})  # no step of theirs is for the scene as a whole
PIXEL_BYTES = 4  # of a photograph, three, and of its mask
TRAINED_COPIES = 4  # parameters, gradients, two moments
FRESH: dict[str, Any] = {"extension": None, "set": {}, "simplify": None, "scene_type": None}


class BlockTraining(NamedTuple):
    """The requested settings."""

    folder: Path
    settings: Settings
    """Of a training of the whole."""
    shape: tuple[int, int]
    """Slabs, and blocks of a slab."""

    @property
    def blocks_folder(self) -> Path:
        """The folder of the trainings."""
        return self.folder / run_folder.BLOCKS

    def run_folder_for(self, name: str) -> Path:
        """Return the run folder of a block, or of the coarse model."""
        return self.blocks_folder / name

    @property
    def is_continued(self) -> bool:
        """Whether the coarse training is the beginning of that of the whole, and each block continues it."""
        return self.settings.recipe in CONTINUED and self.settings.extension is None

    @property
    def coarse(self) -> Settings:
        """Settings of the coarse training."""
        whole = self.settings.iterations
        if self.is_continued:
            n = max(1, whole // COARSE_PART)
            return replace(self.settings, iterations=n, schedule_iterations=n, whole_iterations=whole)
        n = COARSE_ITERATIONS if configure_recipe(self.settings).cooling is not None else whole // COARSE_PART
        n = max(1, min(n, whole))
        return replace(self.settings, recipe=COARSE_RECIPE, iterations=n, schedule_iterations=n, **FRESH)

    @property
    def joint_iterations(self) -> int:
        """The last iterations of the whole, in which the merged model is trained, at the rates of the whole."""
        return self.settings.iterations // JOINT_PART if self.is_continued else 0


class Planned(NamedTuple):
    """A block in the plan."""

    block: Block
    n_photographs: int
    iterations: int
    """Of its schedule."""
    n_done: int
    """The part of these that the coarse training has done."""
    megabytes: int
    """Of its photographs with their masks, and of its first Gaussians while they are trained; the process itself, and
    Gaussians that are added, come on top."""


class Plan(NamedTuple):
    """All blocks."""

    plane: Plane
    blocks: tuple[Planned, ...]
    trained: float
    """As :attr:`~minisplat_ref.app.blocks.coverage.Coverage.trained`."""

    def make_settings(self, training: BlockTraining, planned: Planned) -> Settings:
        """Return the settings of the training of a block."""
        return replace(
            training.settings,
            iterations=planned.iterations,
            schedule_iterations=planned.iterations,
            whole_iterations=training.settings.iterations if training.is_continued else None,
            init=str(training.run_folder_for(COARSE).resolve()),
            block=str((training.blocks_folder / f"{planned.block.name}.json").resolve()),
        )


def create_folder(training: BlockTraining, config: dict[str, Any]) -> None:
    """Make the folder: ``plan.json`` without blocks, and the settings.

    Parameters
    ----------
    training : BlockTraining
    config : dict
        Of :func:`minisplat_ref.app.runs.settings.to_config`.
    """
    run_folder.create(training.blocks_folder)
    run_folder.write_json(training.blocks_folder / run_folder.CONFIG, config)
    run_folder.write_json(training.folder / PLAN, {"grid": list(training.shape)})


def load_block_training(folder: Path) -> BlockTraining:
    """Read the file of :func:`create_folder`.

    Raises
    ------
    InputError
        The folder holds no training in blocks, or one of another version.
    """
    shape = run_folder.read_json_object(folder / PLAN).get("grid")
    if not (isinstance(shape, list) and len(shape) == 2 and all(type(n) is int and n > 0 for n in shape)):
        raise InputError(f"{folder / PLAN} has no grid of two whole numbers: train again, into another folder")
    return BlockTraining(folder, load(folder / run_folder.BLOCKS), (shape[0], shape[1]))


def make_plan(training: BlockTraining, listing: Listing, scene: Scene, coarse: Coarse, centers: Floats) -> Plan:
    """Plan by the coarse model, and write the parts of all blocks.

    Parameters
    ----------
    training : BlockTraining
    listing : Listing
        Of the whole.
    scene : Scene
        Of the coarse training, in its frame.
    coarse : Coarse
        Its model.
    centers : ndarray of shape (V, 3)
        Of the training cameras, in the frame of the files.

    Raises
    ------
    InputError
        The cameras cannot be divided so, or a block has too few photographs.
    """
    plane = ground_plane(centers)
    blocks = divide(plane.coordinates(centers), training.shape)
    masks, trained = cover(coarse, scene, plane, blocks)
    for block, own in zip(blocks, masks, strict=True):
        extent = scene.extent * scene.frame.unit if training.is_continued else None
        part = Part(Region(plane, block.region), select(listing, own.keys()), own, extent)
        part.write(training.blocks_folder / f"{block.name}.json")
    n_views, cooling = len(scene.train_views), configure_recipe(training.settings).cooling
    whole = training.settings.iterations
    gaussians = coarse.model.gaussians
    places = plane.coordinates(coarse.means)  # [N, 2]
    planned = []
    for block, own in zip(blocks, masks, strict=True):
        n_iterations = whole
        if cooling is None:
            n_iterations = max(1, round((whole - training.joint_iterations) * len(own) / n_views))
        n_bytes = PIXEL_BYTES * sum(mask.size for mask in own.values())
        share = np.count_nonzero(block.region.contains(places)) / len(places)
        n_bytes += round(share * TRAINED_COPIES * sum(field.nbytes for field in gaussians))
        n_done = find_beginning(n_iterations, whole, training.coarse.iterations) if training.is_continued else 0
        planned.append(Planned(block, len(own), n_iterations, n_done, math.ceil(n_bytes / 1e6)))
    return Plan(plane, tuple(planned), trained)


def too_large(training: BlockTraining, plan: Plan, n_workers: int, free_bytes: float) -> str | None:
    """Return an error message if the largest blocks of all workers together exceed this machine's memory."""
    largest = sorted((planned.megabytes for planned in plan.blocks), reverse=True)[:n_workers]
    if 1e6 * sum(largest) <= free_bytes:
        return None
    a, b = training.shape
    finer = f"{2 * a}x{b}" if a <= b else f"{a}x{2 * b}"
    is_one = len(largest) == 1
    which = "the largest block takes" if is_one else f"the {len(largest)} largest blocks take"
    way_out = "begin again" if is_one else "give fewer --workers, or begin again"
    return (
        f"{which} {sum(largest) / 1e3:.1f} GB with photographs and first Gaussians, and {free_bytes / 1e9:.1f}"
        f" GB are free: photographs will be read again and again; {way_out} with a finer grid, such as --blocks {finer}"
    )


def save_plan(training: BlockTraining, plan: Plan) -> None:
    """Write ``plan.json``, after everything that it refers to."""
    run_folder.write_json(training.folder / PLAN, to_json(training, plan))


def load_coarse(training: BlockTraining, scene: Scene) -> Coarse:
    """Read the coarse model, and its renderer with the scene's background."""
    folder, settings = training.run_folder_for(COARSE), training.coarse
    model = load_model(folder, settings)
    return Coarse(model, choose_render_settings(settings, model, scene.background), scene.frame)


def to_json(training: BlockTraining, plan: Plan) -> dict[str, Any]:
    """Return the content of ``plan.json``."""
    return {
        "grid": list(training.shape),
        "origin": plan.plane.origin.tolist(),
        "axes": plan.plane.axes.tolist(),
        "coarse_iterations": training.coarse.iterations,
        "joint_iterations": training.joint_iterations,
        "iterations": count_iterations(training, plan),
        "trained_pixels": plan.trained,
        "blocks": [
            {
                "name": planned.block.name,
                "core": planned.block.core.to_json(),
                "region": planned.block.region.to_json(),
                "cameras": planned.block.n_cameras,
                "photographs": planned.n_photographs,
                "iterations": planned.iterations,
                "done_by_coarse": planned.n_done,
                "megabytes": planned.megabytes,
            }
            for planned in plan.blocks
        ],
    }


def load_plan(folder: Path) -> Plan | None:
    """Read the plan; None where there is none yet.

    Raises
    ------
    InputError
        The file is not one of this version.
    """
    content = run_folder.read_json_object(folder / PLAN)
    if "blocks" not in content:
        return None
    try:
        blocks = tuple(_planned(entry) for entry in content["blocks"])
        plane = Plane(np.array(content["origin"], float), np.array(content["axes"], float))
        return Plan(plane, blocks, float(content["trained_pixels"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder / PLAN} is not a plan of this version ({error}): train again, into another folder"
        ) from error


def _planned(entry: dict[str, Any]) -> Planned:
    core, region = box_from_json(entry["core"]), box_from_json(entry["region"])
    block = Block(str(entry["name"]), core, region, int(entry["cameras"]))
    numbers = (int(entry[key]) for key in ("photographs", "iterations", "done_by_coarse", "megabytes"))
    return Planned(block, *numbers)


def count_iterations(training: BlockTraining, plan: Plan) -> int:
    """Return the iterations of all trainings together."""
    of_blocks = sum(planned.iterations - planned.n_done for planned in plan.blocks)
    return training.coarse.iterations + of_blocks + training.joint_iterations


def describe(training: BlockTraining, plan: Plan) -> str:
    """Return the plan in a line."""
    numbers = [planned.n_photographs for planned in plan.blocks]
    n_iterations = count_iterations(training, plan)
    return (
        f"{len(numbers)} blocks of {_range(numbers)} photographs, {n_iterations:,} iterations in all;"
        f" {plan.trained:.0%} of the pixels are trained on; see {training.folder / run_folder.BLOCK_PLAN}"
    )


def _range(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low} to {high}"
