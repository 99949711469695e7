"""Pictures of probes judged without a browser: what agrees, what turns red, and what the table says of it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from data_tools.conformance import __main__ as command
from data_tools.conformance.habits import FORWARD, SQRT_8, VIEWER, Habits, image_of
from data_tools.conformance.judging import EMPTY, PLANTED, Verdict, allowed, difference, judge
from data_tools.conformance.probes import HEIGHT, PROBES, WIDTH, write
from data_tools.conformance.renderers import RENDERERS
from data_tools.conformance.report import Result, table
from data_tools.conformance.storing import COMPACT, PACKED, SPLAT, SPLAT_AND_HARMONICS
from minisplat_ref.app.cli import main as minisplat_ref
from minisplat_ref.io.ply import load_ply
from minisplat_ref.reference.covariance import covariances

BY_NAME = {probe.name: probe for probe in PROBES}
CUT = Habits(VIEWER, SQRT_8)


def shown(name, habits=CUT, what="", where="projection", size=1.0):
    """What a viewer of 8 bits with a fault would show."""
    probe = BY_NAME[name]
    fault = next((f for f in FORWARD if f.what == what and f.where == where), None)
    image = image_of(probe, habits) if fault is None else image_of(probe, habits, fault, size)
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
    levels = allowed(BY_NAME["centre"], Habits(VIEWER))
    assert levels[27, 41] == 2.0 and levels[0, 90] == 1.5


CASES = {
    "pixel centres at {} in place of 0.5, in x and y": ("centre", "projection", 0.0),
    "the low-pass at {} px^2 in place of 0.3": ("tiny", "projection", 0.1),
    "the conic's off-diagonal times {}": ("needle", "projection", -1.0),
    "no hit too weak: no least alpha": ("faint", "blending", 1.0),
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
    picture = np.rint(255 * np.clip(image_of(moved, CUT), 0, 1)) / 255
    assert judge(BY_NAME["turned"], picture, CUT).result != "agrees"
    smaller = BY_NAME["needle"].gaussians
    other = BY_NAME["needle"]._replace(gaussians=smaller._replace(log_scales=smaller.log_scales + np.float32(0.2)))
    picture = np.rint(255 * np.clip(image_of(other, CUT), 0, 1)) / 255
    assert judge(BY_NAME["needle"], picture, CUT).result != "agrees"


def test_nothing_shown_is_said():
    picture = np.broadcast_to(np.array(BY_NAME["background"].background), (HEIGHT, WIDTH, 3))
    assert judge(BY_NAME["background"], picture, CUT).rule == EMPTY


def test_a_small_difference_is_no_rule():
    """Four levels off in a corner, which faults hardly change: none explains it to the limit of 8 bits."""
    picture = shown("needle")
    picture[:8, :8] += 4 / 255
    verdict = judge(BY_NAME["needle"], picture, CUT)
    assert verdict.result == "unexplained" and 3 < verdict.largest < 5


@pytest.mark.parametrize(
    ("name", "habits", "seen"),
    [
        ("needle", CUT, ("camera", "probe")),
        ("crowd", CUT, ("camera", "probe")),
        ("huge", CUT, ("probe",)),  # the same all over
        ("disc", CUT._replace(axis_epsilon=0.0), ()),  # hidden
    ],
)
def test_what_agrees_could_have_failed(name, habits, seen):
    assert judge(BY_NAME[name], shown(name, habits), habits).seen == seen
    right = image_of(BY_NAME[name], habits)
    for planted, change in PLANTED.items():
        apart = difference(np.clip(image_of(change(BY_NAME[name]), habits), 0, 1), right).max()
        assert apart > 20 if planted in seen else apart < 1


def test_the_page_counts_what_its_rows_say():
    text = (Path(__file__).parents[2] / "docs" / "CONFORMANCE.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    agree = [row for row in rows if len(row) == 7 and row[1] == "agrees"]
    counts = [
        sum(row[6] in words for row in agree) for words in (("camera and probe",), ("camera", "probe"), ("neither",))
    ]
    assert sum(counts) == len(agree) > 100 and counts[0] > 0.8 * len(agree)
    said = re.search(
        r"of the (\d+) pictures that agree (\d+) would not .*?, (\d+) would not .*?\s(\d+) would agree", text, re.S
    )
    assert said is not None and [int(number) for number in said.groups()] == [len(agree), *counts]
    table = [row for row in rows if len(row) == 9 and row[4].isdigit()]
    assert sum(int(row[4]) for row in table) == len(agree)
    assert f"{len(table)} renderers" in text.replace("\n", " ")


RAN = [renderer for renderer in RENDERERS if renderer.habits is not None]
WRONG = {
    "the principal point": lambda probe: probe._replace(centre=(probe.centre[0] + 1, probe.centre[1])),
    "the view": lambda probe: probe._replace(cam_from_world=((1.0, 0, 0, 0.2), np.zeros(3))),
    "a scale": lambda probe: probe._replace(
        gaussians=probe.gaussians._replace(log_scales=probe.gaussians.log_scales + np.float32([0.2, 0, 0]))
    ),
}


@pytest.mark.parametrize("error", WRONG)
@pytest.mark.parametrize("renderer", RAN, ids=lambda renderer: renderer.name)
def test_a_planted_error_turns_a_probe_red(renderer, error):
    """By the rules of each renderer, an error of its driver's camera or of the probe is beyond what may differ."""
    if error == "the principal point" and not renderer.habits.conventions.uses_principal_point:
        pytest.skip("takes no principal point")
    probe = BY_NAME["needle"]
    off = difference(image_of(WRONG[error](probe), renderer.habits), image_of(probe, renderer.habits))
    assert (off > allowed(probe, renderer.habits) + 1).any()
    assert (difference(shown("needle", renderer.habits), image_of(probe, renderer.habits)) <= 0.51).all()


