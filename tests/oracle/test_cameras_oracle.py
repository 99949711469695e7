"""The oracle for ``rasterization`` with other cameras: planted errors, hard cases, golden vectors, a function."""

import json

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_MAIN
from minisplat_ref.mechanisms.cameras.gsplat_call import STEPS
from minisplat_ref.mechanisms.cameras.oracle.call import CALL, STAGES
from minisplat_ref.mechanisms.cameras.oracle.hard_cases import CASES, run_cases, select
from minisplat_ref.mechanisms.cameras.oracle.planted import PLANTED, gsplat_1_5, has_all_points
from minisplat_ref.oracle import call_comparison
from minisplat_ref.oracle.call_comparison import choose_renderer, compare, truth
from minisplat_ref.types import Camera, Primitives

OF_CAMERAS = ["--call", "rasterization_cameras"]


@pytest.fixture(scope="module")
def known():
    return {scene.name: (scene, truth(CALL, scene)) for scene in CALL.scenes()}


@pytest.mark.parametrize("error", PLANTED)
def test_a_planted_error_is_named_at_its_stage(error, known):
    report = compare(CALL, choose_renderer(CALL, f"planted:{error}"), known)
    assert report.settings["first_difference"].partition(":")[0] == PLANTED[error].stage


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_kernels_agree_at_every_stage(dtype, known):
    report = compare(CALL, choose_renderer(CALL, "cpu", dtype), known)
    assert len(report.cases) == len(STAGES) and report.n_failed == 0, report.cases
    assert report.settings == {"first_difference": None, "not_given": []}


def test_the_scenes_hold_what_they_say(known):
    """Something is seen beyond 90 degrees, something is culled, and lenses and parallel rays cover their images."""
    scene, arrays = known["fisheye"]
    view = scene.arguments["viewmats"][0]
    z = scene.arguments["means"] @ view[2, :3] + view[2, 3]
    assert ((arrays["radii"][0, :, 0] > 0) & (z < 0)).sum() > 10
    for name, (_, of_scene) in known.items():
        assert (of_scene["radii"][..., 0] == 0).any(), name
        assert of_scene["render_alphas"].mean() > 0.1, name
        assert min(np.abs(of_scene[key]).max() for key in STAGES if key.startswith("v_")) > 1e-3, name


def test_hard_cases_have_the_answers_that_were_worked_out():
    report = run_cases()
    assert len(report.cases) == 3 * len(CASES) and report.n_failed == 0, report.cases


def test_a_wrong_answer_is_found():
    (case,) = select("beyond 90")
    wrong = case._replace(alphas={pixel: value + 1e-3 for pixel, value in case.alphas.items()})
    assert run_cases((wrong,)).n_failed == 3


def test_gsplat_1_5_drops_a_gaussian_with_a_sigma_point_outside_of_the_margin():
    """By hand: a camera of 100 x 80 px and focal length 100; the points are at +-sqrt(0.03) = 0.173 deviations."""
    camera = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 50.0, 40.0, 100, 80)
    means = [  # scales are 0.1, so points lie at 0.0173 from the mean: those nearer to the camera by 1.8 % further out
        (0.55, 0.0, 1.0),  # x = 105 px, and its points within 106.8: inside of the margin, which ends at 110
        (0.59, 0.0, 1.0),  # x = 109, and one of its points at 110.7
        (-0.59, 0.0, 1.0),  # x = -9, and one of its points at -10.7
        (0.0, 0.45, 1.0),  # y = 85, within 86.7: the margin ends at 88
        (0.0, 0.475, 1.0),  # y = 87.5, and one of its points at 89.2
        (0.0, 0.0, -1.0),  # behind
        (-0.53, 0.0, 1.0),  # x = -3: outside of the image, inside of the margin
    ]
    n = len(means)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    primitives = Primitives(np.array(means), quats, np.full((n, 3), 0.1), np.full(n, 0.5))
    assert has_all_points(primitives, camera).tolist() == [True, False, False, True, False, False, True]


def test_gsplat_1_5_draws_whole_tiles_within_the_bounds():
    """By hand: a dot of 1 px at (56, 40), with its bounds, lies in the tile from 48 to 64 and from 32 to 48."""
    camera = Camera(np.eye(3), np.zeros(3), 100.0, 100.0, 56.0, 40.0, 100, 80)
    dot = Primitives(np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0, 0, 0]]), np.full((1, 3), 0.01), np.full(1, 0.5))
    ours, theirs = STEPS.project(dot, camera, GSPLAT_MAIN), gsplat_1_5(STEPS).project(dot, camera, GSPLAT_MAIN)
    assert (ours.boxes[0, :2] > (48, 32)).all() and (ours.boxes[0, 2:] < (64, 48)).all()
    assert theirs.boxes.tolist() == [[48, 32, 64, 48]] and theirs.radii.tolist() == ours.radii.tolist()
    at_the_edge = dot._replace(means=np.array([[0.43, 0.0, 1.0]]))  # x = 99 px: the last tile ends at the image's edge
    assert gsplat_1_5(STEPS).project(at_the_edge, camera, GSPLAT_MAIN).boxes.tolist() == [[80, 32, 100, 48]]
    outside = dot._replace(means=np.array([[0.55, 0.0, 1.0]]))  # 111 px
    assert gsplat_1_5(STEPS).project(outside, camera, GSPLAT_MAIN).radii.tolist() == [[0, 0]]


