"""A sheet of masses and springs: forces, exact falls, rest in closed form, the energy balance, and ``fall``."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.extensions.proxies import fall as fall_command
from minisplat_ref.extensions.proxies.binding import UNBOUND, bind, rebuild
from minisplat_ref.extensions.proxies.cage import grid
from minisplat_ref.extensions.proxies.fall import Setting, make_sheet
from minisplat_ref.extensions.proxies.mass_spring import (
    Floor,
    Sheet,
    State,
    Stiffness,
    choose_stiffness,
    connect,
    energies,
    find_springs,
    forces,
    integrate,
    longest_step,
    make_springs,
    vertex_masses,
)
from minisplat_ref.io.images import read_image
from minisplat_ref.io.ply import load_ply, save_ply
from minisplat_ref.mechanisms.meshes.mesh import Mesh, load_mesh, save_mesh
from scenes import as_dtype, make_gaussians
from tolerances import CLOSED_FORM, GRADIENT_REL, GRADIENT_STEP, SETTLED

G = np.array([0.0, 9.81, 0.0])


def flat_sheet(n=3, z=3.0):
    """Return a sheet of two by two units perpendicular to z."""
    return grid(np.array([-1.0, -1.0, z]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]), (n, n))


def noisy_sheet(rng, **changes):
    """Return a crumpled sheet with everything that a sheet may have, and its positions."""
    mesh = flat_sheet()
    setting = Setting(G, mesh.vertices[:, 1] < -0.9, 0.05, 0.7, 0.1)
    sheet = make_sheet(mesh, setting)._replace(**changes)
    return mesh, sheet, mesh.vertices + 0.3 * rng.normal(size=mesh.vertices.shape)


def hanging_chain(n, k, drag):
    """Return n equal masses of weight 1 below a pin, with a spring of length 1 between neighbours."""
    vertices = np.column_stack([np.zeros(n + 1), np.arange(n + 1.0), np.zeros(n + 1)])
    ends = np.column_stack([np.arange(n), np.arange(1, n + 1)])
    springs = connect(ends, vertices, np.full(n, k))
    return vertices, Sheet(np.full(n + 1, 1 / 9.81), springs, np.arange(n + 1) == 0, G, drag)


# Springs and masses


def test_the_springs_of_two_triangles_and_of_a_strip():
    """One cell has four sides, a diagonal, and the other diagonal; two cells also bend across their common edge."""
    edges, shear, bend = find_springs(grid(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), (1, 1)))
    assert edges.tolist() == [[0, 1], [0, 2], [0, 3], [1, 3], [2, 3]]
    assert [sorted(pair) for pair in shear.tolist()] == [[1, 2]] and len(bend) == 0
    edges, shear, bend = find_springs(grid(np.zeros(3), np.array([2.0, 0, 0]), np.array([0, 1.0, 0]), (2, 1)))
    assert len(edges) == 9 and sorted(sorted(pair) for pair in shear.tolist()) == [[1, 3], [2, 4]]
    assert [sorted(pair) for pair in bend.tolist()] == [[0, 5]]


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_numbers_of_springs_of_a_grid(n):
    edges, shear, bend = find_springs(flat_sheet(n))
    assert len(edges) == 2 * n * (n + 1) + n * n and len(shear) == n * n and len(bend) == 2 * n * (n - 1)


def test_an_edge_that_is_the_longest_of_one_triangle_only_is_bent():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.3, 0], [0.5, -5, 0]])
    _, shear, bend = find_springs(Mesh(vertices, np.array([[0, 1, 2], [1, 0, 3]])))
    assert len(shear) == 0 and sorted(bend[0].tolist()) == [2, 3]


def test_faces_that_share_an_edge_three_times_are_no_trouble():
    mesh = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]]), np.array([[0, 1, i] for i in (2, 3, 4)])
    )
    edges, shear, bend = find_springs(mesh)
    assert len(edges) == 7 and len(shear) + len(bend) == 1


def test_masses_are_the_area(rng):
    mesh = flat_sheet(4)
    masses = vertex_masses(Mesh(np.concatenate([mesh.vertices, [[9.0, 9, 9]]]), mesh.faces), 2.5)
    assert_allclose(masses[:-1].sum(), 2.5 * 4, rtol=CLOSED_FORM)
    assert masses[-1] > 0  # of a vertex without triangles


def test_the_stiffness_of_a_sheet_by_hand():
    """A cell of 2 x 1 has sides of 2, 2, 1 and 1 and a diagonal of sqrt(5): k = 2 (10 / 4) / (2 e^2 0.1)."""
    mesh = grid(np.array([5.0, -3, 7]), np.array([0.0, 2.0, 0]), np.array([0, 0, 1.0]), (1, 1))
    edge = (6 + np.sqrt(5)) / 5
    k = 25 / edge**2
    assert_allclose(choose_stiffness(mesh, 10.0, 0.1), [k, k, k / 100], rtol=CLOSED_FORM)


# Forces


def test_forces_are_minus_the_gradient_of_the_energies(rng):
    _, sheet, x = noisy_sheet(rng)

    def potential(positions):
        e = energies(State(positions, np.zeros_like(positions)), sheet)
        return e.elastic + e.floor + e.gravity

    found, numeric = forces(x, sheet), np.zeros_like(x)
    for index in np.ndindex(x.shape):
        moved = np.zeros_like(x)
        moved[index] = GRADIENT_STEP
        numeric[index] = -(potential(x + moved) - potential(x - moved)) / (2 * GRADIENT_STEP)
    e = energies(State(x, np.zeros_like(x)), sheet)
    assert e.elastic > 1 and e.floor > 0.1  # else there is nothing to check
    free = ~sheet.is_pinned
    assert np.abs(found - numeric)[free].max() <= GRADIENT_REL * np.abs(numeric).max()
    assert not found[~free].any()


def test_springs_exert_neither_a_net_force_nor_a_net_torque(rng):
    _, sheet, x = noisy_sheet(rng, gravity=np.zeros(3), floor=None)
    f = forces(x, sheet._replace(is_pinned=np.zeros(len(x), bool)))
    assert np.abs(f).max() > 1
    assert_allclose(f.sum(axis=0), 0, atol=CLOSED_FORM * np.abs(f).max())
    assert_allclose(np.cross(x, f).sum(axis=0), 0, atol=1e2 * CLOSED_FORM * np.abs(f).max())


def test_a_spring_of_no_length_has_no_force():
    springs = connect(np.array([[0, 1]]), np.array([[0.0, 0, 0], [1, 0, 0]]), np.ones(1))
    sheet = Sheet(np.ones(2), springs, np.zeros(2, bool), np.zeros(3))
    assert not forces(np.zeros((2, 3)), sheet).any()


# Motion in closed form


def test_free_fall_is_exact_and_carries_the_gaussians(rng):
    mesh = flat_sheet()
    sheet = make_sheet(mesh, Setting(G, np.zeros(len(mesh.vertices), bool), 0.01, 0.0, None))
    v = np.array([0.2, -1.0, 0.4])
    state = integrate(State(mesh.vertices, np.broadcast_to(v, mesh.vertices.shape)), sheet, 0.5 / 400, 400)
    way = 0.5 * v + 0.125 * G
    assert 0.5 / 400 < longest_step(sheet)
    assert_allclose(state.positions, mesh.vertices + way, atol=CLOSED_FORM)
    gaussians = make_gaussians(rng, 40)
    fallen = rebuild(Mesh(state.positions, mesh.faces), bind(gaussians, mesh))
    assert_allclose(fallen.means, gaussians.means + way, atol=10 * CLOSED_FORM)
    assert_allclose(fallen.log_scales, gaussians.log_scales, atol=10 * CLOSED_FORM)


def test_drag_alone_slows_down_exactly():
    sheet = hanging_chain(3, 1.0, 1.3)[1]._replace(gravity=np.zeros(3), is_pinned=np.zeros(4, bool))
    v = np.array([1.0, 2.0, 3.0])
    x = hanging_chain(3, 1.0, 1.3)[0]
    state = integrate(State(x, np.broadcast_to(v, x.shape)), sheet, 0.01, 50)
    assert_allclose(state.velocities, np.broadcast_to(v * np.exp(-1.3 * 0.5), x.shape), rtol=CLOSED_FORM)
    lost = (1 - np.exp(-1.3)) * sheet.masses.sum() * v @ v / 2
    assert_allclose(state.dissipated, lost, rtol=CLOSED_FORM)


def test_one_mass_on_a_spring_swings_at_its_frequency():
    """The frequency is Verlet's own: ``sin(w' h / 2) = w h / 2``."""
    k, h, n = 7.0, 0.05, 123
    vertices, sheet = hanging_chain(1, k, 0.0)
    sheet = sheet._replace(masses=np.ones(2), gravity=np.zeros(3))
    state = integrate(State(vertices + np.diag([0, 0.1, 0])[:2], np.zeros((2, 3))), sheet, h, n)
    w = 2 / h * np.arcsin(np.sqrt(k) * h / 2)
    assert_allclose(state.positions[1, 1] - 1, 0.1 * np.cos(w * h * n), atol=1e-12)


def test_a_chain_comes_to_rest_where_it_should():
    """Spring j of n carries the n - j masses below it, each of weight 1: it is longer by (n - j) / k."""
    n, k = 6, 40.0
    vertices, sheet = hanging_chain(n, k, 3.0)
    state = integrate(State(vertices, np.zeros_like(vertices)), sheet, 0.5 * longest_step(sheet), 4000)
    expected = np.concatenate([[0], np.cumsum(1 + (n - np.arange(n)) / k)])
    assert_allclose(state.positions[:, 1], expected, atol=SETTLED)
    assert not state.positions[0].any() and not state.velocities[0].any()


def test_a_sheet_lies_on_the_floor():
    mesh = grid(np.zeros(3), np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), (3, 3))
    sheet = make_sheet(mesh, Setting(G, np.zeros(16, bool), 0.01, 1.0, 0.2))
    state = integrate(State(mesh.vertices, np.zeros((16, 3))), sheet, 0.5 * longest_step(sheet), 4000)
    sunk = state.positions[:, 1] - 0.2
    assert_allclose(np.sum(sunk * sheet.floor.stiffness), sheet.masses.sum() * 9.81, rtol=1e-3)
    assert (sunk > 0).all() and sunk.max() < 0.05


# Energy and steps


def test_the_floor_slows_down_only_what_is_below_it():
    """For one unit of time: e^(-1/2) above the floor and upon it, e^(-5/2) below, where 2 is added to the drag."""
    vertices = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # gravity is along y
    springs = connect(np.array([[0, 1]]), vertices, np.zeros(1))
    masses, floor = np.array([1.0, 2.0, 4.0]), Floor(0.0, 0.0, 2.0)
    sheet = Sheet(masses, springs, np.array([False, True, False]), np.array([0.0, 1e-12, 0.0]), 0.5, floor)
    v = np.array([[3.0, 0, 0], [0, 0, 3.0], [3.0, 0, 0]])
    state = integrate(State(vertices, v), sheet, 0.1, 10)
    decays = np.exp([-0.5, -0.5, -2.5])
    assert_allclose(state.velocities, decays[:, None] * v, atol=1e-11)
    assert_allclose(state.dissipated, 4.5 * np.sum(masses * (1 - decays**2)), rtol=1e-11)


def test_without_drag_nothing_is_dissipated_and_with_it_everything_is(rng):
    vertices, sheet = hanging_chain(3, 40.0, 0.0)
    state = State(vertices, np.zeros_like(vertices))
    assert integrate(state, sheet, 0.01, 500).dissipated == 0
    damped = sheet._replace(drag=2.0)
    end = integrate(state, damped, 0.005, 8000)
    rest = energies(end, damped)
    assert rest.kinetic < 1e-12 and rest.dissipated > 0.1
    # A load that is let go stores half of what it gives: the other half is dissipated.
    assert_allclose(rest.dissipated, rest.elastic, rtol=1e-3)


def test_the_longest_step_is_that_of_stability(rng):
    """Just below it the sheet stays, and not far above it explodes."""
    mesh = flat_sheet()
    sheet = make_sheet(mesh, Setting(G, mesh.vertices[:, 1] < -0.9, 0.05, 0.0, None))
    start = State(mesh.vertices + 1e-3 * rng.normal(size=mesh.vertices.shape), np.zeros_like(mesh.vertices))
    with np.errstate(all="ignore"):
        sizes = [np.abs(integrate(start, sheet, f * longest_step(sheet), 300).velocities).max() for f in (0.99, 2.0)]
    assert sizes[0] < 20 and not sizes[1] < 1e3
    assert longest_step(sheet._replace(is_pinned=np.ones(16, bool))) == np.inf


def test_the_bound_of_the_step_holds_and_is_met(rng):
    """No eigenvalue of ``M^-1 K`` exceeds ``(2 / longest step)^2``; two equal masses on a spring reach it."""
    _, sheet, _ = noisy_sheet(rng, is_pinned=np.zeros(16, bool), floor=None, gravity=np.zeros(3))
    rest = flat_sheet().vertices
    columns = [forces(rest + move, sheet) - forces(rest - move, sheet) for move in 1e-6 * np.eye(48).reshape(48, 16, 3)]
    K = -np.reshape(columns, (48, 48)) / 2e-6
    largest = np.linalg.eigvals(K / np.repeat(sheet.masses, 3)).real.max()
    assert 0.3 < largest / (2 / longest_step(sheet)) ** 2 < 1
    _, pair = hanging_chain(1, 7.0, 0.0)
    pair = pair._replace(masses=np.ones(2), is_pinned=np.zeros(2, bool))
    assert_allclose((2 / longest_step(pair)) ** 2, 2 * 7.0, rtol=CLOSED_FORM)  # k over the reduced mass 1 / 2
    assert_allclose((2 / longest_step(pair._replace(floor=Floor(0.0, 3.0, 0.0)))) ** 2, 17.0, rtol=CLOSED_FORM)


def test_a_sheet_stretches_as_much_as_was_asked(rng):
    mesh = grid(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), (6, 6))
    masses = vertex_masses(mesh, 1.0)
    stiffness = choose_stiffness(mesh, float(masses.sum()) * 9.81, 0.02)
    sheet = Sheet(masses, make_springs(mesh, stiffness), mesh.vertices[:, 1] < 1e-9, G, 10.0)
    end = integrate(State(mesh.vertices, np.zeros_like(mesh.vertices)), sheet, 0.5 * longest_step(sheet), 3000)
    assert 0.005 < end.positions[:, 1].max() - 1 < 0.04  # "about": diagonals help, corners pull
    assert isinstance(stiffness, Stiffness) and stiffness.bend < stiffness.shear
    assert len(make_springs(mesh, stiffness._replace(bend=0.0)).stiffness) < len(sheet.springs.stiffness)


# The command


@pytest.fixture
def model(tmp_path, rng):
    save_ply(tmp_path / "model.ply", as_dtype(make_gaussians(rng, 60), np.float32))
    save_mesh(tmp_path / "mesh.ply", flat_sheet())
    return tmp_path / "model.ply"


def fall(model, *options):
    return main(["proxies", "fall", str(model), str(model.with_name("mesh.ply")), *map(str, options)])


def test_fall_from_the_command_line(model, tmp_path, capsys):
    out = tmp_path / "fallen"
    assert fall(model, "--out", out, "--frames", 3, "--seconds", 0.2, "--drag", 0, "--stretch", 0.1) == 0
    assert "60 Gaussians that fall" in capsys.readouterr().out
    names = ["energy.json", *(f"frame_00{i}.{kind}" for i in range(3) for kind in ("ply", "png")), "mesh.ply"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert (out / "frame_000.ply").read_bytes() == model.read_bytes()
    first, last = load_ply(model), load_ply(out / "frame_002.ply")
    assert_allclose(last.means, first.means + 0.02 * G, atol=1e-5)  # freely, in float32
    assert_allclose(load_mesh(out / "mesh.ply").vertices, flat_sheet().vertices + 0.02 * G, atol=CLOSED_FORM)
    images = [read_image(out / f"frame_00{i}.png").astype(int) for i in range(3)]
    assert images[0].max() > 50 and np.abs(images[0] - images[2]).max() > 20
    records = json.loads((out / "energy.json").read_text())["frames"]
    assert [round(record["time"], 9) for record in records] == [0, 0.1, 0.2]
    assert_allclose([record["total"] for record in records], records[0]["total"], atol=1e-9)


def test_what_is_pinned_stays(model, tmp_path, capsys):
    out = tmp_path / "fallen"
    options = ("--pin-top", 0.4, "--pin-box", -2, 0.9, 0, -0.9, 2, 9, "--floor", 0.5, "--reach", 0.5)
    assert fall(model, "--out", out, "--frames", 2, "--seconds", 0.3, *options) == 0
    before, after = flat_sheet().vertices, load_mesh(out / "mesh.ply").vertices
    is_pinned = (before[:, 1] < 0) | ((before[:, 0] < -0.9) & (before[:, 1] > 0.9))
    assert is_pinned.sum() == 9
    assert_array_equal((before == after).all(axis=1), is_pinned)
    first, last = load_ply(model), load_ply(out / "frame_001.ply")
    moved = (first.means != last.means).any(axis=1)
    binding = bind(first, flat_sheet(), 0.5)
    hangs = (binding.faces != UNBOUND) & ~is_pinned[binding.mesh.faces].all(axis=1)[binding.faces]
    assert_array_equal(moved, hangs)
    assert (
        f"{binding.n_bound} Gaussians that fall" in capsys.readouterr().out and 0 < hangs.sum() < binding.n_bound < 60
    )


def test_bad_input_of_fall_is_one_line_and_writes_nothing(model, tmp_path, capsys):
    save_mesh(tmp_path / "degenerate.ply", Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    before = sorted(tmp_path.iterdir())
    cases = {
        ("--frames", 1): "--frames is 1",
        ("--seconds", 0): "--seconds is 0",
        ("--gravity", 0, 0, 0): "nothing falls",
        ("--stretch", 0): "--stretch is 0",
        ("--drag", -1): "--drag is -1",
        ("--pin-box", 8, 8, 8, 9, 9, 9): "holds no vertex",
        ("--pin-top", 1): "every vertex of the mesh is held",
        ("--reach", 0): "is within 0 of the mesh",
        ("--cameras", tmp_path / "absent.json"): "absent.json",
    }
    for options, message in cases.items():
        assert fall(model, "--out", tmp_path / "out", *options) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1, (options, error)
        assert sorted(tmp_path.iterdir()) == before
    words = ["proxies", "fall", model, tmp_path / "degenerate.ply", "--out", tmp_path / "out"]
    assert main([str(word) for word in words]) == 2
    assert "triangle 0 has no area" in capsys.readouterr().err and sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("positions", [np.zeros((16, 3)), np.full((16, 3), np.nan)])
def test_a_sheet_that_collapses_or_explodes_leaves_nothing(positions, model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fall_command, "integrate", lambda *_: State(positions, np.zeros((16, 3))))
    assert fall(model, "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert "frame 1, folded flat" in error and error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.ply", "model.ply"]
