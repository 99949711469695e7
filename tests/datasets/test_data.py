"""Data by address: ``minisplat-ref data`` against a server of this process; no test needs a network."""

import hashlib
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import PurePosixPath

import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.datasets import catalogue, fetching
from minisplat_ref.datasets.catalogue import CATALOGUE, DataSet, File, scene_files
from minisplat_ref.datasets.fetching import fetch
from minisplat_ref.errors import InputError
from minisplat_ref.interface import progress

CONTENTS = {"LICENSE": b"free\n", "a/1.jpg": b"first" * 40_000, "a/2.jpg": b"second"}
NAMES = ("LICENSE", "photos/1.jpg", "photos/2.jpg")


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and notes what was asked for; where a file is missing the answer is 404."""

    asked: list[str]

    def log_message(self, *_):
        self.asked.append(self.path)


class Server(ThreadingHTTPServer):
    """Says nothing of a client that hangs up before the end of a file, as one does that has read too much."""

    def handle_error(self, *_):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A set of three files, whose address is a folder served here: the folder, and the paths that were asked for."""
    root = tmp_path / "served" / "owner" / "set" / "c0ffee"
    for name, content in CONTENTS.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    handler = type("Handler", (Quiet,), {"asked": []})
    with Server(("127.0.0.1", 0), partial(handler, directory=tmp_path / "served")) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.01,))
        thread.start()
        command = ("sfm", "{}/photos", "--out", "{}/scene")
        small = DataSet("three files", "owner/set", "c0ffee", "MIT", "LICENSE", command)
        monkeypatch.setitem(catalogue.CATALOGUE, "small", small)
        monkeypatch.setattr(catalogue, "HOST", f"http://127.0.0.1:{running.server_port}")
        package = tmp_path / "package"
        package.mkdir()
        lines = [f"{hashlib.sha256(c).hexdigest()} {len(c)} small {name}" for name, c in CONTENTS.items()]
        (package / "catalogue.sha256").write_text("\n".join(["# heading", *lines, "0 0 other a/3.jpg"]))
        monkeypatch.setattr(catalogue, "files", lambda _: package)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        yield root, handler.asked
        running.shutdown()
        thread.join()


