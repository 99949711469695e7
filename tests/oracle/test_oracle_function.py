"""A function of gsplat's signature against the oracle: found by its name, called with any arrays, judged by stage."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from minisplat_ref.app.cli import main
from minisplat_ref.constants import GSPLAT_1_5
from minisplat_ref.errors import InputError
from minisplat_ref.gsplat import call as gsplat_compat
from minisplat_ref.oracle.peers.array_kinds import Call, kind_of, run
from minisplat_ref.oracle.peers.function import from_function
from minisplat_ref.testing import assert_matches_oracle

SCENE = ("odd-size",)
DOCS = Path(__file__).parents[2] / "docs"
OURS = """
from minisplat_ref.gsplat.call import rasterization, rasterization_vjp

NUMBER = 3

def other(means, scales):
    return means

def short(*, means, **rest):
    image, alpha, _ = rasterization(means, **rest)
    return image[:, 1:], alpha

def needy(how, **rest):
    return rasterization(**rest)

def alone(**rest):
    return rasterization(**rest)[0]

def broken(**rest):
    raise RuntimeError("no kernel\\nfor this")

def plain(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, backgrounds):
    return rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree=sh_degree,
                         backgrounds=backgrounds)[:2]
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of somebody else's, in the current folder."""
    (tmp_path / "theirs.py").write_text(OURS)
    (tmp_path / "faulty.py").write_text("1 / 0\n")
    (tmp_path / "lacking.py").write_text("import a_module_that_nobody_has\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    for name in ("theirs", "faulty", "lacking"):
        sys.modules.pop(name, None)


def compare(capsys, *arguments):
    code = main(["oracle", "compare", *arguments])
    return code, capsys.readouterr()


def test_our_own_function_agrees(module, capsys):
    code, said = compare(capsys, "theirs:rasterization", "--scene", "odd-size", "--dtype", "float64")
    assert code == 0 and "all 18 cases passed" in said.out
    assert "v_view" in said.out.split("not given")[0]  # the vjp of the same name is found


def test_a_function_without_options_is_compared_without_depth(module, capsys):
    code, said = compare(capsys, "theirs:plain", "--scene", "ordinary")
    assert code == 0
    not_given = re.search("not given: (.*)", said.out)[1].split(", ")
    assert "view" in not_given and "v_means" in not_given and "features" not in not_given
    code, said = compare(capsys, "theirs:plain", "--scene", "antialiased")
    assert code == 2 and "can render none of the scenes antialiased" in said.err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("absent:f", ["module absent is not found"]),
        ("theirs.inner:f", ["theirs", "not found"]),
        ("lacking:f", ["module lacking needs a_module_that_nobody_has"]),
        ("faulty:f", ["importing faulty raised ZeroDivisionError"]),
        ("theirs:nothing", ["theirs has no 'nothing'", "rasterization", "plain"]),
        ("theirs:", ["package.module:function"]),
        ("theirs:NUMBER", ["int, not a function"]),
        ("theirs:other", ["other has no parameter quats, opacities", "sh_degree"]),
        ("theirs:needy", ["needs how"]),
        ("theirs:short", ["scene odd-size", "render_colors has shape [1, 22, 37, 3], expected [1, 23, 37, 3]"]),
        ("theirs:alone", ["returned ndarray", "render_alphas"]),
        ("theirs:broken", ["raised RuntimeError: no kernel", "numpy arrays", "--arrays"]),
    ],
)
def test_bad_input_is_one_line(module, capsys, name, words):
    code, said = compare(capsys, name, "--scene", "odd-size")
    assert code == 2 and said.err.count("\n") == 1 and said.out == ""
    missing = [word for word in words if word not in said.err]
    assert not missing, said.err


def test_arrays_are_for_functions_alone(capsys):
    assert compare(capsys, "cpu", "--arrays", "torch")[0] == 2


# In somebody else's tests


