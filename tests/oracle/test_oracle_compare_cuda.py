"""The adapters of CUDA renderers, tried without a GPU: on stand-ins of the same names, signatures and conventions."""

from collections import namedtuple
from types import SimpleNamespace

import numpy as np
import pytest

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA
from minisplat_ref.errors import InputError
from minisplat_ref.oracle.comparison.renderers import choose_renderer, choose_scenes
from minisplat_ref.oracle.comparison.staged import compare_scene, first_divergence
from minisplat_ref.oracle.golden.scenes import RECIPES
from minisplat_ref.oracle.peers.cuda import from_functions, from_module, rules_of
from minisplat_ref.reference.pinhole import pinhole
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.rendering.splatting import Primitives, splat, splat_vjp
from minisplat_ref.types import Camera, Projection, TileBins, TileGrid

torch = pytest.importorskip("torch", reason="the extra minisplat_ref[peers] is not installed")


def numpy(tensor):
    return tensor.detach().numpy().astype(np.float64)


class Blend(torch.autograd.Function):
    """gsplat's rasterize_to_pixels, by the reference."""

    @staticmethod
    def forward(ctx, means2d, conics, colors, opacities, background, bins, conventions):
        arrays = [numpy(x) for x in (means2d, conics, colors, opacities, background)]
        n, grid = len(arrays[0]), bins.grid
        boxes = np.tile([0, 0, grid.width, grid.height], (n, 1))
        projection = Projection(arrays[0], np.zeros(n), arrays[1], arrays[3], np.ones((n, 2), int), boxes)
        ctx.arguments = projection, arrays[2], arrays[4], bins, conventions
        ctx.output = REFERENCE.composite(*ctx.arguments)
        return torch.tensor(ctx.output.image), torch.tensor(ctx.output.alpha)

    @staticmethod
    def backward(ctx, v_image, v_alpha):
        v = REFERENCE.composite_vjp(*ctx.arguments, ctx.output, numpy(v_image), numpy(v_alpha))
        fields = (v.means2d, v.conics, v.colors, v.opacities, v.background)
        return *(torch.tensor(x.astype(np.float32)) for x in fields), None, None


def gsplat_stand_in(module, conventions):
    """gsplat's wrapper functions over its torch functions; its batches have one camera here."""

    def fully_fused_projection(means, covars, quats, scales, viewmats, Ks, width, height, *, opacities, **settings):
        assert covars is None and means.dtype == torch.float32
        covariances, _ = module._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        return module._fully_fused_projection(means, covariances, viewmats, Ks, width, height, **settings)

    def spherical_harmonics(degree, dirs, coeffs, masks=None):
        assert dirs.shape == (len(coeffs), 3) and masks.shape == (len(coeffs),)
        return module._spherical_harmonics(degree, dirs, coeffs)

    def rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, backgrounds
    ):
        grid = TileGrid(width, height, tile_size, tile_size)
        assert isect_offsets.shape == (1, grid.n_tiles_y, grid.n_tiles_x)
        offsets = np.append(isect_offsets.numpy().ravel(), len(flatten_ids)).astype(np.int64)
        bins = TileBins(flatten_ids.numpy(), offsets, None, None, grid)
        inputs = (x[0] for x in (means2d, conics, colors, opacities, backgrounds))
        image, alpha = Blend.apply(*inputs, bins, conventions)
        return image[None], alpha[None, :, :, None]

    def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
        return module._isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height)

    return SimpleNamespace(
        fully_fused_projection=fully_fused_projection,
        spherical_harmonics=spherical_harmonics,
        isect_tiles=isect_tiles,
        isect_offset_encode=module._isect_offset_encode,
        rasterize_to_pixels=rasterize_to_pixels,
    )


@pytest.fixture(scope="module")
def gsplat():
    from minisplat_ref.oracle.peers.gsplat_torch import load

    try:
        _, module = load()
    except InputError as error:
        pytest.skip(str(error))
    return module


NOT_GIVEN = ["loss", "features", "statistics", "median depth", "surface", "Adam", "v_image_of_loss"]
NOT_GIVEN += ["v_features", "v_surface", "view", "v_view"]


@pytest.mark.parametrize("name", ["sh3", "antialiased", "off-centre"])
def test_the_adapter_of_gsplat_gives_every_stage(gsplat, name):
    renderer = from_functions(gsplat_stand_in(gsplat, GSPLAT_1_5), "stand-in", GSPLAT_1_5, "cpu")
    scenes, _ = choose_scenes(renderer, name, "reference", None)
    rows = {row.stage: row for row in compare_scene(renderer, scenes[name])}
    assert first_divergence(rows.values()) is None, first_divergence(rows.values())
    assert [stage for stage, row in rows.items() if row.status == "not given"] == NOT_GIVEN
    assert rows["radii"].status == "harmless"


def test_an_error_in_gsplat_is_named(gsplat):
    """The clamp of another version."""
    renderer = from_functions(gsplat_stand_in(gsplat, GSPLAT_MAIN), "stand-in", GSPLAT_1_5, "cpu")
    scenes, _ = choose_scenes(renderer, "sh3", "reference", None)
    assert first_divergence(compare_scene(renderer, scenes["sh3"])).stage == "T"


