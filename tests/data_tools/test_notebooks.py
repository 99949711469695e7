"""Notebooks: what is stored of them, and the script that stores and compares it. CI runs them, these tests do not."""

import ast
import base64
import io
import re
import sys
import threading
from types import SimpleNamespace

import jupytext
import nbformat
import numpy as np
import pytest
from PIL import Image

from data_tools import notebooks
from data_tools.notebooks import FOLDER, PNG_MAX, ROOT, comparable, differences, execute, main, strip_notebook

STORED = sorted(FOLDER.glob("*.ipynb"))


def png(values):
    file = io.BytesIO()
    Image.fromarray(np.asarray(values, np.uint8)).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def notebook_of(*outputs, tags=(), source="1"):
    cell = nbformat.v4.new_code_cell(source, metadata={"tags": list(tags)} if tags else {})
    cell.outputs = list(outputs)
    return nbformat.v4.new_notebook(cells=[cell])


def printed(text, name="stdout"):
    return nbformat.v4.new_output("stream", name=name, text=text)


def image(values):
    return nbformat.v4.new_output("display_data", {"image/png": png(values), "text/plain": "<Figure>"})


GREY = np.full((16, 24, 3), 100)


# What is stored


@pytest.mark.skipif((ROOT / "PKG-INFO").exists(), reason="a source distribution has no stored notebooks")
def test_every_notebook_is_here():
    assert [path.name[:2] for path in STORED] == [f"{number:02}" for number in range(26)]
    assert [path.stem for path in STORED] == sorted(path.stem for path in FOLDER.glob("[0-9]*.py"))


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_stored_notebook(path):
    stored = nbformat.read(path, as_version=4)
    text = jupytext.read(path.with_suffix(".py"))
    assert [cell.source for cell in stored.cells] == [cell.source for cell in text.cells]
    words = "\n".join(cell.source for cell in stored.cells if cell.cell_type == "markdown")
    assert words.count("\n## Play\n") == 1 and words.count("\n## Exercises\n") == 1
    assert words.count("<details>") == words.count("</details>") == 2
    assert stored.cells[-1].cell_type == "code" and "\nassert " in stored.cells[-1].source

    pngs = []
    for cell in stored.cells:
        for out in cell.get("outputs", []):
            shown = str({kind: content for kind, content in out.get("data", {}).items() if kind != "image/png"})
            assert not re.search(r"/(tmp|home|root|usr|work)/", out.get("text", "") + shown)
            assert out.output_type != "error" and out.get("name") != "stderr"
            if "image/png" in out.get("data", {}):
                pngs.append(base64.b64decode(out.data["image/png"]))
        assert cell.get("execution_count") is None and "execution" not in cell.metadata
    assert len(pngs) >= 4 and max(map(len, pngs)) <= PNG_MAX
    # An image comes first: before a formula, and before the table of files.
    first = next(k for k, cell in enumerate(stored.cells) if any("data" in out for out in cell.get("outputs", [])))
    assert "$$" not in "".join(cell.source for cell in stored.cells[:first])


@pytest.mark.parametrize("path", STORED, ids=lambda path: path.stem)
def test_notebook_imports_public_names_and_names_files_that_exist(path):
    source = path.with_suffix(".py").read_text()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom | ast.Import):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            assert not any(part.startswith("_") for name in names for part in name.split(".")), names
    for name in re.findall(r"`((?:minisplat_ref|tests)/[\w/.]*)`", source):
        assert (ROOT / name).exists(), name


# The script


def test_the_same_is_the_same():
    old, new = (notebook_of(printed("a 1.25\n"), image(GREY)) for _ in range(2))
    assert list(differences(old, new)) == []


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (printed("a 1.25\n"), printed("a 1.26\n"), "1.26"),
        (printed("a\n"), image(GREY), "an image"),
        (image(GREY), image(GREY + 3), "3.00 of 255"),
        (image(GREY), image(GREY[1:]), "24 x 15 pixels"),
    ],
)
def test_a_difference_is_named(old, new, what):
    [difference] = differences(notebook_of(old), notebook_of(new))
    assert difference.startswith("cell 0: ") and what in difference