def ours(**changes):
    """Our own call; ``changes`` map a result to what a wrong renderer would give."""

    def function(**arguments):
        image, alpha, meta = gsplat_compat.rasterization(**arguments)
        told = {**meta}
        for name, change in changes.items():
            if name in told:
                told[name] = change(told[name])
        return (changes["image"](image) if "image" in changes else image), alpha, told

    return function


def vjp(**arguments):
    return gsplat_compat.rasterization_vjp(**arguments)


def test_agreement_is_reported():
    report = assert_matches_oracle(ours(), vjp, scenes=SCENE)
    assert report.n_failed == 0 and len(report.cases) == 18


def test_the_first_stage_is_named():
    wrong = ours(conics=lambda conics: conics * [1, 2, 1], image=lambda image: 1.01 * image)
    with pytest.raises(AssertionError) as error:
        assert_matches_oracle(wrong, vjp, scenes=SCENE)
    text = str(error.value)
    assert text.startswith("ours.<locals>.function float32 against the reference")
    assert "the first stage that diverges is conics, in scene odd-size" in text and "only [:, 1] times 2" in text
    assert re.search(r"\| image +\| FAILED .*may follow from conics", text)


def test_a_wrong_gradient_is_found():
    def wrong(**arguments):
        v = vjp(**arguments)
        return {**v, "v_quats": 0.5 * v["v_quats"]}

    with pytest.raises(AssertionError, match="first stage that diverges is v_quats"):
        assert_matches_oracle(ours(), wrong, scenes=SCENE)


def test_no_gradients_are_no_agreement():
    with pytest.raises(AssertionError, match="gives no gradients"):
        assert_matches_oracle(ours(), scenes=SCENE)
    assert assert_matches_oracle(ours(), scenes=SCENE, has_gradients=False).n_failed == 0


def test_what_is_no_mapping_of_gradients_is_refused():
    with pytest.raises(InputError, match="return a dict"):
        assert_matches_oracle(ours(), lambda **_: 3, scenes=SCENE)


def test_arrays_are_told_by_the_module():
    assert kind_of(gsplat_compat.rasterization) == "numpy"
    with pytest.raises(InputError, match="unknown"):
        from_function(gsplat_compat.rasterization, arrays="cupy")


# torch and JAX: ours as an operation with its own gradient, and gsplat's functions as docs/ORACLE.md puts them together


def test_torch_differentiates():
    torch = pytest.importorskip("torch")
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")

    class Ours(torch.autograd.Function):
        @staticmethod
        def forward(ctx, rest, *leaves):
            ctx.given = {**rest, **{n: x.detach().numpy() for n, x in zip(names, leaves, strict=True)}}
            image, alpha, _ = gsplat_compat.rasterization(**ctx.given)
            return torch.tensor(image), torch.tensor(alpha)

        @staticmethod
        def backward(ctx, v_image, v_alpha):
            v = vjp(**ctx.given, v_render_colors=v_image.numpy().copy(), v_render_alphas=v_alpha.numpy().copy())
            return None, *(torch.tensor(v[f"v_{name}"]) for name in names)

    def function(*, Ks, packed=False, **arguments):
        assert not packed
        leaves = [arguments.pop(name) for name in names]
        return Ours.apply({"Ks": Ks.numpy(), **arguments}, *leaves)

    report = assert_matches_oracle(function, arrays="torch", scenes=SCENE, dtype="float64")
    assert "v_view" in [case.name for case in report.cases] and report.settings["not_given"][0] == "means2d"


