"""The oracle for ``rasterization_2dgs``: planted errors, hard cases, golden vectors, gsplat's own torch functions."""

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.errors import InputError
from minisplat_ref.mechanisms.surfels.gsplat_call import NAMES, rasterization_2dgs, rasterization_2dgs_vjp
from minisplat_ref.mechanisms.surfels.oracle.call import CALL, STAGES
from minisplat_ref.mechanisms.surfels.oracle.hard_cases import CASES, run_cases, select
from minisplat_ref.mechanisms.surfels.oracle.planted import PLANTED
from minisplat_ref.mechanisms.surfels.oracle.scenes import scenes
from minisplat_ref.oracle.call_comparison import CallRenderer, choose_renderer, compare, truth
from tolerances import GRADIENT_STEP_IMAGE

HAS_PEERS = all(importlib.util.find_spec(name) for name in ("torch", "gsplat"))


@pytest.fixture(scope="module")
def known():
    return {scene.name: (scene, truth(CALL, scene)) for scene in scenes()}


@pytest.mark.parametrize("error", PLANTED)
def test_a_planted_error_is_named_at_its_stage(error, known):
    report = compare(CALL, choose_renderer(CALL, f"planted:{error}"), known)
    assert report.settings["first_difference"].partition(":")[0] == PLANTED[error].stage


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_kernels_agree_at_every_stage(dtype, known):
    report = compare(CALL, choose_renderer(CALL, "cpu", dtype), known)
    assert len(report.cases) == len(STAGES) and report.n_failed == 0, report.cases
    assert report.settings == {"first_difference": None, "not_given": []}


@pytest.mark.skipif(not HAS_PEERS, reason="needs torch and gsplat: pip install 'minisplat_ref[peers]'")
def test_gsplats_own_torch_functions_agree_in_every_result_and_gradient(known):
    report = compare(CALL, choose_renderer(CALL, "gsplat-torch"), known)
    assert len(report.cases) == len(STAGES) and report.n_failed == 0, report.cases


def test_hard_cases_have_the_answers_that_were_worked_out():
    report = run_cases()
    assert len(report.cases) == 3 * len(CASES) and report.n_failed == 0, report.cases


def test_a_wrong_answer_is_found():
    (case,) = select("faces the camera")
    wrong = case._replace(alphas={pixel: value + 1e-3 for pixel, value in case.alphas.items()})
    assert run_cases((wrong,)).n_failed == 3


def test_every_cotangent_counts(known):
    """Leaving one out changes the gradient, and cotangents add up."""
    scene = known["ordinary"][0]
    parts = [
        rasterization_2dgs_vjp(**scene.arguments, cotangents={key: scene.cotangents[key]}, backend="cpu")["v_means"]
        for key in scene.cotangents
    ]
    assert len(parts) == len(NAMES) and min(np.abs(part).max() for part in parts) > 1e-3
    np.testing.assert_allclose(sum(parts), known["ordinary"][1]["v_means"], atol=1e-9)


@pytest.mark.parametrize("mode", ["RGB", "D", "RGB+D"])
def test_gradients_in_every_mode_are_those_of_what_is_computed(mode, known, rng):
    """Along a direction in the means: in RGB the median is read from the last colour, and there is no depth."""
    given = {**known["ordinary"][0].arguments, "render_mode": mode, "distloss": False}
    given["backgrounds"] = given["backgrounds"] if mode.startswith("RGB") else np.zeros((1, 3))
    images = rasterization_2dgs(**given)
    cotangents = {
        f"v_{name}": rng.normal(size=image.shape)
        for name, image in zip(NAMES, images[:6], strict=True)
        if image is not None
    }
    direction = rng.normal(size=given["means"].shape)

    def loss(step):
        moved = rasterization_2dgs(**{**given, "means": given["means"] + step * direction})
        return sum(np.sum(cotangents[f"v_{n}"] * x) for n, x in zip(NAMES, moved[:6], strict=True) if x is not None)

    difference = (loss(GRADIENT_STEP_IMAGE) - loss(-GRADIENT_STEP_IMAGE)) / (2 * GRADIENT_STEP_IMAGE)
    v = rasterization_2dgs_vjp(**given, cotangents=cotangents)["v_means"]
    assert abs(difference) > 1
    # The step of 1e-8 that stays on one side of thresholds leaves 1e-16 / 1e-8 of losses of about 1e3.
    np.testing.assert_allclose(np.sum(v * direction), difference, rtol=1e-4)


def test_a_batch_of_scenes_is_its_scenes_one_by_one(known):
    one, other = (known[name][0].arguments for name in ("ordinary", "ordinary"))
    moved = {**other, "means": other["means"] + 0.1}
    arrays = [key for key, value in one.items() if isinstance(value, np.ndarray)]
    both = {**one, **{key: np.stack([one[key], moved[key]]) for key in arrays}}
    batched = rasterization_2dgs(**both)
    for k, arguments in enumerate((one, moved)):
        alone = rasterization_2dgs(**arguments)
        for got, want in zip(batched[:6], alone[:6], strict=True):
            np.testing.assert_array_equal(got[k], want)
    cotangents = {key: np.stack([value, value]) for key, value in known["ordinary"][0].cotangents.items()}
    v = rasterization_2dgs_vjp(**both, cotangents=cotangents)
    np.testing.assert_allclose(v["v_means"][0], known["ordinary"][1]["v_means"], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"absgrad": True}, "absgrad=True is not computed"),
        ({"packed": True}, "packed=True is not computed"),
        ({"depth_mode": "mean"}, "depth_mode"),
        ({"render_mode": "RGB"}, "distloss needs a depth"),
        ({"opacities": np.full(61, 2.0)}, "opacities"),
    ],
)
def test_what_is_not_computed_is_refused(change, message, known):
    with pytest.raises(InputError, match=message):
        rasterization_2dgs(**{**known["ordinary"][0].arguments, **change})


