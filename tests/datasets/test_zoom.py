"""Photographs without EXIF data that were zoomed: told apart by what their matches show, and only then."""

import math
import re

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.datasets.sfm import zoom
from minisplat_ref.datasets.sfm.photographs import Group
from minisplat_ref.datasets.sfm.zoom import describe_found, own_groups, separate, split_groups
from minisplat_ref.io import load_scene
from minisplat_ref.io.lens import import_pycolmap
from textured_world import WIDTH, take_photographs, write_photographs
from tolerances import SFM_FOCAL

UNKNOWN = Group(256, 192, "", None, None)


def names_of(groups):
    return [sorted(names) for names in groups]


# by hand


def test_two_focal_lengths_are_two_groups():
    focals = {"a": 1.3, "b": 1.8, "c": 1.31, "d": 1.79, "e": 1.295}
    assert separate(focals) == [["e", "a", "c"], ["d", "b"]]


def test_three_focal_lengths_are_three_groups():
    focals = {f"{i}{j}": f * (1 + 0.003 * j) for i, f in enumerate((1.1, 1.5, 2.0)) for j in range(2)}
    assert separate(focals) == [["00", "01"], ["10", "11"], ["20", "21"]]


def test_a_single_one_belongs_to_the_nearest():
    """ln(2.5 / 1.8) = 0.33 is less than ln(2.5 / 1.3) = 0.65; its group is still 4 spreads from the other one."""
    focals = {"a": 1.3, "b": 1.3, "c": 1.8, "d": 1.8, "e": 1.8, "f": 1.8, "g": 1.8, "h": 1.99}
    assert names_of(separate(focals)) == [["a", "b"], ["c", "d", "e", "f", "g", "h"]]


@pytest.mark.parametrize(
    "focals",
    [
        [1.3, 1.3, 1.42, 1.42],  # by 9 percent, as autofocus changes it
        [1.0, 1.12, 1.25, 1.4, 1.6, 1.8],  # each its own
        [1.3, 1.3, 1.3, 1.3, 2.6],  # one that is far off is no group
        [1.0, 1.07, 1.14, 1.21, 1.28, 1.42, 1.5, 1.6, 1.7],  # wide for their distance
    ],
)
def test_what_is_not_clear_is_one_group(focals):
    assert len(separate({str(i): f for i, f in enumerate(focals)})) == 1


def test_known_focal_lengths_are_left_as_they_are(monkeypatch):
    monkeypatch.setattr(zoom, "_parts", lambda *_: pytest.fail("looked at"))
    groups = {UNKNOWN._replace(focal=24.0): list("abcd"), UNKNOWN._replace(focal_35=35.0): list("efgh")}
    assert split_groups(object(), groups) == groups
    assert split_groups(None, {UNKNOWN: list("abcd")}) == {UNKNOWN: list("abcd")}
    assert own_groups(groups) == {} and own_groups({UNKNOWN: ["a", "b", "c"]}) == {}


def test_photographs_without_a_place_stay_with_the_first_group(monkeypatch):
    monkeypatch.setattr(zoom, "_parts", lambda *_: [{"b": 250.0, "d": 262.144}, {"a": 512.0, "e": 512.0}])
    groups = split_groups(object(), {UNKNOWN: list("abcde")})
    assert list(groups.values()) == [["b", "c", "d"], ["a", "e"]]
    assert [group.found for group in groups] == pytest.approx([1.0, 2.0])  # the geometric mean is 256, of 256 pixels
    assert describe_found(groups) == "1.00 times the width: b, c, d; 2.00 times the width: a, e"
    assert describe_found({UNKNOWN: ["a"]}) == ""


def test_own_groups_are_one_for_each():
    known = UNKNOWN._replace(focal=24.0)
    own = own_groups({known: ["x", "y"], UNKNOWN: list("abcd")})
    assert sorted(own.values()) == [["a"], ["b"], ["c"], ["d"], ["x", "y"]]


# end to end