def test_jax_differentiates():
    jax = pytest.importorskip("jax")

    def function(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, backgrounds):
        """The background alone, with the gradient that it has by itself."""
        image = jax.numpy.broadcast_to(backgrounds[:, None, None], (1, height, width, backgrounds.shape[1]))
        return image, jax.numpy.zeros((1, height, width, 1))

    with pytest.raises(AssertionError, match="the first stage that diverges is T"):
        assert_matches_oracle(function, arrays="jax", scenes=SCENE)
    leaves = {"colors": np.zeros((1, 3)), "backgrounds": np.array([[0.25, 0.5, 0.75]])}
    unused = dict.fromkeys(("means", "quats", "scales", "opacities", "viewmats", "Ks", "sh_degree"))
    call = Call(leaves, {**unused, "width": 4, "height": 2}, np.arange(24.0).reshape(1, 2, 4, 3), np.ones((1, 2, 4, 1)))
    gradients = run("jax", function, None, call).gradients
    assert np.array_equal(gradients["backgrounds"], call.v_colors.sum((1, 2))) and not gradients["colors"].any()


def test_a_jax_renderer_agrees(monkeypatch, capsys):
    """By the command line in float64, by the assertion in float32 afterwards: the former leaves no trace in JAX."""
    jax = pytest.importorskip("jax")
    monkeypatch.setattr(sys, "path", list(sys.path))
    code, said = compare(capsys, "jax_renderer:rasterization", "--scene", "odd-size", "--dtype", "float64")
    assert code == 0 and "all 15 cases passed" in said.out and "v_view" in said.out.split("not given")[0]
    import jax_renderer

    assert not jax.config.jax_enable_x64
    report = assert_matches_oracle(jax_renderer.rasterization, scenes=SCENE)
    assert report.n_failed == 0 and len(report.cases) == 15


def test_a_wrong_jax_renderer_is_found():
    jax = pytest.importorskip("jax")
    from jax_renderer import rasterization

    def without_gradient_of_scales(scales, **arguments):
        return rasterization(scales=jax.lax.stop_gradient(scales), **arguments)

    with pytest.raises(AssertionError, match="first stage that diverges is v_scales"):
        assert_matches_oracle(without_gradient_of_scales, arrays="jax", scenes=SCENE, dtype="float64")


def test_the_own_vjp_of_a_jax_renderer_gets_its_dtype():
    jax = pytest.importorskip("jax")

    def function(means, **_):
        return means[None, None], means[None, None, :, :1]

    def own_vjp(means, v_render_colors, v_render_alphas, **_):
        return {"v_means": v_render_colors[0, 0] * (means.dtype == jax.numpy.float64)}

    ones = np.ones((1, 1, 2, 3))
    call = Call({"means": np.full((2, 3), 1 / 3)}, {}, ones, ones[..., :1])
    result = run("jax", function, own_vjp, call)
    assert result.colors.dtype == np.float64 and np.array_equal(result.gradients["means"], ones[0, 0])


def example():
    """The first block of the section on functions in docs/ORACLE.md: gsplat's torch functions as a renderer."""
    text = (DOCS / "ORACLE.md").read_text()
    return re.search(r"`my_renderer/__init__.py`:\n\n```python\n(.*?)```", text, re.DOTALL)[1]


def test_gsplats_functions_agree(tmp_path, monkeypatch, capsys):
    pytest.importorskip("torch")
    pytest.importorskip("gsplat")
    (tmp_path / "my_renderer.py").write_text(example())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    arguments = ["my_renderer:rasterization", "--scene", "odd-size", "--dtype", "float64"]
    code, said = compare(capsys, *arguments, "--profile", GSPLAT_1_5.name)
    assert code == 0 and "all 20 cases passed" in said.out
    # gsplat 1.5 clamps alpha at 0.999, its main branch at 0.99: by the wrong rules it differs where it should.
    code, said = compare(capsys, *[a.replace("odd-size", "ordinary") for a in arguments])
    assert code == 1 and "the first stage that diverges is T" in said.out
    sys.modules.pop("my_renderer")


def test_arguments_of_the_function_are_not_shared():
    """One that writes into its arguments must not spoil the next call."""

    def greedy(**arguments):
        result = gsplat_compat.rasterization(**arguments)
        arguments["means"][:] = np.nan
        return result

    assert assert_matches_oracle(greedy, scenes=SCENE, has_gradients=False).n_failed == 0
