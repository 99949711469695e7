"""Every command that a report, a message or the README's chain recommends is run, after a training by default.

One test follows the README from a scene on, the reports that its commands leave, and what the commands print. The
others run what is printed after an interruption. What needs the photographs of a user is left out, and each test says
which commands these are.
"""

import html
import re
import shlex
from pathlib import Path

import pytest

from minisplat_ref.app.cli import _find_parser, demo, main
from run_commands import interrupt_at, write_room

README = Path(__file__).parents[3] / "README.md"
SIZES = {"n_views": 14, "width": 96, "height": 72, "n_points": 120, "test_every": 8}  # README: --downscale 4
LIMIT = ("--iterations", "120")  # of the training, which would end by itself after some thousands
PROGRAM = re.compile(r"(?:\bminisplat-ref|-m minisplat_ref) +(?=[a-z])")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """An empty folder that the commands run in, with few iterations wherever a command has a default of hundreds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("minisplat_ref.app.cli.simplify.FINE_TUNE", 5)
    return tmp_path


@pytest.fixture(autouse=True)
def scene(elsewhere):
    write_room(elsewhere / "SCENE", **SIZES)
    return "SCENE"


def spell_command(line):
    """Return the arguments of a line that calls the program; None for another line."""
    call = PROGRAM.search(line)
    return None if call is None else shlex.split(line[call.end() :], comments=True)


def readme_chain():
    """Return the commands of the block about one's own photographs."""
    section = README.read_text(encoding="utf-8").partition("\n## Your own photographs\n")[2].partition("\n## ")[0]
    block = section.split("```")[1]
    return [words for line in block.splitlines() if (words := spell_command(line)) is not None]


def recommended_in(page):
    """Return the commands that a report shows."""
    blocks = re.findall(r"<pre[^>]*>(.*?)</pre>", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for block in blocks for line in html.unescape(block).splitlines()]
    return [words for line in lines if (words := spell_command(line)) is not None]


def printed_in(text):
    """Return the commands that messages name, to the end of the line or of the sentence's part."""
    lines = [line for line in text.splitlines() if "minisplat-ref: error" not in line]
    return [words for line in lines for part in re.split(r"[;`]", line) if (words := spell_command(part)) is not None]


def run_all(commands, capsys):
    """Run commands to exit code 0, then those that their messages name, and return all."""
    done = []
    waiting = [list(words) for words in commands]
    while waiting:
        words = waiting.pop(0)
        if words in done:
            continue
        capsys.readouterr()
        if words[0] == "view":  # serves until Ctrl-C
            assert _find_parser(words).parse_args(words).input.exists()
            continue
        assert main(words) == 0, f"minisplat-ref {' '.join(words)}: {capsys.readouterr().err}"
        done.append(words)
        said = capsys.readouterr()
        waiting += printed_in(said.out) + printed_in(said.err)
    return done


def test_the_chain_of_the_readme_and_what_its_reports_recommend(capsys):
    chain = readme_chain()
    assert [words[0] for words in chain] == ["sfm", "train", "render", "convert", "eval", "info", "simplify", "mesh"]
    (photographs, training, *rest), before = chain, set(Path().rglob("report.html"))
    assert photographs == ["sfm", "PHOTOS", "--out", "SCENE"], "finds the cameras: the scene is there already"
    assert "--recipe" not in training
    run_all([[*training, *LIMIT], *rest], capsys)

    pages = set(Path().rglob("report.html")) - before
    assert pages == {Path("runs/mine/report.html"), Path("runs/small/report.html")}
    for page in sorted(pages):
        commands = recommended_in(page)
        assert {"render", "convert"} <= {words[0] for words in commands}
        if page.parts[1] == "mine":
            assert [words[0] for words in commands][:2] == ["convert", "view"], "how to look at it comes first"
            assert commands.pop() == ["photos", "PHOTOS"], "on one's own photographs"
        run_all(commands, capsys)
    assert (Path("runs/mine-small") / "point_cloud.ply").exists(), "which the run's report recommends"
    assert Path("runs/mine.spz").exists() and Path("runs/small.spz").exists()


def test_what_the_demo_recommends(capsys, monkeypatch):
    """On a smaller scene, which the reference renders in time."""
    monkeypatch.setattr(demo, "SCENE", {**demo.SCENE, "width": 32, "height": 24, "n_points": 60, "n_views": 6})
    run_all([["demo", "--iterations", "5"]], capsys)
    page = Path(demo.DEFAULT_OUT) / "report.html"
    text = page.read_text(encoding="utf-8")
    assert text.index('href="scene.html"') < text.index("data:image/webp") < text.index("Held-out views")
    assert page.with_name("scene.html").exists()
    commands = recommended_in(page)
    own = [words for words in commands if "PHOTOS" in words]
    assert own == [["photos", "PHOTOS"]], "on one's own photographs"
    run_all([words for words in commands if words not in own], capsys)


def test_to_continue_a_training(scene, capsys, monkeypatch):
    with monkeypatch.context() as patched:
        interrupt_at(7, patched)
        assert main(["train", scene, "--downscale", "4", "--out", "run", "--iterations", "20"]) == 130
    (resume,) = printed_in(capsys.readouterr().err)
    assert resume == ["train", "--resume", "run"]
    run_all([resume], capsys)


def test_to_simplify_after_a_training(scene, capsys, monkeypatch):
    """After Ctrl-C while it simplifies, and where an earlier simplification is in its place."""

    def interrupted(*_):
        raise KeyboardInterrupt

    training = ["train", scene, "--downscale", "4", "--recipe", "3dgs-accel", "--max-drop", "0.1", "--out", "run"]
    with monkeypatch.context() as patched:
        patched.setattr("minisplat_ref.app.runs.simplified_run.decide", interrupted)
        assert main([*training, "--iterations", "20"]) == 130
    (simplify,) = printed_in(capsys.readouterr().err)
    assert simplify == ["simplify", "run", "--out", "run/simplified", "--max-drop", "0.1"]
    run_all([simplify], capsys)

    assert main(["train", "--resume", "run", "--iterations", "22"]) == 0
    said = capsys.readouterr()
    assert ["simplify", "run", "--out", "NEW", "--max-drop", "0.1"] in printed_in(said.err)
    run_all(printed_in(said.out + said.err), capsys)


def test_info_of_an_unfinished_run(scene, capsys, monkeypatch):
    with monkeypatch.context() as patched:
        interrupt_at(7, patched)
        assert main(["train", scene, "--downscale", "4", "--out", "run", "--iterations", "20"]) == 130
    capsys.readouterr()
    assert ["train", "--resume", "run"] in run_all([["info", "run"]], capsys)
