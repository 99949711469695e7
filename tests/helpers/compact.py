"""What the tests of compact files share: Gaussians, files that lie, and a run whose Gaussians are converted."""

import json
import struct
import tracemalloc

import numpy as np
import pytest

from data_tools.fuzz.mutations import change_json
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.types import Gaussians
from scenes import make_gaussians

FEW_BYTES = 2_000_000  # that a refusal may take, whatever the file claims


def population(n=40, sh_degree=3, seed=0):
    """Random Gaussians in float32."""
    gaussians = make_gaussians(np.random.default_rng(seed), n, sh_degree=sh_degree)
    return Gaussians(*(field.astype(np.float32) for field in gaussians))


def rotation_error(quats, others):
    """Angles [N] between rotations, radians; lengths and signs of the quaternions do not matter."""
    a, b = (q / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (quats, others))
    distance = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return 4 * np.arcsin(distance / 2)  # a chord of the sphere of quaternions, whose angle is half the rotation's


def with_header(content, **changes):
    """A file of the container whose header says something else."""
    length = struct.unpack("<I", content[6:10])[0]
    text = json.dumps(json.loads(content[10 : 10 + length]) | changes).encode()
    return content[:6] + struct.pack("<I", len(text)) + text + content[10 + length :]


def refusal(format_, content):
    """The line in which a file is refused, which names it; hardly any memory is taken."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            format_.decode(content, "lie.bin")
        assert tracemalloc.get_traced_memory()[1] < FEW_BYTES
    finally:
        tracemalloc.stop()
    assert str(caught.value).startswith("lie.bin")
    return str(caught.value)


def check_damage(format_, content, rng, n_changes):
    """Changed bits are refused by a checksum or a check; what is not seen decodes to Gaussians all the same."""
    n_refused = 0
    for place in rng.integers(0, len(content), size=n_changes):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        try:
            back = format_.decode(bytes(damaged), "lie.bin")
        except InputError:
            n_refused += 1
        else:
            assert all(np.isfinite(field).all() for field in back)
    assert n_refused > 0.75 * n_changes


def check_headers(format_, content, rng, n_changes):
    """Headers that say something else, with right lengths: files are refused in one line, or are Gaussians."""
    length = struct.unpack("<I", content[6:10])[0]
    for _ in range(n_changes):
        text = change_json(content[10 : 10 + length], lambda n: int(rng.integers(n)))
        try:
            damaged = content[:6] + struct.pack("<I", len(text)) + text + content[10 + length :]
            format_.describe(damaged, "lie.bin")
            back = format_.decode(damaged, "lie.bin")
        except InputError:
            continue
        assert all(np.isfinite(field).all() for field in back)


def short_run(folder, recipe="3dgs-accel", *options):
    """Train on a scene ``nook`` in the folder for a few iterations; return the run, which is beside it."""
    scene = {"n_views": 6, "width": 32, "height": 24, "n_points": 60, "test_every": 4}
    write_scene(make_scene("room", supersampling=1, **scene), folder / "nook", scene)
    given = ["--recipe", recipe, "--iterations", "60", "--test-every", "4", *options]
    assert main(["train", str(folder / "nook"), *given, "--out", str(folder / "run")]) == 0
    return folder / "run"


def refused_line(capfd, folder, *arguments, main=main):
    """The line in which a command refuses its arguments; the folder stays as it is."""
    capfd.readouterr()
    before = sorted(folder.rglob("*"))
    assert main([str(argument) for argument in arguments]) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1, captured.err
    assert sorted(folder.rglob("*")) == before
    return captured.err
