"""Claims that are measured in tests: what one has written, and a small scene in a folder."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from data_tools.claims.__main__ import main as measure_claim
from data_tools.claims.kit.claim import FIGURE, RESULT
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.io.images import read_image

NOOK = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}


def measured(words: Sequence[str]) -> Any:
    """Measure the claim of a command line, and return the result that it has written."""
    assert measure_claim(words) == 0
    return json.loads((Path(words[words.index("--out") + 1]) / RESULT).read_text())


def read_result(folder: Path, *others: str) -> Any:
    """Return the result in a folder, which has nothing besides but a figure with something in it, and these others."""
    assert sorted(path.name for path in folder.iterdir()) == sorted([FIGURE, RESULT, *others])
    assert read_image(folder / FIGURE).std() > 1
    return json.loads((folder / RESULT).read_text())


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    """A room in six photographs."""
    folder = tmp_path_factory.mktemp("scenes") / "nook"
    write_scene(make_scene("room", supersampling=1, **NOOK), folder, NOOK)
    return folder