def test_gsplats_torch_functions_agree(gsplat):
    renderer = choose_renderer("gsplat-torch", "float64")
    scenes, _ = choose_scenes(renderer, "odd-size", "reference", None)
    assert scenes["odd-size"].conventions.alpha_max == GSPLAT_1_5.alpha_max
    assert first_divergence(compare_scene(renderer, scenes["odd-size"])) is None


def test_gsplat_is_asked_only_for_what_it_does():
    asked = {recipe.name: rules_of(GSPLAT_1_5)(recipe.conventions) for recipe in RECIPES}
    assert [asked.pop(name) for name in ("inria", "equality", "equality-inria")] == [None, None, None]
    assert all(rules.alpha_max == 0.999 for rules in asked.values())
    assert asked["antialiased"].is_antialiased and not asked["sh3"].is_antialiased


class Splat(torch.autograd.Function):
    """The 3DGS rasteriser, by the reference in its profile; the gradient of its 2D means is per half image."""

    @staticmethod
    def forward(ctx, means, means2d, shs, opacities, scales, rotations, camera, settings):
        arrays = [numpy(x) for x in (means, rotations, scales, opacities[:, 0])]
        sh = np.ascontiguousarray(numpy(shs))
        ctx.shading = (arrays[0], np.ascontiguousarray(sh[:, 0]), np.ascontiguousarray(sh[:, 1:]), camera)
        ctx.degree = settings.sh_degree

        def shade(radii):
            return REFERENCE.sh_colors(*ctx.shading, ctx.degree, radii)

        ctx.tape = splat(Primitives(*arrays), shade, camera, numpy(settings.bg), INRIA, REFERENCE)
        image = np.moveaxis(ctx.tape.output.image, 2, 0).astype(np.float32)
        radii = torch.tensor(ctx.tape.projection.radii[:, 0])
        ctx.mark_non_differentiable(radii)
        return torch.tensor(image), radii

    @staticmethod
    def backward(ctx, v_image, _):
        v = splat_vjp(ctx.tape, np.moveaxis(numpy(v_image), 0, 2), np.zeros_like(ctx.tape.output.alpha))
        v_sh = REFERENCE.sh_colors_vjp(*ctx.shading, ctx.degree, ctx.tape.projection.radii, v.colors)
        size = np.array([ctx.tape.camera.width, ctx.tape.camera.height])
        gradients = (
            v.primitives.means + v_sh.means,
            np.column_stack([v.means2d * size / 2, np.zeros(len(v.means2d))]),
            np.concatenate([v_sh.sh_dc[:, None], v_sh.sh_rest], axis=1),
            v.primitives.opacities[:, None],
            v.primitives.scales,
            v.primitives.quats,
        )
        return *(torch.tensor(x.astype(np.float32)) for x in gradients), None, None


NAMES = "image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered"
Settings = namedtuple("Settings", f"{NAMES} debug antialiasing")


def inria_stand_in():
    def rasterizer(settings):
        view, full = numpy(settings.viewmatrix).T, numpy(settings.projmatrix).T
        width, height = settings.image_width, settings.image_height
        focal = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
        R = np.linalg.inv(view[:3, :3]).T  # a rotation again, to the last digit but one
        camera = Camera(R, view[:3, 3], *focal, width / 2, height / 2, width, height)

        def call(*, means3D, means2D, shs, opacities, scales, rotations):
            x = numpy(means3D) @ view[:3, :3].T + view[:3, 3]
            clip = np.column_stack([numpy(means3D), np.ones(len(x))]) @ full.T
            pixels = (clip[:, :2] / clip[:, 3:] + 1) * np.array([width, height]) / 2
            np.testing.assert_allclose(pixels, pinhole(x, camera), rtol=1e-4, atol=1e-3)
            np.testing.assert_allclose(numpy(settings.campos), -view[:3, :3].T @ view[:3, 3], rtol=1e-5)
            np.testing.assert_allclose(np.linalg.norm(numpy(rotations), axis=1), 1, rtol=1e-5)
            return Splat.apply(means3D, means2D, shs, opacities, scales, rotations, camera, settings)

        return call

    return SimpleNamespace(GaussianRasterizationSettings=Settings, GaussianRasterizer=rasterizer)


def test_the_adapter_of_the_3dgs_rasteriser():
    renderer = from_module(inria_stand_in(), "cpu")
    scenes, left_out = choose_scenes(renderer, "all", "reference", None)
    assert list(scenes) == ["inria"] and len(left_out) == len(RECIPES) - 1
    truth = scenes["inria"]
    assert not truth.arrays["v_alpha"].any() and not truth.arrays["v_depths"].any()
    rows = {row.stage: row for row in compare_scene(renderer, truth)}
    given = {stage for stage, row in rows.items() if row.status != "not given"}
    assert given == {"radii", "image", "v_means2d", "v_means", "v_quats", "v_scales", "v_opacities", "v_sh"}
    assert first_divergence(rows.values()) is None, first_divergence(rows.values())


def test_without_a_device_or_a_package_one_line_says_so():
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    for name, message in (("gsplat", "CUDA device|cannot be imported"), ("inria", "cannot be imported|CUDA device")):
        with pytest.raises(InputError, match=message):
            choose_renderer(name, None)
