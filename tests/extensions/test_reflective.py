"""Reflective surfels: frames of normals and rays, what hides what, degenerate cases, the recipe by its command."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from minisplat_ref.app.cli import main
from minisplat_ref.constants import SH_C0
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.extensions.reflective.model import RECIPE
from minisplat_ref.io.images import read_image
from minisplat_ref.io.srgb import decode_srgb, encode_srgb
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_PIXEL,
    PER_SURFEL,
    STAGE,
    WITH_OCCLUSION,
    ReflectiveSurfels,
    first_light,
    sigmoid,
    with_materials,
)
from minisplat_ref.mechanisms.gbuffer.prefilter import prefilter
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE, render_reflective
from minisplat_ref.mechanisms.gbuffer.shading import Surface, shade
from minisplat_ref.mechanisms.gbuffer.training import restart_materials, shade_by, spread_normals
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.training.adam import AdamState
from minisplat_ref.types import Camera, Gaussians, Model, view_from
from scenes import make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT64

LOGIT_ONE = 40.0  # of a share that is 1 in float64


def reflective(gaussians, albedo=0.5, metallic=0.0, roughness=0.5, around=0.0):
    """Surfels with the same material everywhere, but for an albedo [N, 3]; shares of 0 and 1 by infinite logits.

    From around, they receive the same light from everywhere.
    """
    n = len(gaussians.means)

    def logits(share, shape):
        with np.errstate(divide="ignore"):
            return np.broadcast_to(np.log(share) - np.log1p(-np.asarray(share, float)), shape).astype(float)

    return ReflectiveSurfels(
        **gaussians._asdict(),
        albedo_logits=logits(albedo, (n, 3)),
        metallic_logits=logits(metallic, (n,)),
        roughness_logits=logits(roughness, (n,)),
        around_dc=np.full((n, 3), around / SH_C0),
        around_rest=np.zeros((n, 45)),
    )


def discs(means, quats, scale, opacity=1 - 1e-9):
    n = len(means)
    logits = np.full(n, np.log(opacity) - np.log1p(-opacity))
    scales = np.broadcast_to(np.log(np.asarray(scale, float))[..., None], (n, 3))
    return Gaussians(
        np.array(means, float), np.array(quats, float), scales, logits, np.zeros((n, 3)), np.zeros((n, 0, 3))
    )


def model_of(population, stage, environment=None):
    environment = np.ones((4, 8, 3)) if environment is None else environment
    return Model(population, {ENVIRONMENT: np.log(environment), STAGE: np.full(1, float(stage))})


@pytest.mark.parametrize("stage", [PER_SURFEL, PER_PIXEL])
def test_albedo_alone_in_white_light_is_plain_surfels(stage, backend, rng):
    """Shaded one by one, each surfel has its own albedo; pixel by pixel, an own colour, equal for all."""
    g, camera = make_gaussians(rng, 30, size=0.3), make_camera(rng=rng)
    albedo = rng.uniform(0.1, 0.9, size=(30, 3)) if stage == PER_SURFEL else np.array([0.2, 0.4, 0.7])
    own = np.broadcast_to((albedo - 0.5) / SH_C0, (30, 3))
    g = g._replace(sh_dc=own, sh_rest=np.zeros((30, 0, 3)))
    plain = g._replace(sh_dc=np.broadcast_to((encode_srgb(albedo) - 0.5) / SH_C0, (30, 3)))
    request = Request(np.array([0.3, 0.2, 0.1]), backend=backend)
    expected, _ = SURFELS.render(Model(plain), view_from(camera), request)
    surfels = reflective(g, albedo if stage == PER_SURFEL else 0.5)
    found, _ = render_reflective(model_of(surfels, stage), view_from(camera), request, mirrors=False)
    assert expected.alpha.mean() > 0.1
    assert_allclose(found.image, expected.image, atol=PARITY_FLOAT64)
    assert_array_equal(found.alpha, expected.alpha)


def test_a_wide_mirror_shows_each_pixel_its_own_direction(backend, rng):
    """A plane seen by a turned camera: the normal and both directions are in the world, where the environment is."""
    environment = rng.uniform(0.2, 2, size=(8, 16, 3))
    quat = np.array([[0.9, 0.3, -0.2, 0.1]])
    camera = make_camera(24, 18, fx=20.0, fy=22.0, rng=rng)
    R, t = camera.cam_from_world_R, camera.cam_from_world_t
    mean = (np.array([[0.1, -0.1, 4.0]]) - t) @ R
    g = reflective(discs(mean, quat, [1e4]), albedo=0.9, metallic=1.0, roughness=0.3)
    found, _ = REFLECTIVE.render(model_of(g, PER_PIXEL, environment), view_from(camera), Request(backend=backend))
    rays = pinhole_rays(np.arange(24) + 0.5, np.arange(18)[:, None] + 0.5, camera).reshape(-1, 3)
    to_camera = -(rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ R
    n = rotation_matrices(quat)[0, :, 2]
    n = n * np.sign(to_camera @ n)[:, None]
    flat = np.ones(len(n))
    expected, _ = shade(Surface(0.9 * np.ones((len(n), 3)), flat, 0.3 * flat, n, to_camera), prefilter(environment))
    alpha = found.alpha.reshape(-1, 1)
    assert alpha.min() > 0.98 and np.ptp(expected) > 0.1
    assert_allclose(found.image.reshape(-1, 3), alpha * encode_srgb(expected), atol=1e-6)


def test_a_disc_in_the_way_is_seen_in_the_mirror(backend):
    """A floor mirrors a white sky; a black disc above it, itself out of view, is dark in it, and only there."""
    camera = Camera(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), np.array([0, 0, 4.0]), 24.0, 24.0, 12, 9, 24, 18)
    g = discs([[0, 0, 0], [0, 0, 6.0]], [[1.0, 0, 0, 0]] * 2, np.array([1e4, 0.5]), 0.99)
    g = reflective(g, albedo=1.0, metallic=1.0, roughness=0.0)
    images = [
        REFLECTIVE.render(model_of(g, stage), view_from(camera), Request(backend=backend))[0].image[..., 0]
        for stage in (PER_PIXEL, WITH_OCCLUSION)
    ]
    share = images[1] / images[0]
    # A pixel at the offset p sees the floor at 4 p / f and, reflected, the height of 6 at (4 + 6) p / f.
    x, y = np.meshgrid(np.arange(24) + 0.5 - 12, np.arange(18) + 0.5 - 9)
    at = 10 * np.hypot(x, y) / 24 / 0.5  # in standard deviations of the disc
    alpha = 0.99 * np.exp(-(at**2) / 2)
    expected = encode_srgb(np.maximum(1 - np.where(alpha > 1 / 255, alpha, 0), 1e-12)) / encode_srgb(np.ones(1))
    assert share.min() < 0.5
    assert_allclose(share[at > 3.4], 1, rtol=1e-6)
    assert_allclose(share, expected, atol=2e-3)


def test_the_start_shows_the_colours_of_the_points(rng):
    colors = np.array([[0.2, 0.5, 0.8], [0.0, 1.0, 0.5]])
    g = make_gaussians(rng, 2)._replace(sh_dc=(colors - 0.5) / SH_C0)
    found = with_materials(g, rng)
    assert_allclose(encode_srgb(sigmoid(found.albedo_logits)), np.clip(colors, 0.02, 0.98), rtol=CLOSED_FORM)
    assert_allclose(encode_srgb(0.5 + SH_C0 * found.sh_dc), np.clip(colors, 0.02, 0.98), rtol=CLOSED_FORM)
    assert_allclose(sigmoid(found.metallic_logits), 0.01, rtol=CLOSED_FORM)
    assert_allclose(sigmoid(found.roughness_logits), 0.1, rtol=CLOSED_FORM)
    assert not found.around_dc.any() and found.around_rest.shape == (2, 45) and not found.around_rest.any()
    shared = first_light(None, rng)
    assert shared[ENVIRONMENT].shape == (32, 64, 3) and not shared[ENVIRONMENT].any() and shared[STAGE] == 0


def test_light_from_around_is_what_a_hidden_mirror_shows(backend):
    """Where something hides the sky of 0.9, a mirror shows the 0.3 from around; where half of it does, their mean."""
    camera = Camera(np.eye(3), np.zeros(3), 24.0, 24.0, 4, 3, 8, 6)
    g = reflective(discs([[0, 0, 4.0]], [[1.0, 0, 0, 0]], [1e4]), albedo=1.0, metallic=1.0, roughness=0.0, around=0.3)
    model, view = model_of(g, WITH_OCCLUSION, np.full((4, 8, 3), 0.9)), view_from(camera)
    shares = []
    for seen in (0.0, 0.5, 1.0):
        output, _ = render_reflective(model, view, Request(backend=backend), np.full((6, 8), seen), mirrors=True)
        shares.append(decode_srgb(output.image[3, 4] / output.alpha[3, 4]))
    assert_allclose(shares[0] / shares[2], 0.3 / 0.9, rtol=1e-6)
    assert_allclose(shares[1] / shares[2], 0.6 / 0.9, rtol=1e-6)


class _State:
    """A state whose moments are all 1."""

    def __init__(self, gaussians, stage=PER_SURFEL):
        self.gaussians = gaussians._replace(**{name: field.copy() for name, field in gaussians._asdict().items()})
        self.shared = {STAGE: np.full(1, float(stage)), ENVIRONMENT: np.ones((4, 8, 3))}
        self.rng = np.random.default_rng(0)
        ones = [{name: np.ones_like(field) for name, field in gaussians._asdict().items()} for _ in range(2)]
        self.adam = AdamState(*(gaussians._replace(**fields) for fields in ones), 1)
        self.shared_adam = AdamState(*({name: np.ones_like(x) for name, x in self.shared.items()} for _ in range(2)), 1)


SPREAD = {"growth": 1.5, "metallic": 0.02, "roughness": 0.01, "opacity": 0.9, "disturbance": 0.4}


def test_mirrors_grow_and_others_change_their_colour(rng):
    """By hand: metal from 2 %, roughness up to 1 %; opacities rise to 0.9, and none falls."""
    g = reflective(make_gaussians(rng, 4), metallic=0.5)
    g = g._replace(
        metallic_logits=np.log([0.03 / 0.97, 0.03 / 0.97, 0.01 / 0.99, 0.5 / 0.5]),
        roughness_logits=np.log([0.005 / 0.995, 0.02 / 0.98, 0.005 / 0.995, 0.005 / 0.995]),
        opacity_logits=np.log([0.3 / 0.7, 0.95 / 0.05, 0.9 / 0.1, 0.01 / 0.99]),
    )
    for stage in (PER_SURFEL, PER_PIXEL):
        state = _State(g, stage)
        assert spread_normals(state, None, **SPREAD) is None
        after, mirrors = state.gaussians, [0, 3]
        assert_allclose(sigmoid(after.opacity_logits), [0.9, 0.95, 0.9, 0.9], rtol=1e-12)
        assert not state.adam.first.opacity_logits.any() and not state.adam.second.opacity_logits.any()
        assert_allclose(after.log_scales[mirrors, :2] - g.log_scales[mirrors, :2], np.log(1.5), rtol=1e-12)
        assert_array_equal(after.log_scales[:, 2], g.log_scales[:, 2])
        assert_array_equal(after.log_scales[[1, 2]], g.log_scales[[1, 2]])
        assert_array_equal(after.quats, g.quats)
        moved = np.abs(after.sh_dc - g.sh_dc)
        assert not moved[[0, 1, 3]].any() and moved[2].any() == (stage == PER_PIXEL) and moved.max() <= 0.4
    crowd = _State(reflective(make_gaussians(rng, 400)), PER_PIXEL)
    before = crowd.gaussians.sh_dc.copy()
    assert spread_normals(crowd, None, **SPREAD) == "opacities raised: no surfel mirrors"
    assert_allclose((crowd.gaussians.sh_dc - before).std(), 0.4 / 3**0.5, rtol=0.1)  # 1,200 draws: 2 %


def test_shading_per_pixel_begins_with_the_first_materials_and_light(rng):
    state = _State(reflective(make_gaussians(rng, 3), metallic=0.7, roughness=0.8))
    restart_materials(state, None)
    shade_by(state, None, stage=2)
    after = state.gaussians
    for name, share in (("albedo_logits", 0.5), ("metallic_logits", 0.01), ("roughness_logits", 0.1)):
        assert_allclose(sigmoid(getattr(after, name)), share, rtol=CLOSED_FORM)
        assert not getattr(state.adam.first, name).any() and not getattr(state.adam.second, name).any()
    assert not state.shared[ENVIRONMENT].any() and state.shared[STAGE] == 2
    assert not state.shared_adam.first[ENVIRONMENT].any() and not state.shared_adam.second[ENVIRONMENT].any()
    assert state.adam.first.sh_dc.all() and state.shared_adam.first[STAGE].all()


def test_the_loss_on_normals_counts_from_the_start():
    [term] = [term for term in RECIPE.losses if term.name == "normal_consistency"]
    assert term.is_due(1) and term.weight == 0.05


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reflective")
    settings = {"n_views": 3, "width": 24, "height": 18, "n_points": 60}
    write_scene(make_scene("glossy", supersampling=1, **settings), folder / "scene", settings)
    train = [
        "train",
        str(folder / "scene"),
        "--recipe",
        "reflective",
        "--iterations",
        "10",
        "--out",
        str(folder / "run"),
    ]
    assert main(train) == 0
    return folder


def test_a_run_ends_with_occlusion_and_shows_its_maps(run_folder, capsys):
    with np.load(run_folder / "run" / "shared.npz") as shared:
        assert shared[STAGE] == WITH_OCCLUSION and np.ptp(shared[ENVIRONMENT]) > 0
    for name in ("albedo", "normal", "metallic", "roughness"):
        assert main(["render", str(run_folder / "run"), "--map", name]) == 0
        [image] = [read_image(path) for path in (run_folder / "run" / "views").glob(f"*_{name}.png")]
        assert image.max() > (20 if name != "metallic" else 1)  # 1 % of metal is 3 of 255


def test_a_run_is_relit(run_folder, capsys):
    run, views = str(run_folder / "run"), run_folder / "run" / "views"
    np.save(run_folder / "dark.npy", np.full((8, 16, 3), 0.05))
    means = []
    for light in ([], ["--environment", str(run_folder / "dark.npy")]):
        assert main(["render", run, *light]) == 0
        means.append(np.mean([read_image(path).mean() for path in views.glob("*.png")]))
    assert means[1] < 0.99 * means[0]  # own colours stay; what is reflected becomes darker
    np.save(run_folder / "bad.npy", np.full((8, 16, 3), np.nan))
    assert main(["render", run, "--environment", str(run_folder / "bad.npy")]) == 2
    assert "finite values" in capsys.readouterr().err


def test_maps_asked_of_a_recipe_that_has_none(run_folder, capsys):
    ply = str(run_folder / "run" / "point_cloud.ply")
    assert main(["render", ply, "--extension", "core", "--map", "albedo"]) == 2
    assert "has no map albedo: it is drawn as splatting" in capsys.readouterr().err.splitlines()[-1]
    assert main(["render", ply]) == 2
    assert "no place for their light" in capsys.readouterr().err.splitlines()[-1]
