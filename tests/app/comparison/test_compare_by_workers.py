"""``compare --workers``: the same models as in turn, also after a worker is killed; what cannot work is one line."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("distributed")

from minisplat_ref.app.cli import main
from minisplat_ref.app.comparison import runs as runs_module
from minisplat_ref.app.runs import cluster
from run_commands import in_process, write_room

SCENE = {"n_views": 8, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
OPTIONS = ["--recipes", "3dgs-accel", "--seeds", "0,1", "--iterations", "6", "--test-every", "4", "--eval-every", "2"]
RUNS = ("3dgs-accel-seed0", "3dgs-accel-seed1")
MEASURED = ("psnr", "ssim", "n_gaussians")

pytestmark = pytest.mark.filterwarnings("default")  # Dask leaves sockets to the garbage collector


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("scenes") / "nook", **SCENE)


@pytest.fixture(scope="module")
def in_turn(scene_folder, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs_module, "train_here", in_process)
        return compare(scene_folder, tmp_path_factory.mktemp("turn") / "out", "--workers", "0")


def compare(scene_folder, out, *options):
    assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(out), *options]) == 0
    return out


def results(folder):
    """Everything that does not depend on the clock."""
    means = [
        {key: recipe["mean"][key] for key in MEASURED}
        for recipe in json.loads((folder / "compare.json").read_text())["recipes"]
    ]
    return means, [(folder / run / "point_cloud.ply").read_bytes() for run in RUNS]


@pytest.mark.parametrize("n", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_workers_give_the_same_bytes(scene_folder, in_turn, tmp_path, n):
    out = compare(scene_folder, tmp_path / "out", "--workers", str(n))
    assert results(out) == results(in_turn)
    assert not list(out.glob(f"{cluster.TOKEN}*"))


def test_a_scheduler_elsewhere_gives_the_same_bytes(scene_folder, in_turn, tmp_path):
    """Scheduler and worker are programs of their own, as on other machines."""
    contact, plain = tmp_path / "scheduler.json", ["--scheduler-file", str(tmp_path / "scheduler.json")]
    commands = (
        ["dask_scheduler", *plain, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        ["dask_worker", *plain, "--nthreads", "1", "--no-dashboard"],
    )
    programs = []
    try:
        for module, *words in commands:
            call = [sys.executable, "-m", f"distributed.cli.{module}", *words]
            programs.append(subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path))
            while not contact.exists():
                assert programs[0].poll() is None
                time.sleep(0.05)
        out = compare(scene_folder, tmp_path / "out", "--cluster", json.loads(contact.read_text())["address"])
    finally:
        for program in reversed(programs):
            program.terminate()
            program.wait()
    assert results(out) == results(in_turn)


def test_a_killed_worker_loses_nothing(scene_folder, in_turn, tmp_path, monkeypatch):
    killed = []
    check = cluster._check

    def kill_soon(client, site):
        check(client, site)

        def kill():
            while not any((tmp_path / "out" / run).exists() for run in RUNS):
                time.sleep(0.02)
            os.kill(next(iter(pids.values())), signal.SIGKILL)
            killed.append(True)

        pids = client.run(os.getpid)
        threading.Thread(target=kill, daemon=True).start()

    monkeypatch.setattr(cluster, "_check", kill_soon)
    out = compare(scene_folder, tmp_path / "out", "--workers", "1")
    assert killed and results(out) == results(in_turn)


def refused(scene_folder, out, capfd, *options):
    capfd.readouterr()
    assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(out), *options]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert not out.exists()
    return line


def test_no_scheduler_is_one_line(scene_folder, in_turn, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 0.5)
    line = refused(scene_folder, tmp_path / "out", capfd, "--cluster", "tcp://127.0.0.1:9")
    assert "no scheduler answers at tcp://127.0.0.1:9: start one" in line


@pytest.mark.parametrize(
    "address", ["localhost", "127.0.0.1", ":::", "foo://localhost:8786", "tcp://localhost", "http://x", "h:99999"]
)
def test_what_is_no_address_is_one_line(scene_folder, tmp_path, capfd, address, monkeypatch):
    """Dask's client is not asked: it would wait for twenty seconds at the end, and print "Exception ignored in"."""
    monkeypatch.setattr("distributed.Client", lambda *args, **options: pytest.fail("Dask's client was asked"))
    line = refused(scene_folder, tmp_path / "out", capfd, "--cluster", address)
    assert f"--cluster {address}: no address of a scheduler, which has a port: give one like tcp://localhost" in line
    assert capfd.readouterr().err == ""


def test_encryption_without_a_certificate_is_one_line(scene_folder, tmp_path, capfd):
    line = refused(scene_folder, tmp_path / "out", capfd, "--cluster", "tls://localhost:8786")
    assert "--cluster tls://localhost:8786: it is encrypted" in line and "distributed.comm.tls" in line


@pytest.mark.parametrize(
    "address", ["localhost:8786", "tcp://10.0.0.1:1", "[::1]:8786", "tcp://[fe80::1]:65535", "a-b.c:80"]
)
def test_addresses_with_a_port_are_tried(address):
    cluster._check_address(address)


def test_without_workers_it_waits_with_a_line_and_a_limit(scene_folder, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 1.0)
    from distributed import LocalCluster

    with LocalCluster(n_workers=0, dashboard_address=None) as empty:
        address = empty.scheduler_address
        assert main(["compare", str(scene_folder), *OPTIONS, "--out", str(tmp_path / "out"), "--cluster", address]) == 2
    waiting, refusal = [line for line in capfd.readouterr().err.splitlines() if line.startswith("minisplat-ref: ")]
    assert f"the scheduler at {address} has no workers yet: waiting for one, at most 1 seconds" in waiting
    assert f"the scheduler at {address} has no workers: start some with dask worker {address}" in refusal
    assert not (tmp_path / "out").exists()


def test_another_version_is_one_line(scene_folder, in_turn, tmp_path, capfd, monkeypatch):
    ours = cluster.versions() | {"minisplat_ref": "9.9"}
    call = cluster._check.__globals__["versions"]
    monkeypatch.setattr(cluster, "_check", lambda client, site: check_against(client, site, call, ours, monkeypatch))
    line = refused(scene_folder, tmp_path / "out", capfd, "--workers", "1")
    assert "has minisplat_ref" in line and "and not 9.9: install the same there" in line


def check_against(client, site, call, ours, monkeypatch):
    theirs = client.run(call)
    client.run = lambda function, *args, **named: theirs
    monkeypatch.setattr(cluster, "versions", lambda: ours)
    check(client, site)


check = cluster._check


def test_a_path_that_a_worker_does_not_see_is_one_line(tmp_path):
    site = cluster.Site(tmp_path, tmp_path, (tmp_path / "absent",))
    assert cluster.unseen(site) == str(tmp_path / "absent")
    assert "put it on storage that all workers share" in cluster.unseen_line("w", "p")
    assert cluster.unseen(site._replace(inputs=(Path("/"),))) is None