def test_another_text_is_named():
    assert list(differences(notebook_of(), notebook_of(source="2"))) == ["the stored notebook has another text"]


def test_tags_leave_room():
    old, new = notebook_of(printed("x   9.5 dB\n"), tags=["rounding"]), notebook_of(printed("x  10.5 dB\n"))
    assert list(differences(old, new)) == []
    [difference] = differences(old, notebook_of(printed("y 10.5 dB\n")))
    assert "y # dB" in difference
    noisy = notebook_of(image(GREY), tags=["rounding"])
    assert list(differences(noisy, notebook_of(image(GREY + 92)))) == []  # 0.6 times the 155 to a white page is 93
    assert len(list(differences(noisy, notebook_of(image(GREY + 94))))) == 1
    white = GREY + 155
    line, moved = (np.where(np.arange(24)[:, None] == column, 0, white) for column in (11, 12))
    assert list(differences(notebook_of(image(line), tags=["rounding"]), notebook_of(image(moved)))) == []
    assert len(list(differences(notebook_of(image(line), tags=["rounding"]), notebook_of(image(white))))) == 1
    timed = notebook_of(printed("3 s\n"), tags=["clock"])
    assert list(differences(timed, notebook_of(printed("4 ms\n")))) == []
    assert len(list(differences(timed, notebook_of(image(GREY))))) == 1


def test_how_often_a_line_comes_is_rounding():
    assert comparable("event 1\nevent   22\nend\n", True) == comparable("event 7\nend\n", True)
    assert comparable("event 1\nend\n", True) != comparable("event 1\n", True)


def test_errors_of_rounding_are_left_out():
    assert comparable("error 3.1e-10, 0.0e+00\n", False) == comparable("error 2e-16, 4.4e-13\n", False)
    assert comparable("error 3.1e-04\n", False) != comparable("error 3.2e-04\n", False)


def test_what_changes_is_stripped():
    path = printed(f"{ROOT}/notebooks/x\n")
    result = nbformat.v4.new_output("execute_result", {"text/plain": "5"}, execution_count=7)
    notebook = notebook_of(path, printed("a warning", name="stderr"), result, image(GREY))
    notebook.cells[0].execution_count = 3
    notebook.cells[0].metadata["execution"] = {"iopub.execute_input": "2024-01-01T00:00:00"}
    notebook.metadata["language_info"] = {"version": "3.11"}
    [cell] = strip_notebook(notebook, "x").cells
    assert [out.get("text") for out in cell.outputs] == ["./notebooks/x\n", None, None]
    assert cell.execution_count is None and cell.outputs[1].execution_count is None
    assert "execution" not in cell.metadata and "language_info" not in notebook.metadata
    assert list(cell.outputs[2].data) == ["image/png"]


def test_sliders_are_not_stored():
    sliders = nbformat.v4.new_output("display_data", {notebooks.WIDGET: {"model_id": "1"}, "text/plain": "VBox()"})
    notebook = notebook_of(image(GREY), sliders)
    notebook.metadata["widgets"] = {"state": {}}
    [cell] = strip_notebook(notebook, "x").cells
    assert [list(out.data) for out in cell.outputs] == [["image/png"]] and "widgets" not in notebook.metadata


class Slider:
    """What a slider of ipywidgets does without a browser."""

    def __init__(self, *, value, min, max, **_):
        assert min <= value <= max
        self.value, self._observers = value, []

    def observe(self, function, names):
        assert names == "value"
        self._observers.append(function)

    def move(self, value):
        self.value = value
        for function in self._observers:
            function({"new": value})