def found(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(capsys, *arguments):
    assert main(["data", *map(str, arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("minisplat-ref: error: ") and captured.err.count("\n") == 1
    return captured.err


def test_a_set_is_fetched_with_its_licence_and_the_next_command_is_named(server, tmp_path, capsys):
    out = tmp_path / "my data"
    assert main(["data", "small", "--out", str(out)]) == 0
    assert found(out) == dict(zip(NAMES, CONTENTS.values(), strict=True))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: 3 files fetched; all 3 have the right hash"
    assert lines[1] == f"licence: MIT ({out / 'LICENSE'})"
    assert lines[2].endswith(f"sfm '{out}/photos' --out '{out}/scene'")


def test_what_is_there_is_not_fetched_again_and_the_rest_is(server, tmp_path, capsys):
    _, asked = server
    out = tmp_path / "out"
    main(["data", "small", "--out", str(out)])
    (out / "photos" / "2.jpg").unlink()
    (out / "scene").mkdir()  # made by sfm meanwhile
    asked.clear()
    capsys.readouterr()
    assert main(["data", "small", "--out", str(out)]) == 0
    assert asked == ["/owner/set/c0ffee/a/2.jpg"]
    assert "1 files fetched, 2 were there; all 3 have the right hash" in capsys.readouterr().out
    assert main(["data", "small", "--out", str(out)]) == 0
    assert len(asked) == 1


def test_an_altered_file_is_not_kept_and_those_before_it_are(server, tmp_path, capsys):
    root, _ = server
    (root / "a/2.jpg").write_bytes(b"sec0nd")
    line = refused(capsys, "small", "--out", tmp_path / "out")
    assert "2.jpg sent other bytes: its hash is not that of the catalogue" in line
    assert f"(2 of 3 files are in {tmp_path / 'out'}, and are kept)" in line
    assert sorted(found(tmp_path / "out")) == ["LICENSE", "photos/1.jpg"]


@pytest.mark.parametrize("content", [b"", b"seco", b"second and no end" * 100_000])
def test_a_file_of_another_size_is_not_kept(content, server, tmp_path, capsys):
    root, _ = server
    (root / "a/2.jpg").write_bytes(content)
    line = refused(capsys, "small", "--out", tmp_path / "out")
    assert f"sent {min(len(content), 7)} bytes, not 6" in line  # at most one byte too many is read
    assert not (tmp_path / "out/photos/2.jpg").exists()


def test_a_file_that_is_gone_is_named(server, tmp_path, capsys):
    root, _ = server
    (root / "LICENSE").unlink()
    line = refused(capsys, "small", "--out", tmp_path / "out")
    assert "/owner/set/c0ffee/LICENSE: the server answers 404" in line and "no such file any more" in line
    assert not (tmp_path / "out").exists()


def test_without_a_network_no_folder_is_made(server, tmp_path, capsys, monkeypatch):
    with ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as closed:
        port = closed.server_port
    monkeypatch.setattr(catalogue, "HOST", f"http://127.0.0.1:{port}")
    line = refused(capsys, "small", "--out", tmp_path / "out")
    assert "LICENSE cannot be reached" in line and "is there a network?" in line
    assert not (tmp_path / "out").exists()


def test_a_connection_that_ends_in_the_middle_is_no_file(tmp_path, server):
    class Short(Quiet):
        def log_message(self, *_):
            pass

        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Length", "10")
            self.end_headers()
            self.wfile.write(b"12345")

    with ThreadingHTTPServer(("127.0.0.1", 0), Short) as running:
        threading.Thread(target=running.serve_forever, args=(0.01,)).start()
        file = File(f"http://127.0.0.1:{running.server_port}/x", "x", 10, hashlib.sha256(b"1234567890").hexdigest())
        with pytest.raises(InputError, match="sent 5 bytes, not 10"):
            fetch([file], tmp_path / "out", "short")
        running.shutdown()
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_with_other_things_is_refused(server, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    assert "already there and not empty" in refused(capsys, "small", "--out", tmp_path / "out")
    assert sorted(found(tmp_path / "out")) == ["thesis.txt"]
    assert "already there and not empty" in refused(capsys, "small", "--out", tmp_path / "out" / "thesis.txt")


def test_a_photograph_that_was_edited_is_not_overwritten(server, tmp_path, capsys):
    out = tmp_path / "out"
    main(["data", "small", "--out", str(out)])
    capsys.readouterr()
    (out / "photos/2.jpg").write_bytes(b"edited")
    assert f"{out}/photos/2.jpg is another file than http" in refused(capsys, "small", "--out", out)
    assert (out / "photos/2.jpg").read_bytes() == b"edited"


def test_what_a_killed_process_has_left_goes(server, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / ".LICENSE.123.part").write_bytes(b"fr")
    assert main(["data", "small", "--out", str(out)]) == 0
    assert sorted(found(out)) == sorted(NAMES)


def test_a_folder_that_cannot_be_made_is_named(server, tmp_path, capsys):
    (tmp_path / "file").write_text("no folder")
    assert "file/out/LICENSE cannot be written" in refused(capsys, "small", "--out", tmp_path / "file" / "out")


def test_an_unknown_name_says_what_was_meant(capsys):
    line = refused(capsys, "bananna")
    assert "there is no data set 'bananna'; did you mean banana?" in line
    assert "needs the NAME" in refused(capsys, "--out", "x")


def test_a_path_that_leaves_the_folder_does_not(server, tmp_path):
    path = tmp_path / "package" / "catalogue.sha256"
    path.write_text(f"# heading\n{hashlib.sha256(b'free').hexdigest()} 4 small ../../../etc/passwd\n")
    assert [file.path for file in scene_files("small")] == ["photos/passwd"]


def test_folders_of_a_set_are_kept_below_its_root_alone(server, tmp_path, monkeypatch):
    """``test/r_0.png`` is another file than ``train/r_0.png``; what lies beside the root has its name alone."""
    kept = catalogue.CATALOGUE["small"]._replace(folder="", root="data/set")
    monkeypatch.setitem(catalogue.CATALOGUE, "small", kept)
    names = (
        "LICENSE",
        "data/set/test/r_0.png",
        "data/set/train/r_0.png",
        "data/setting/x/r_1.png",
        "data/set/../../r_2",
    )
    lines = [f"{'0' * 64} 4 small {name}" for name in names]
    (tmp_path / "package" / "catalogue.sha256").write_text("\n".join(["# heading", *lines]))
    places = ["LICENSE", "test/r_0.png", "train/r_0.png", "r_1.png", "r_2"]
    assert [file.path for file in scene_files("small")] == places


def test_the_list_has_every_set_its_size_its_licence_and_its_place(capsys):
    assert main(["data"]) == 0
    printed = capsys.readouterr().out
    for name, data_set in CATALOGUE.items():
        assert f"{name} " in printed and f"licence: {data_set.licence}\n" in printed
        assert f"https://github.com/{data_set.repository}/tree/{data_set.commit[:7]}\n" in printed
    assert "fox             50 photographs of a fox before flowered wallpaper, 1080 x 1920, 18.3 MB" in printed


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_set_is_whole(name):
    """The licence comes first; hashes are of 64 digits, commits of 40, and no two files share a place."""
    data_set, listed = CATALOGUE[name], scene_files(name)
    assert listed[0].path == data_set.licence_file or not data_set.licence_file
    assert len(data_set.commit) == 40 and int(data_set.commit, 16)
    assert all(len(file.sha256) == 64 and int(file.sha256, 16) and file.n_bytes > 0 for file in listed)
    paths = [PurePosixPath(file.path) for file in listed]
    assert len(set(paths)) == len(paths) and not any(path.is_absolute() or ".." in path.parts for path in paths)
    n_photographs = sum(path.suffix.lower() in (".jpg", ".png") for path in paths)
    n_files = {"garden": 2, "lego": n_photographs + 2}.get(name, n_photographs + 1)
    assert len(listed) == n_files
    if n_photographs:
        assert data_set.what.startswith(f"{n_photographs} ")


def test_every_file_of_the_catalogue_belongs_to_a_set():
    lines = (files("minisplat_ref.datasets") / "catalogue.sha256").read_text().splitlines()[1:]
    assert {line.split(" ")[2] for line in lines} == set(CATALOGUE)


def test_the_file_that_is_here_has_the_hash_of_the_catalogue(shared_data):
    """gsplat's points are the one file that is measured as it is published."""
    content = (shared_data / "gsplat_garden" / "test_garden.npz").read_bytes()
    file = scene_files("garden")[1]
    assert (file.n_bytes, file.sha256) == (len(content), hashlib.sha256(content).hexdigest())


def test_a_log_gets_lines_while_a_set_is_fetched(server, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.0)
    monkeypatch.setattr(fetching, "CHUNK", 100_000)
    main(["data", "small", "--out", str(tmp_path / "out")])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("minisplat-ref: small: 0.0 of 0.2 MB, 00:00 gone")
    assert lines[1].startswith("minisplat-ref: small: 0.1 of 0.2 MB, 00:00 gone, about 00:00 to go")
    assert len(lines) == 4