def test_a_keyword_that_gsplat_does_not_have_is_a_programming_error(known):
    with pytest.raises(TypeError, match="unexpected keyword argument 'covars'"):
        rasterization_2dgs(**known["ordinary"][0].arguments, covars=None)


def test_a_wrong_cotangent_is_refused(known):
    arguments = known["ordinary"][0].arguments
    with pytest.raises(InputError, match="'v_render_depths' is unknown"):
        rasterization_2dgs_vjp(**arguments, cotangents={"v_render_depths": np.zeros(1)})
    with pytest.raises(InputError, match=r"v_render_alphas has shape \[1, 2\]"):
        rasterization_2dgs_vjp(**arguments, cotangents={"v_render_alphas": np.zeros((1, 2))})


def test_golden_vectors_and_a_renderer_of_ones_own(tmp_path, capsys, monkeypatch):
    """Export, compare the folder with itself, and a function in a user's module, through the command line."""
    golden = tmp_path / "golden"
    assert main(["oracle", "export", str(golden), "--call", "rasterization_2dgs"]) == 0
    assert {"README.md", "manifest.json", "ordinary", "median", "hard"} == {path.name for path in golden.iterdir()}
    manifest = json.loads((golden / "manifest.json").read_text())
    assert manifest["scenes"]["median"]["settings"]["depth_mode"] == "median"
    assert manifest["tolerances"]["render_median"]["float64"] == 1e-9
    compared = ["oracle", "compare", str(golden), "--call", "rasterization_2dgs", "--dtype", "float64"]
    assert main(compared) == 0 and "all 18 cases passed" in capsys.readouterr().out

    with np.load(golden / "hard" / "results.npz") as file:
        arrays = dict(file)
    arrays["render_normals"] = -arrays["render_normals"]
    np.savez(golden / "hard" / "results.npz", **arrays)
    assert main(compared) == 1 and "first difference: normals: render_normals" in capsys.readouterr().out

    (tmp_path / "my_surfels.py").write_text(
        "from minisplat_ref.mechanisms.surfels.gsplat_call import rasterization_2dgs as theirs\n"
        "def rasterization_2dgs(**arguments):\n"
        "    return theirs(**arguments)[:6]\n"
    )
    monkeypatch.chdir(tmp_path)
    call = ["oracle", "compare", "my_surfels:rasterization_2dgs", "--call", "rasterization_2dgs", "--scene", "median"]
    assert main(call) == 0
    out = capsys.readouterr().out
    assert "all 6 cases passed" in out and "not given: radii, means2d" in out


def test_normals_without_the_cameras_axis_are_those_of_one_camera(known):
    """gsplat 1.5.3 squeezes surf_normals, whatever its docstring says; another shape is refused all the same."""
    call, (scene, arrays) = CALL, known["median"]
    squeezed = {"surf_normals": arrays["surf_normals"][0]}
    (case,) = compare(call, CallRenderer("other", "float64", lambda _: squeezed), {"median": (scene, arrays)}).cases
    assert case.passed and arrays["surf_normals"].shape[0] == 1 and np.ptp(arrays["surf_normals"]) > 0.1
    squeezed["surf_normals"] = arrays["surf_normals"][0, 0]
    with pytest.raises(InputError, match="surf_normals has shape"):
        compare(call, CallRenderer("other", "float64", lambda _: squeezed), {"median": (scene, arrays)})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "cpu", "--scene", "sh3"], "scene 'sh3' is unknown; choose all or one of ordinary, median, hard"),
        (["compare", "planted:nothing"], "error 'nothing' is unknown"),
        (["compare", "inria"], "'inria' is neither a folder of arrays nor a renderer of surfels"),
        (
            ["compare", "cpu", "--profile", "INRIA"],
            "rasterization_2dgs has no such rules; leave it out",
        ),
        (["hard-cases", "--only", "needle"], "no hard case holds 'needle'"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys):
    assert main(["oracle", *arguments, "--call", "rasterization_2dgs"]) == 2
    assert message in capsys.readouterr().err


def test_importing_the_oracle_of_surfels_imports_no_torch():
    code = "import sys, minisplat_ref.mechanisms.surfels.oracle.call; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_arguments_by_position_are_those_of_gsplat(known):
    """In the order of gsplat 1.5.3, from the planes to depth_mode."""
    given = known["ordinary"][0].arguments
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height")
    first = [given[name] for name in names]
    options = {"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 1.0, "eps2d": 0.3}
    options |= {"sh_degree": given.get("sh_degree"), "packed": False, "tile_size": 8}
    options |= {"backgrounds": given.get("backgrounds"), "render_mode": "RGB+ED"}
    options |= {"sparse_grad": False, "absgrad": False, "distloss": True, "depth_mode": "median"}
    by_position = rasterization_2dgs(*first, *options.values())
    by_name = rasterization_2dgs(*first, **options)
    for one, other in zip(by_position[:6], by_name[:6], strict=True):
        np.testing.assert_array_equal(one, other)
    assert by_position[4].any()  # the distortion
    assert not np.array_equal(by_position[3], rasterization_2dgs(*first, **options | {"depth_mode": "expected"})[3])
    for name in ("packed", "sparse_grad", "absgrad"):
        with pytest.raises(InputError, match=f"{name}=True is not computed"):
            rasterization_2dgs(*first, *(options | {name: True}).values())
    with pytest.raises(TypeError, match="unexpected keyword argument"):
        rasterization_2dgs(*first, camera_model="pinhole")