@pytest.mark.parametrize("has_sliders", [True, False])
def test_a_slider_draws_the_picture_again_in_its_place(has_sliders, monkeypatch):
    """Without ipywidgets there is the picture alone."""
    pytest.importorskip("matplotlib").use("agg")
    monkeypatch.syspath_prepend(str(FOLDER))
    import matplotlib.pyplot as plt

    import figures

    shown, drawn, widgets = [], [], SimpleNamespace(FloatSlider=Slider, VBox=list)
    handle = SimpleNamespace(update=lambda figure: shown.append(("again", figure)))
    monkeypatch.setattr(figures, "display", lambda what, display_id=False: (shown.append(("new", what)), handle)[1])
    monkeypatch.setitem(sys.modules, "ipywidgets", widgets if has_sliders else None)

    def draw(blur, noise):
        drawn.append((blur, noise))
        return plt.figure()

    figures.with_sliders(draw, blur=(0.5, 0.0, 3.0), noise=(0.0, -1.0, 1.0))
    assert drawn == [(0.5, 0.0)] and plt.get_fignums() == []
    if has_sliders:
        shown[1][1][1].move(-0.25)
        assert drawn == [(0.5, 0.0), (0.5, -0.25)]
    assert [what for what, _ in shown] == (["new", "new", "again"] if has_sliders else ["new"])


def test_a_large_image_is_refused():
    noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3))
    with pytest.raises(notebooks.InputError, match=r"x, cell 0: its image has [\d,]+ bytes, more than 100,000"):
        strip_notebook(notebook_of(image(noise)), "x")


TEXT = """# %% [markdown]
# A notebook.

# %%
number = 6 * 7
print(number)

# %% [markdown]
# <details>
# <summary>Solution</summary>
#
# ```python
# assert number == SOLUTION
# ```
#
# </details>
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(notebooks, "FOLDER", tmp_path)
    (tmp_path / "00_small.py").write_text(TEXT.replace("SOLUTION", "42"))
    return tmp_path


def test_store_then_check_then_change(folder, capsys):
    assert main(["--check"]) == 1 and "00_small: nothing is stored" in capsys.readouterr().out
    assert main(["00"]) == 0 and (folder / "00_small.ipynb").exists()
    stored = nbformat.read(folder / "00_small.ipynb", as_version=4)
    assert len(stored.cells) == 3 and stored.cells[1].outputs[0].text == "42\n"  # the solution ran and is not stored
    assert main(["--check"]) == 0 and "00_small: as stored" in capsys.readouterr().out
    text = (folder / "00_small.ipynb").read_text()
    (folder / "00_small.ipynb").write_text(text.replace('"42\\n"', '"43\\n"'))
    assert main(["--check"]) == 1
    shown = capsys.readouterr().out
    assert "cell 1: text differs: - 43 + 42" in shown and shown.endswith("python -m data_tools.notebooks 00\n")


def test_several_run_at_once_and_are_named_in_order(folder, monkeypatch, capsys):
    (folder / "01_other.py").write_text("# %%\n1\n")
    first_ended, second_ended = threading.Event(), threading.Event()

    def check(text):
        if text.stem == "00_small":
            assert second_ended.wait(30), "the second one waits for the first"
            first_ended.set()
            return ""
        second_ended.set()
        return "text differs"

    monkeypatch.setattr(notebooks, "AT_ONCE", 2)
    monkeypatch.setattr(notebooks, "check", check)
    assert main(["--check"]) == 1 and first_ended.is_set()
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" (")[0] for line in lines[:2]] == ["00_small: as stored", "01_other: text differs"]
    assert lines[2].endswith("data_tools.notebooks 01")


def test_a_wrong_solution_is_named(folder):
    path = folder / "00_small.py"
    path.write_text(TEXT.replace("SOLUTION", "41"))
    with pytest.raises(notebooks.InputError, match=r"00_small.py, solution 1: AssertionError .*assert number == 41"):
        execute(path)


def test_a_cell_that_does_not_end_is_named(folder, monkeypatch):
    monkeypatch.setattr(notebooks, "SECONDS_MAX", 1)
    path = folder / "00_small.py"
    path.write_text("# %%\nimport time\n\ntime.sleep(60)\n")
    with pytest.raises(notebooks.InputError, match=r"00_small.py: a cell takes more than 1 s"):
        execute(path)


def test_an_unknown_name_is_answered_with_those_that_exist(folder, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["99"])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and "no notebook's name begins with '99'" in error and error.count("\n") == 1
