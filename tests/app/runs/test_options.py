"""The settings of a run: one declaration for the parser of ``train``, the defaults, ``config.json`` and its check."""

import argparse
import json
from dataclasses import asdict, dataclass, fields
from typing import Annotated

import pytest

from minisplat_ref.app.cli import build_parser, train
from minisplat_ref.app.runs.options import NAMES, NO_OPTION, OPTIONS, Option, Settings, list_options
from minisplat_ref.app.runs.settings import CHOICES, METRICS, load
from minisplat_ref.app.runs.trainings import spell_command
from minisplat_ref.errors import InputError
from minisplat_ref.rendering.backends import BACKENDS, CUDA, CUDA_ATOMIC

OF_ONE_CALL = {field.name for field in fields(train.TrainOptions)} - {"given", "server"}
GIVEN = {
    "downscale": "2",
    "test_every": "4",
    "undistort": None,
    "recipe": "mini-splatting2",
    "iterations": "70",
    "seed": "3",
    "profile": "inria",
    "backend": "cuda-atomic",
    "budget": "900",
    "simplify": "rank",
    "scene_type": "outdoor",
    "extension": "velocity",
    "set": "exposure=learned",
    "eval_every": "5",
    "drop_bad_steps": None,
    "lpips_weights": "/weights.npz",
    "minutes": "2.5",
    "max_drop": "0.5",
    "max_bytes": "1000",
    "init": "/points.ply",
    "model": "sparse/1",
    "background": "255,0,51",
    "block": "/blocks/0-0.json",
    "whole_iterations": "280",
    "fold": "2",
}
"""A word for each option that is not its default; None for an option without a value."""


def settings_from(words):
    return train.read_options(build_parser().parse_args(words)).new_settings()


def words_for(names):
    for name in names:
        yield "--" + name.replace("_", "-")
        if GIVEN[name] is not None:
            yield GIVEN[name]


@pytest.fixture
def folder(tmp_path):
    """The folder of a run of defaults, of which there is only its configuration."""
    write(tmp_path, asdict(settings_from(["train", "scene"])))
    return tmp_path


def write(folder, settings):
    (folder / "config.json").write_text(json.dumps({"settings": settings}))


def read(folder):
    return json.loads((folder / "config.json").read_text())["settings"]


def refusal(folder, **changes):
    write(folder, read(folder) | changes)
    with pytest.raises(InputError) as caught:
        load(folder)
    (line,) = str(caught.value).splitlines()
    return line


def test_parser_and_settings_have_the_same_names():
    (commands,) = (a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    dests = [action.dest for action in commands.choices["train"]._actions]
    assert set(dests) == {"help"} | OF_ONE_CALL | set(OPTIONS) and set(OPTIONS) == set(GIVEN)
    assert set(NAMES) - set(OPTIONS) == {"scene", "schedule_iterations"}


def test_what_is_not_given_has_the_default_of_the_declaration():
    args = vars(build_parser().parse_args(["train", "scene"]))
    assert not set(OPTIONS) & set(args)  # so that --resume can tell
    settings = settings_from(["train", "scene", "--iterations", "9"])
    assert settings == Settings(scene=settings.scene, iterations=9, schedule_iterations=9)


@pytest.mark.parametrize("name", OPTIONS)
def test_what_is_given_is_kept_and_read_again(name, tmp_path):
    """By the command line, by a file, and by the command that another process is given."""
    settings = settings_from(["train", "scene", *words_for([name])])
    assert getattr(settings, name) != getattr(settings_from(["train", "scene"]), name)
    write(tmp_path, asdict(settings))
    assert load(tmp_path) == settings
    assert settings_from(spell_command(settings, tmp_path)) == settings
    others = set(NAMES) - {name, "iterations", "schedule_iterations"}
    default = Settings(scene=settings.scene, iterations=1, schedule_iterations=1)
    assert all(getattr(settings, other) == getattr(default, other) for other in others)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scene", None),
        ("downscale", "2"),
        ("iterations", 2.5),
        ("schedule_iterations", None),
        ("undistort", 1),
        ("recipe", ["3dgs"]),
        ("recipe", None),
        ("profile", "ours"),
        ("backend", "metal"),
        ("budget", "900"),
        ("simplify", "chance"),
        ("simplify", 1),
        ("scene_type", "lunar"),
        ("extension", {}),
        ("set", []),
        ("set", {"exposure": True}),
        ("set", None),
        ("drop_bad_steps", None),
        ("minutes", "2"),
        ("max_drop", True),
        ("max_bytes", 0.5),
        ("init", 3),
        ("background", "white"),
        ("background", [1, 1]),
        ("background", [1, "white", 1]),
        ("background", {"red": 1}),
    ],
)
def test_a_value_that_no_training_has_is_refused(folder, name, value):
    load(folder)
    line = refusal(folder, **{name: value})
    assert f"{folder / 'config.json'}: the setting {name} is {value!r}" in line


def test_names_that_are_missing_or_unknown_are_refused(folder):
    assert "'blur' is no setting" in refusal(folder, blur=1)
    content = read(folder)
    content.pop("blur")
    del content["budget"]  # of runs of versions that did not have it
    write(folder, content)
    assert load(folder).budget is None
    del content["profile"]  # which all have
    write(folder, content)
    assert "it has no setting profile" in refusal(folder)


def test_choices_are_what_there_is():
    assert OPTIONS["simplify"].choices == tuple(CHOICES)
    assert OPTIONS["scene_type"].choices == tuple(METRICS)
    assert set(OPTIONS["backend"].choices) == {*BACKENDS, CUDA, CUDA_ATOMIC}


@pytest.mark.parametrize("kind", [int, Annotated[int, "blur"], Annotated[int, Option("")]])
def test_a_setting_cannot_be_added_without_help(kind):
    @dataclass(kw_only=True)
    class Declaration:
        follows: Annotated[int, NO_OPTION]
        sharpness: Annotated[int, Option("how sharp")] = 1
        blur: kind = 0

    with pytest.raises(TypeError, match="setting blur of Declaration needs an Option with help"):
        list_options(Declaration)
