"""Files and folders that are there complete or not at all; a disk that is full; what killed processes leave behind."""

import os
import resource
import subprocess
import sys

import pytest

from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import remove_parts, replacing, replacing_folder

LIMIT = 4096  # bytes a file may have


def test_a_limit_to_the_size_of_files_is_one_line(tmp_path):
    """The system's own refusal, not a mock's: a child that may not write more than LIMIT bytes to a file."""
    path = tmp_path / "file"
    path.write_text("old")
    code = f"""
import sys
from minisplat_ref.errors import InputError
from minisplat_ref.io.atomic import replacing
try:
    with replacing(sys.argv[1]) as temporary:
        temporary.write_bytes(bytes({2 * LIMIT}))
except InputError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT)),
    )
    assert done.stdout == f"{path} cannot be written (File too large): make room there or choose another place\n"
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_an_error_about_another_file_stays_what_it_is(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"), replacing(tmp_path / "file"):
        (tmp_path / "nowhere").read_text()


def test_a_folder_is_replaced_with_all_that_it_held(tmp_path):
    folder = tmp_path / "renders"
    for name in ("a", "b"):
        with replacing_folder(folder) as temporary:
            (temporary / name).write_text(name)
    assert [path.name for path in tmp_path.rglob("*")] == ["renders", "b"]


def test_a_folder_that_is_not_finished_leaves_the_old_one(tmp_path):
    folder = tmp_path / "renders"
    with replacing_folder(folder) as temporary:
        (temporary / "a").write_text("a")
    with pytest.raises(InputError), replacing_folder(folder) as temporary:
        (temporary / "b").write_text("b")
        raise InputError("something else")
    assert [path.name for path in tmp_path.rglob("*")] == ["renders", "a"]


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path):
    code = "import os, sys; from minisplat_ref.io.atomic import replacing, replacing_folder\n"
    for function, name in (("replacing", "a.json"), ("replacing_folder", "renders")):
        end = "temporary.write_text('half')" if function == "replacing" else "(temporary / 'x').write_text('half')"
        body = f"with {function}(sys.argv[1]) as temporary:\n    {end}\n    os.kill(os.getpid(), 9)"
        done = subprocess.run([sys.executable, "-c", code + body, str(tmp_path / name)], check=False)
        assert done.returncode == -9
    assert len(list(tmp_path.iterdir())) == 2
    for name in (".hidden", "a.1.part", ".a.part", "notes.txt"):
        (tmp_path / name).write_text("")
    remove_parts(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [".a.part", ".hidden", "a.1.part", "notes.txt"]
