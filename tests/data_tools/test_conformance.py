"""Pictures of probes judged without a browser: what agrees, what turns red, and what the table says of it."""

import json

import numpy as np
import pytest

from data_tools.conformance import __main__ as command
from data_tools.conformance.judging import (
    EMPTY,
    SQRT_8,
    VIEWER,
    Habits,
    Verdict,
    allowed,
    difference,
    image_of,
    judge,
    nearest_habits,
)
from data_tools.conformance.probes import HEIGHT, PROBES, WIDTH, golden_of, write
from data_tools.conformance.renderers import RENDERERS
from data_tools.conformance.report import Result, table
from minisplat_ref.app.cli import main as minisplat_ref
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.io.ply import load_ply
from minisplat_ref.oracle.faults import FAULTS

BY_NAME = {probe.name: probe for probe in PROBES}
CUT = Habits(VIEWER, SQRT_8)


def shown(name, habits=CUT, what="", where="projection", size=1.0):
    """What a viewer of 8 bits with a fault would show."""
    scene = golden_of(BY_NAME[name], habits.conventions)
    fault = next((f for f in FAULTS if f.what == what and f.where == where), None)
    image = image_of(scene, habits) if fault is None else image_of(scene, habits, fault, size)
    return np.rint(255 * np.clip(image, 0, 1)) / 255


@pytest.mark.parametrize("name", [probe.name for probe in PROBES])
def test_a_right_picture_agrees(name):
    verdict = judge(BY_NAME[name], shown(name), CUT)
    assert verdict.result == "agrees" and verdict.largest <= 0.5 and verdict.words == "agrees"


def test_levels_by_hand():
    picture, image = np.array([[[0.0, 0.5, 1.0]]]), np.array([[[0.1, 0.5, 1.4]]])
    assert difference(picture, image) == pytest.approx(25.5)  # 1.4 is shown as 1


def test_each_hit_may_be_rounded():
    """Half a level for the only Gaussian where it is, none where nothing is."""
    levels = allowed(golden_of(BY_NAME["centre"], VIEWER), Habits(VIEWER))
    assert levels[27, 41] == 2.0 and levels[0, 90] == 1.5


CASES = {
    "pixel centres at {} in place of 0.5, in x and y": ("centre", "projection", 0.0),
    "the low-pass at {} px^2 in place of 0.3": ("tiny", "projection", 0.0),
    "the conic's off-diagonal times {}": ("needle", "projection", -1.0),
    "harmonics above degree 0 missing": ("harmonics", "colours", 1.0),
    "the principal point taken in the image's middle": ("off-centre", "projection", 1.0),
}


@pytest.mark.parametrize("what", CASES)
def test_a_rule_is_named(what):
    name, where, size = CASES[what]
    verdict = judge(BY_NAME[name], shown(name, CUT, what, where, size), CUT)
    assert verdict.result == "rule" and verdict.largest > 2, verdict
    assert verdict.rule == what.format(f"{size:.3g}")


def test_a_wrong_camera_of_the_driver_turns_probes_red():
    """The camera moved by a tenth of a pixel's depth is no rule; the probe itself, moved, is none either."""
    moved = BY_NAME["turned"]._replace(cam_from_world=((0.98, 0.05, -0.1, 0.1), np.array([0.2, -0.1, 0.4])))
    picture = np.rint(255 * np.clip(image_of(golden_of(moved, VIEWER), CUT), 0, 1)) / 255
    assert judge(BY_NAME["turned"], picture, CUT).result != "agrees"
    smaller = BY_NAME["needle"].gaussians
    other = BY_NAME["needle"]._replace(gaussians=smaller._replace(log_scales=smaller.log_scales + np.float32(0.2)))
    picture = np.rint(255 * np.clip(image_of(golden_of(other, VIEWER), CUT), 0, 1)) / 255
    assert judge(BY_NAME["needle"], picture, CUT).result != "agrees"


def test_nothing_shown_is_said():
    picture = np.broadcast_to(np.array(BY_NAME["background"].background), (HEIGHT, WIDTH, 3))
    assert judge(BY_NAME["background"], picture, CUT).rule == EMPTY


@pytest.mark.parametrize("habits", [CUT, Habits(VIEWER, SQRT_8, True), Habits(GSPLAT_MAIN)], ids=lambda h: h.name)
def test_habits_are_found_by_their_pictures(habits):
    names = ("centre", "tiny", "needle", "tail", "border", "turned")
    found = nearest_habits({name: shown(name, habits) for name in names}, BY_NAME)
    assert (found.deviations, found.is_lowered) == (habits.deviations, habits.is_lowered)


def test_the_contract_is_a_file_that_our_renderer_reads(tmp_path, capsys):
    probe = BY_NAME["turned"]
    request = write(probe, tmp_path)
    assert json.loads((tmp_path / "turned.json").read_text()) == request
    assert np.array_equal(load_ply(tmp_path / "turned.ply").means, probe.gaussians.means)
    view = np.array(request["cam_from_world"])
    assert np.allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3)) and np.array_equal(view[3], [0, 0, 0, 1])
    assert minisplat_ref(["info", str(tmp_path / "turned.ply")]) == 0


def test_the_table_counts():
    figures = (9.0, 1.0, 0.5, 0.1)
    verdicts = {
        "centre": Verdict("centre", "agrees", "VIEWER", 0.5, 0.1, 0.5, 0.5),
        "tiny": Verdict("tiny", "rule", "no low-pass", *figures),
        "huge": Verdict("huge", "unexplained", "", *figures),
    }
    spark, absent = RENDERERS[0], next(renderer for renderer in RENDERERS if renderer.reason)
    text = table([Result(spark, CUT, verdicts), Result(absent, None, {}, absent.reason)])
    row = next(line for line in text.splitlines() if spark.what in line)
    assert [cell.strip() for cell in row.split("|")[3:7]] == [CUT.name, "1", "1", "1"]
    assert "no low-pass (9 levels)" in text and "unexplained (9 levels)" in text and absent.reason in text


def test_pictures_of_an_earlier_run_are_kept(tmp_path, monkeypatch):
    calls = []

    def render(probe):
        calls.append(probe.name)
        return shown(probe.name)

    mine = RENDERERS[0]._replace(name="mine", packages=(), driver="", render=render)
    pictures = command.take_pictures(mine, tmp_path, tmp_path / "cache")
    assert calls == list(BY_NAME) and np.array_equal(pictures["tiny"], shown("tiny"))
    assert command.take_pictures(mine, tmp_path, tmp_path / "cache").keys() == pictures.keys()
    assert len(calls) == len(BY_NAME)