def find_cameras(tmp_path, focals, seed):
    """The cameras of photographs with these focal lengths, in widths, of which no file says anything."""
    import_pycolmap()
    shots = take_photographs(np.random.default_rng(seed), tuple(f * WIDTH for f in focals))
    write_photographs(tmp_path / "photos", shots, (None,) * len(focals))
    scene = tmp_path / "scene"
    assert main(["sfm", str(tmp_path / "photos"), "--out", str(scene), "--features", "standard"]) == 0
    views = load_scene(scene, test_every=0).train_views
    assert len(views) == len(focals)
    return {view.name: view.camera.fx / WIDTH for view in views}


@pytest.mark.parametrize(
    ("kinds", "n", "seed"), [((1.3, 1.8), 12, 3), ((1.3, 1.5), 12, 5), ((0.9, 1.6), 12, 6), ((1.1, 1.5, 2.0), 12, 6)]
)
def test_a_zoom_without_exif_data(tmp_path, capsys, kinds, n, seed):
    """With one camera, 1.3 and 1.8 become 2.4, and no photograph of three focal lengths finds a place."""
    found = find_cameras(tmp_path, [kinds[i % len(kinds)] for i in range(n)], seed)
    for name, focal in found.items():
        assert focal == pytest.approx(kinds[int(name) % len(kinds)], rel=2 * SFM_FOCAL)
    printed = capsys.readouterr()
    assert "Warning" not in printed.err and "Global bundle" not in printed.err
    (line,) = [line for line in printed.out.splitlines() if line.startswith("the focal length is in no EXIF data")]
    for i in range(len(kinds)):
        names = ", ".join(f"{k:02}.jpg" for k in range(i, n, len(kinds)))
        assert f"times the width: {names}" in line


def test_two_of_twelve_are_enough(tmp_path, capsys):
    focals = [1.2, 1.2, 1.2, 1.2, 1.2, 1.9] * 2
    for name, focal in find_cameras(tmp_path, focals, 7).items():
        assert focal == pytest.approx(focals[int(name)], rel=2 * SFM_FOCAL)
    assert "05.jpg, 11.jpg" in capsys.readouterr().out


@pytest.mark.parametrize(("focal", "n", "seed"), [(1.3, 12, 3), (1.8, 12, 8), (1.1, 6, 10)])
def test_no_zoom_is_one_camera(tmp_path, capsys, focal, n, seed):
    found = find_cameras(tmp_path, [focal] * n, seed)
    assert len({round(f, 6) for f in found.values()}) == 1
    printed = capsys.readouterr()
    assert "no EXIF data" not in printed.out and "Warning" not in printed.err


def test_a_zoom_without_groups_is_said(tmp_path, capsys):
    find_cameras(tmp_path, np.geomspace(1.0, 2.1, 12).tolist(), 9)
    printed = capsys.readouterr()
    assert "no EXIF data" not in printed.out
    assert re.search(r"warning: .* focal lengths from \d+ \(00\.jpg\) to \d+ pixels \(11\.jpg\)", printed.err)


@pytest.mark.parametrize("name", ["banana", "brighton_beach", "fox"])
def test_real_photographs_of_one_zoom_are_one_group(shared_data, name, recwarn):
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction(shared_data / name / "sparse" / "0")
    names = sorted(image.name for image in model.images.values())
    size = next(iter(model.cameras.values()))
    groups = split_groups(model, {Group(size.width, size.height, "", None, None): names})
    assert len(groups) == 1 and not recwarn.list


def test_the_error_decides(tmp_path, monkeypatch):
    """Groups that explain the points no better than one camera are none."""
    monkeypatch.setattr(zoom, "ERROR_MAX", 0.01)
    found = find_cameras(tmp_path, [1.3, 1.8] * 4, 11)
    assert len({round(f, 6) for f in found.values()}) == 1
    assert not math.isclose(next(iter(found.values())), 1.3, rel_tol=SFM_FOCAL)