def test_an_eigenvalue_by_hand():
    """GaussianSplats3D: a covariance of diag(0.31, 0.31) has an eigenvalue of 0.31 - sqrt(0.1) < 0, and is hidden."""
    hidden = image_of(BY_NAME["tiny"], CUT._replace(least_root=0.1**0.5, axis_epsilon=0.0))
    assert hidden.max() == 0 < image_of(BY_NAME["tiny"], CUT).max()


def test_an_upright_disc_has_no_axis():
    """splat and gsplat.js: (b, l - a) is (0, 0) of a covariance diag(l, l)."""
    assert image_of(BY_NAME["disc"], CUT._replace(axis_epsilon=0.0)).max() == 0


def test_steps_of_stored_scales():
    """Spark's 254 steps from -12 to 9: a logarithm is moved by at most half of 0.0827."""
    g = BY_NAME["crowd"].gaussians
    moved = np.abs(PACKED.change(g).log_scales - g.log_scales)
    assert 0.03 < moved.max() <= 21 / 254 / 2 + 1e-6


@pytest.mark.parametrize("storage", [SPLAT, SPLAT_AND_HARMONICS, PACKED, COMPACT], ids=lambda s: s.words)
def test_what_is_stored_stays_near(storage):
    g = BY_NAME["crowd"].gaussians
    was, now = (
        covariances(np.asarray(x.quats, np.float64), np.exp(np.asarray(x.log_scales, np.float64)))
        for x in (g, storage.change(g))
    )
    apart = np.linalg.norm(now - was, axis=(1, 2)) / np.linalg.norm(was, axis=(1, 2))
    assert 0 < apart.max() < 0.12


def test_unsorted_gaussians_keep_the_order_of_the_file():
    first = image_of(BY_NAME["order"], CUT._replace(is_in_file_order=True))[31, 47]
    assert first[0] > 0.9 and first[1] < 0.2 < image_of(BY_NAME["order"], CUT)[31, 47, 1]


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
    text = table([Result(spark, verdicts), Result(absent, {}, absent.reason)])
    row = next(line for line in text.splitlines() if spark.what in line)
    assert [cell.strip() for cell in row.split("|")[5:9]] == ["1", "1", "1", "0"]
    assert "no low-pass (9 levels)" in text and "unexplained (9 levels)" in text and absent.reason in text


def test_pictures_of_an_earlier_run_are_kept(tmp_path, monkeypatch):
    calls = []

    def render(probe, _):
        calls.append(probe.name)
        return shown(probe.name)

    mine = RENDERERS[0]._replace(name="mine", packages=(), driver="", render=render)
    pictures = command.take_pictures(mine, tmp_path, tmp_path / "cache")
    assert calls == list(BY_NAME) and np.array_equal(pictures["tiny"], shown("tiny"))
    assert command.take_pictures(mine, tmp_path, tmp_path / "cache").keys() == pictures.keys()
    assert len(calls) == len(BY_NAME)
    changed = BY_NAME["tiny"]._replace(background=(0.0, 0.0, 1.0))
    monkeypatch.setattr(command, "PROBES", (changed, *(probe for probe in PROBES if probe.name != "tiny")))
    command.take_pictures(mine, tmp_path, tmp_path / "cache")
    assert len(calls) == len(BY_NAME) + 1 and calls[-1] == "tiny"  # a probe that changed is shown again