def test_the_rules_of_gsplat_1_5_are_told_from_ours(known):
    """Its fisheye sees nothing behind the camera's plane and orders by z, and it draws whole tiles."""
    scene, ours = known["fisheye"]
    theirs = truth(CALL, scene, "GSPLAT_1_5")
    view = scene.arguments["viewmats"][0]
    z = scene.arguments["means"] @ view[2, :3] + view[2, 3]
    is_shown = theirs["radii"][0, :, 0] > 0
    assert is_shown.any() and not is_shown[z < 0].any() and (ours["radii"][0, z < 0, 0] > 0).any()
    np.testing.assert_allclose(theirs["depths"][0][is_shown], z[is_shown], rtol=1e-12)
    renderer = choose_renderer(CALL, "cpu", "float64")
    assert compare(CALL, renderer, {"fisheye": (scene, theirs)}).settings["first_difference"] == "projection: depths"
    scene, ours = known["brown"]  # a pinhole: the same order, and more pixels
    theirs = truth(CALL, scene, "GSPLAT_1_5")
    is_same = (theirs["radii"] > 0) == (ours["radii"] > 0)
    assert is_same.mean() > 0.95 and np.abs(theirs["render_alphas"] - ours["render_alphas"]).max() > 0.01


def test_what_gsplat_cannot_differentiate_is_left_out_and_packing_is_switched_off(known, monkeypatch):
    """gsplat 1.5.3 raises NotImplementedError for the gradient of the pose, and takes no packed projection."""
    torch = pytest.importorskip("torch", reason="the extra minisplat_ref[peers] is not installed")
    scene, arrays = known["brown"]

    class Blended(torch.autograd.Function):
        @staticmethod
        def forward(ctx, means, viewmats):
            ctx.needs_pose = viewmats.requires_grad
            return torch.tensor(arrays["render_colors"]) + 0 * means.sum()

        @staticmethod
        def backward(ctx, v):
            if ctx.needs_pose:
                raise NotImplementedError
            return torch.tensor(arrays["v_means"]).to(v), None

    def rasterization(means, viewmats, packed=True, **_):
        assert packed is False
        return Blended.apply(means, viewmats), torch.tensor(arrays["render_alphas"])

    monkeypatch.setattr(call_comparison, "load_function", lambda name: (rasterization, None))
    renderer = choose_renderer(CALL, "module:function", "float64", "torch")
    report = compare(CALL, renderer, {"brown": (scene, arrays)})
    assert report.n_failed == 0 and "v_viewmats" in report.settings["not_given"]
    assert [case.name for case in report.cases] == [
        *("alpha: render_alphas", "colours: render_colors", "gradients: v_means"),
    ]


def test_golden_vectors_and_a_renderer_of_ones_own(tmp_path, capsys, monkeypatch):
    """Export, compare the folder with itself, and a function that gets gsplat's keywords, by the command line."""
    golden = tmp_path / "golden"
    assert main(["oracle", "export", str(golden), *OF_CAMERAS]) == 0
    assert {"README.md", "manifest.json", *("brown", "fisheye", "hard", "ortho")} == {p.name for p in golden.iterdir()}
    manifest = json.loads((golden / "manifest.json").read_text())
    assert manifest["call"] == "rasterization_cameras"
    assert manifest["scenes"]["fisheye"]["settings"]["camera_model"] == "fisheye"
    compared = ["oracle", "compare", str(golden), *OF_CAMERAS, "--dtype", "float64"]
    assert main(compared) == 0 and "all 12 cases passed" in capsys.readouterr().out

    with np.load(golden / "brown" / "results.npz") as file:
        arrays = dict(file)
    arrays["depths"] = arrays["depths"] + 0.01
    np.savez(golden / "brown" / "results.npz", **arrays)
    assert main(compared) == 1 and "first difference: projection: depths" in capsys.readouterr().out

    (tmp_path / "my_lens.py").write_text(
        "from minisplat_ref.mechanisms.cameras.gsplat_call import rasterization as theirs, rasterization_vjp\n"
        "def rasterization(*, with_ut=False, with_eval3d=False, camera_model='pinhole', **arguments):\n"
        "    assert with_ut == with_eval3d == (camera_model != 'ortho')\n"
        "    return theirs(with_ut=with_ut, with_eval3d=with_eval3d, camera_model=camera_model, **arguments)[:2]\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["oracle", "compare", "my_lens:rasterization", *OF_CAMERAS]) == 0
    out = capsys.readouterr().out
    assert "all 9 cases passed" in out and "not given: means2d, depths, radii" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "cpu", "--scene", "sh3"], "choose all or one of brown, fisheye, hard, ortho"),
        (["compare", "planted:nothing"], "error 'nothing' is unknown"),
        (["compare", "gsplat-torch"], "nor a renderer of other cameras: package.module:function, cpu, cpu-exact,"),
        (
            ["compare", "cpu", "--profile", "INRIA"],
            "no such rules; give GSPLAT_1_5, or leave it out",
        ),
        (["hard-cases", "--only", "needle"], "no hard case holds 'needle'"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys):
    assert main(["oracle", *arguments, *OF_CAMERAS]) == 2
    assert message in capsys.readouterr().err
