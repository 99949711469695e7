"""Textures on surfels: what a hit reads, normals, degenerate cases, baking, the recipe and its files."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from gradcheck import check_jacobian
from minisplat_ref.app.cli import main
from minisplat_ref.datasets.synthetic import make_scene
from minisplat_ref.datasets.synthetic.files import write_scene
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.texture_splat import EXTENSION, kernels, model, texel_kernels, textures
from minisplat_ref.extensions.texture_splat.baking import Maps, bake
from minisplat_ref.extensions.texture_splat.model import (
    CHANNELS,
    TEXTURED,
    TexturedSurfels,
    count_texels,
    with_textures,
)
from minisplat_ref.extensions.texture_splat.textures import (
    find_corners,
    raw_normals,
    tangent_normals,
    tangent_normals_vjp,
)
from minisplat_ref.io import load_ply, save_ply
from minisplat_ref.io.images import read_image
from minisplat_ref.mechanisms.gbuffer.lighting import ENVIRONMENT
from minisplat_ref.mechanisms.gbuffer.population import (
    PER_PIXEL,
    PER_SURFEL,
    STAGE,
    WITH_OCCLUSION,
    ReflectiveSurfels,
    sigmoid,
)
from minisplat_ref.mechanisms.gbuffer.renderer import REFLECTIVE
from minisplat_ref.mechanisms.surfels import renderer as discs
from minisplat_ref.oracle.gradients import inner_product_case
from minisplat_ref.oracle.pieces import SEED, tiny_setting
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.reference.pinhole import pinhole_rays
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.backends import CPU, REFERENCE
from minisplat_ref.types import Camera, Gaussians, Model, view_from
from scenes import as_dtype, make_camera, make_gaussians
from tolerances import CLOSED_FORM, PARITY_FLOAT32_GRADIENT, PARITY_FLOAT32_IMAGE, PARITY_FLOAT64

MAPS = frozenset({"normal", "albedo", "metallic", "roughness"})


def with_material(g, rng):
    n, around = len(g.means), np.random.default_rng(1)
    return ReflectiveSurfels(
        **g._asdict(),
        albedo_logits=rng.normal(size=(n, 3)),
        metallic_logits=rng.normal(size=n),
        roughness_logits=rng.normal(size=n),
        around_dc=around.normal(size=(n, 3)),
        around_rest=around.normal(size=(n, 45)),
    )


def painted(population, rng):
    """The population with random textures."""
    return population._replace(**{name: rng.normal(size=getattr(population, name).shape) for name in CHANNELS})


def model_of(population, stage=PER_PIXEL, rng=None):
    light = np.zeros((4, 8, 3)) if rng is None else rng.normal(size=(4, 8, 3))
    return Model(population, {ENVIRONMENT: light, STAGE: np.full(1, float(stage))})


def one_disc(scale, size, rng, quat=(1.0, 0, 0, 0), depth=4.0):
    g = Gaussians(
        np.array([[0.1, -0.1, depth]]),
        np.array([quat]),
        np.full((1, 3), np.log(scale)),
        np.full(1, 20.0),
        np.zeros((1, 3)),
        np.zeros((1, 0, 3)),
    )
    return painted(with_textures(with_material(g, rng), rng, texels=size), rng)


# --- formulas ---


def test_a_hit_reads_the_texels_around_it():
    """By hand, with 3 x 3 texels at -4, 0 and 4: row by v, column by u; halfway; on the border; beyond."""
    texture = np.arange(9.0)
    u, v = np.array([-4.0, 0, 4, 2, 0, 4, 6, 9]), np.array([-4.0, 0, -4, 0, -2, 4, 0, 0])
    found = find_corners(u, v, 3)
    values = np.sum(found.weights * texture[found.texels], axis=0)
    assert_allclose(values, [0, 4, 2, 4.5, 2.5, 8, 2.5, 0], rtol=CLOSED_FORM)
    single = find_corners(u, v, 1)
    assert_array_equal(np.sum(single.weights, axis=0), 1)
    assert not single.texels.any() and not single.slopes_u.any()


def test_corners_have_their_slopes(rng):
    u, v = rng.uniform(-5, 5, size=(2, 40))
    texture, h = rng.normal(size=16), 1e-7

    def read(u, v):
        corners = find_corners(u, v, 4)
        return np.sum(corners.weights * texture[corners.texels], axis=0)

    found = find_corners(u, v, 4)
    for slopes, du, dv in ((found.slopes_u, h, 0), (found.slopes_v, 0, h)):
        numeric = (read(u + du, v + dv) - read(u - du, v - dv)) / (2 * h)
        assert_allclose(np.sum(slopes * texture[found.texels], axis=0), numeric, atol=1e-7)


def test_normals_of_raw_numbers(rng):
    """By hand: flat, tilted, and beyond the largest tilt, where z stays; the inverse; the gradient on both sides."""
    tilted = np.arctanh([0.6, 0.0])
    found = tangent_normals(np.array([[0.0, 0], tilted, [20.0, 20.0]]))
    assert_allclose(found, [[0, 0, 1], [0.6, 0, 0.8], [1, 1, 0.1]], atol=1e-12)
    raw = np.concatenate([rng.normal(size=(4, 2)), [[2.0, -2.5]]])
    assert_allclose(raw_normals(3 * tangent_normals(raw[:4] / 2)), raw[:4] / 2, rtol=1e-9)
    below = tangent_normals(raw_normals(np.array([[0.3, 0.4, -0.5], [1.0, 0, 0]])))
    assert_allclose(below[:, :2], np.sqrt(0.99) * np.array([[0.6, 0.8], [1, 0]]), rtol=1e-5)
    check_jacobian(lambda x: (tangent_normals(x),), lambda v: (tangent_normals_vjp(raw, v),), [raw], names=["raw"])


def test_textures_of_another_size_show_the_same(rng):
    """2 x 2 to 3 x 3 by hand, and back to the corners; T = 1 is the middle."""
    surfels = painted(with_textures(make_gaussians(rng, 3), rng, texels=2), rng)
    larger = with_textures(surfels, rng, texels=3)
    before, after = surfels.albedo_logits.reshape(3, 2, 2, 3), larger.albedo_logits.reshape(3, 3, 3, 3)
    assert_allclose(after[:, 0, 1], (before[:, 0, 0] + before[:, 0, 1]) / 2, rtol=CLOSED_FORM)
    assert_allclose(after[:, 2, 1], (before[:, 1, 0] + before[:, 1, 1]) / 2, rtol=CLOSED_FORM)
    assert_allclose(after[:, 1, 2], (before[:, 0, 1] + before[:, 1, 1]) / 2, rtol=CLOSED_FORM)
    assert_allclose(with_textures(larger, rng, texels=2).normal_textures, surfels.normal_textures, rtol=CLOSED_FORM)
    middle = with_textures(surfels, rng, texels=1)
    assert_allclose(middle.metallic_logits[:, 0], surfels.metallic_logits.mean(axis=1), rtol=CLOSED_FORM)
    with pytest.raises(InputError, match="0 x 0 texels does not exist: give --set texels=1 or more"):
        with_textures(surfels, rng, texels=0)


# --- texels ---


def look_at(g, backend=CPU, camera=None):
    camera = make_camera(rng=np.random.default_rng(3)) if camera is None else camera
    return discs.look(Model(g), view_from(camera), Request(backend=backend))


def both_sides(rng, n, size):
    """Surfels of both sides of the camera, turned anyhow; some of their texels are tilted by more than one holds."""
    g = make_gaussians(rng, n, size=0.3)
    g = g._replace(means=np.where(np.arange(n)[:, None] % 3 == 1, -g.means, g.means), quats=rng.normal(size=(n, 4)))
    surfels = painted(with_textures(with_material(g, rng), rng, texels=size), rng)
    return surfels._replace(normal_textures=surfels.normal_textures * rng.choice([0.3, 3], size=(n, 1)))


def compare_texels(seen, v, tolerance):
    """Compare kernels and NumPy, relative to the largest; return the texels and the gradient of the kernels."""
    expected, found = model.read_textures(seen), texel_kernels.read_textures(seen)
    v_expected, v_found = model.read_textures_vjp(seen, v), texel_kernels.read_textures_vjp(seen, v)
    pairs = {"texels": (found, expected), "quats": (v_found.quats, v_expected.quats)}
    pairs["R"] = v_found.cam_from_world_R, v_expected.cam_from_world_R
    pairs |= {name: (v_found.fields[name], field) for name, field in v_expected.fields.items()}
    assert v_found.fields.keys() == v_expected.fields.keys() == CHANNELS.keys()
    for name, (ours, theirs) in pairs.items():
        assert ours.shape == theirs.shape and (name == "R" or ours.dtype == theirs.dtype), name
        assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max(), err_msg=name)
    return found, v_found


@pytest.mark.parametrize("size", [1, 2, 3])
def test_kernels_read_texels_as_numpy_does(size, rng):
    """On both sides of discs, at tilts on both sides of the limit; culled surfels are 0 and take no gradient."""
    g, v = both_sides(rng, 150, size), rng.normal(size=(150, size * size, 8))
    seen = look_at(g)
    is_seen = seen.surfels.radii[:, 0] > 0
    tilts = np.sum(tangent_normals(g.normal_textures.reshape(150, -1, 2))[..., :2] ** 2, axis=-1)
    sides = model.disc_axes(seen)[1][is_seen]
    assert 40 < is_seen.sum() < 110 and 0.02 < (tilts[is_seen] > 0.99).mean() < 0.9 and np.unique(sides).size == 2
    found, v_found = compare_texels(seen, v, PARITY_FLOAT64)
    assert found[is_seen].all() and not found[~is_seen].any()
    for field in (*v_found.fields.values(), v_found.quats):
        assert field[is_seen].any(axis=1).all() and not field[~is_seen].any()


def test_kernels_read_texels_in_float32(rng):
    """Of a float32 model with logits where a sigmoid is next to 0 or 1, in its dtype."""
    g = both_sides(rng, 60, 3)
    g = as_dtype(g._replace(albedo_logits=g.albedo_logits * rng.choice([1, 15, 100], size=(60, 1))), np.float32)
    found, v_found = compare_texels(look_at(g), rng.normal(size=(60, 9, 8)).astype(np.float32), PARITY_FLOAT32_IMAGE)
    assert found.dtype == v_found.quats.dtype == np.float32 and np.isfinite(found).all()
    assert all(np.isfinite(field).all() for field in v_found.fields.values())


def test_kernels_read_texels_of_few_surfels(rng):
    """One surfel, none in sight and none at all; textures of zeros are the disc's normal and one half."""
    flat = one_disc(0.5, 3, rng)
    flat = flat._replace(**{name: np.zeros_like(getattr(flat, name)) for name in CHANNELS})
    seen = look_at(flat, camera=make_camera())
    found, v_found = compare_texels(seen, rng.normal(size=(1, 9, 8)), PARITY_FLOAT64)
    assert_allclose(found[0, :, :3], np.broadcast_to(seen.surfels.normals, (9, 3)), atol=CLOSED_FORM)
    assert_array_equal(found[0, :, 3:], 0.5)
    behind = look_at(flat._replace(means=-flat.means), camera=make_camera())
    found, v_found = compare_texels(behind, rng.normal(size=(1, 9, 8)), PARITY_FLOAT64)
    assert not found.any() and not v_found.cam_from_world_R.any() and not v_found.quats.any()
    none = TexturedSurfels(*(field[:0] for field in flat))
    assert texel_kernels.read_textures(look_at(none)).shape == (0, 9, 8)
    assert not texel_kernels.read_textures_vjp(look_at(none), np.zeros((0, 9, 8))).cam_from_world_R.any()


# --- blending ---


def listed(g, camera, backend):
    request = Request(backend=backend)
    seen = discs.look(Model(g), view_from(camera), request)
    return seen.surfels, discs.list_tiles(seen.surfels, camera, request.conventions, backend), request.conventions


@pytest.mark.parametrize(("size", "opacity"), [(3, 0.5), (2, 6.0)])
def test_kernels_and_reference_agree(size, opacity, rng):
    """With hits that are clamped, and pixels that stop, too; float32 against float64."""
    g, camera = make_gaussians(rng, 40, size=0.3, opacity_logit=opacity), make_camera(rng=rng)
    texels, v = rng.normal(size=(40, size * size, 8)), rng.normal(size=(18, 24, 8))
    inputs = listed(g, camera, CPU)
    surfels, bins, conventions = inputs
    expected = textures.blend_texels(surfels, texels, bins, conventions)
    found = kernels.blend_texels(surfels, texels, bins, conventions)
    assert_allclose(found, expected, atol=PARITY_FLOAT64)
    v_expected = textures.blend_texels_vjp(surfels, texels, bins, conventions, expected, v)
    v_found = kernels.blend_texels_vjp(surfels, texels, bins, conventions, expected, v)
    assert v_expected.texels.any() and np.abs(expected).max() > 0.3
    for name, a, b in zip(v_found._fields, v_found, v_expected, strict=True):
        assert_allclose(a, b, atol=PARITY_FLOAT64 * 10 * np.abs(b).max(), err_msg=name)
    single = texels.astype(np.float32)
    image = kernels.blend_texels(surfels, single, bins, conventions)
    assert image.dtype == np.float32
    assert_allclose(image, expected, atol=PARITY_FLOAT32_IMAGE * np.abs(expected).max())
    v_single = kernels.blend_texels_vjp(surfels, single, bins, conventions, image, v)
    assert_allclose(v_single.texels, v_expected.texels, atol=PARITY_FLOAT32_GRADIENT * np.abs(v_expected.texels).max())


def test_hidden_surfels_have_no_gradient_of_texels(rng, monkeypatch):
    """Discs as wide as the image: those behind some opaque ones have slots that no hit has opened, here full of NaN."""
    g, camera = make_gaussians(rng, 12, size=3, opacity_logit=8.0), make_camera(rng=rng)
    texels, v = rng.normal(size=(12, 4, 8)), rng.normal(size=(18, 24, 8))
    surfels, bins, conventions = listed(g, camera, CPU)
    image = textures.blend_texels(surfels, texels, bins, conventions)
    kept, Slots = [], kernels.Slots

    def keep(*fields):
        fields[1].fill(np.nan)
        kept.append(Slots(*fields))
        return kept[-1]

    monkeypatch.setattr(kernels, "Slots", keep)
    found = kernels.blend_texels_vjp(surfels, texels, bins, conventions, image, v).texels
    expected = textures.blend_texels_vjp(surfels, texels, bins, conventions, image, v).texels
    is_hidden = ~expected.any(axis=(1, 2)) & (np.diff(bins.gaussian_offsets) > 0)
    assert is_hidden.any() and kept[0].is_hit.any() and not kept[0].is_hit.all()
    assert_allclose(found, expected, atol=PARITY_FLOAT64 * np.abs(expected).max())
    assert not found[is_hidden].any()


def test_the_whole_renderer_has_its_gradient(backend):
    """Every input along a random direction; ``oracle gradients --extension texture-splat`` checks all entries."""
    rng = np.random.default_rng(SEED)
    (stage,) = EXTENSION.stages(backend, tiny_setting(), rng)
    assert stage.inputs["normal_textures"].shape[1] == 2 * 3 * 3
    case = inner_product_case(stage, rng)
    assert case.passed and case.figures["error"] < 1e-7, case  # a tenth of its limit


@pytest.mark.parametrize("stage", [PER_PIXEL, WITH_OCCLUSION])
def test_one_texel_is_a_reflective_surfel_exactly(stage, backend, rng):
    flat, camera = with_material(make_gaussians(rng, 30, size=0.3), rng), make_camera(rng=rng)
    request = Request(np.array([0.3, 0.2, 0.1]), backend=backend, wants=MAPS | {"depth"})
    expected, tape = REFLECTIVE.render(model_of(flat, stage), view_from(camera), request)
    one = with_textures(flat, rng, texels=1)
    found, our_tape = TEXTURED.render(model_of(one, stage), view_from(camera), request)
    assert expected.alpha.mean() > 0.1
    assert_array_equal(found.image, expected.image)
    v = rng.normal(size=found.image.shape)
    v_expected, v_found = REFLECTIVE.render_vjp(tape, v), TEXTURED.render_vjp(our_tape, v)
    for name, array in v_expected.gaussians._asdict().items():
        ours = getattr(v_found.gaussians, name).reshape(array.shape)
        assert_allclose(ours, array, atol=PARITY_FLOAT64 * np.abs(array).max(), err_msg=name)
    assert_array_equal(v_found.shared[ENVIRONMENT], v_expected.shared[ENVIRONMENT])
    assert v_found.gaussians.normal_textures.any()


def test_equal_texels_are_one_texel(backend, rng):
    one = painted(with_textures(with_material(make_gaussians(rng, 30, size=0.3), rng), rng, texels=1), rng)
    camera, request = make_camera(rng=rng), Request(backend=backend, wants=MAPS)
    images = [
        TEXTURED.render(model_of(with_textures(one, rng, texels=size), stage), view_from(camera), request)[0].image
        for size, stage in ((1, PER_PIXEL), (4, PER_PIXEL), (4, PER_SURFEL))
    ]
    assert_allclose(images[1], images[0], atol=PARITY_FLOAT64)
    assert_array_equal(images[2], images[1])  # textures are shaded per pixel from the start


@pytest.mark.parametrize("quat", [(0.9, 0.3, -0.2, 0.1), (0.1, 0.9, 0.2, 0.3)], ids=["front", "back"])
def test_a_disc_shows_its_texture(quat, backend, rng):
    """The maps of one disc by the pixel's ray and the plane; its normals are turned to the camera as a whole."""
    size, scale = 3, 0.8
    g, camera = one_disc(scale, size, rng, quat), make_camera(24, 18, fx=20.0, fy=22.0, rng=rng)
    output, tape = TEXTURED.render(model_of(g), view_from(camera), Request(backend=backend, wants=MAPS))
    slices = TEXTURED.channels(MAPS)
    R, axes = camera.cam_from_world_R, rotation_matrices(g.quats)[0]
    rays = pinhole_rays(np.arange(24) + 0.5, np.arange(18)[:, None] + 0.5, camera).reshape(-1, 3) @ R
    t = ((g.means[0] - camera.center) @ axes[:, 2]) / (rays @ axes[:, 2])
    local = (camera.center + t[:, None] * rays - g.means[0]) @ axes / scale
    alpha = output.alpha.ravel()
    pixels = np.stack(np.meshgrid(np.arange(24) + 0.5, np.arange(18) + 0.5), axis=2).reshape(-1, 2)
    low_pass = 2 * np.sum((pixels - tape.seen.surfels.means2d[0]) ** 2, axis=1)  # where it is hit, the middle is read
    rho = np.sum(local[:, :2] ** 2, axis=1)
    is_seen = (rho < np.minimum(9, low_pass)) & (alpha > 0.01)
    assert is_seen.sum() > 50
    x, y = np.moveaxis((local[is_seen, :2] / 4 + 1) * (size - 1) / 2, 1, 0)
    hats = [np.maximum(1 - np.abs(c[:, None] - np.arange(size)), 0) for c in (x, y)]

    def read(texels):
        return np.einsum("pi,pj,jic->pc", *hats, texels.reshape(size, size, -1))

    means = output.image.reshape(-1, output.image.shape[2])[is_seen] / alpha[is_seen, None]
    assert_allclose(means[:, slices["albedo"]], read(sigmoid(g.albedo_logits)), rtol=1e-9)
    assert_allclose(means[:, slices["roughness"]], read(sigmoid(g.roughness_logits)), rtol=1e-9)
    side = -np.sign((g.means[0] - camera.center) @ axes[:, 2])
    normals = side * read(tangent_normals(g.normal_textures.reshape(-1, 2))) @ axes.T @ R.T
    assert_allclose(means[:, slices["normal"]], normals, rtol=1e-9, atol=1e-12)


# --- baking ---


def maps_of(population, camera):
    wants = MAPS
    output, _ = TEXTURED.render(model_of(population), view_from(camera), Request(wants=wants))
    slices, alpha = TEXTURED.channels(wants), output.alpha[:, :, None]
    parts = {name: output.image[:, :, part] / np.maximum(alpha, 1e-12) for name, part in slices.items()}
    normals = parts["normal"] @ camera.cam_from_world_R
    materials = np.concatenate([parts["albedo"], parts["metallic"], parts["roughness"]], axis=2)
    return Maps(camera, normals, materials, output.alpha > 0.05)


def facing(x, y):
    """A camera that looks at the disc of :func:`one_disc` from a side."""
    R = rotation_matrices(np.array([[1.0, 0.1 * y, -0.1 * x, 0]]))[0]
    return Camera(R, np.zeros(3), 30.0, 30.0, 16.0, 12.0, 32, 24)


def test_baking_finds_the_texture_again(rng):
    """From exact maps of two views to the texels, from another texture; a weighted mean is worse."""
    truth = one_disc(0.35, 2, rng)
    truth = truth._replace(normal_textures=truth.normal_textures / 3)
    views = [maps_of(truth, facing(x, y)) for x, y in ((1, 0), (-1, 1))]
    start = with_textures(with_textures(truth, rng, texels=1), rng, texels=2)
    errors = {}
    for steps in (0, 400):
        found = bake(start, views, steps=steps, backend=CPU)
        errors[steps] = np.abs(sigmoid(found.albedo_logits) - sigmoid(truth.albedo_logits)).max()
        assert_array_equal(found.means, truth.means)
    assert errors[400] < 0.01 and errors[0] > 0.1
    assert np.abs(found.normal_textures - truth.normal_textures).max() < 0.02


def test_a_weighted_mean_by_hand(rng):
    """One disc of one texel: the mean of the map, weighted by alpha; unknown pixels do not count; both backends."""
    disc = with_textures(one_disc(0.3, 2, rng), rng, texels=1)
    camera = facing(0, 0)
    albedo = rng.uniform(0.2, 0.8, size=(24, 32, 3))
    is_known = rng.uniform(size=(24, 32)) < 0.5
    normals = np.broadcast_to([0.0, 0.6, -0.8], (24, 32, 3))
    shares = np.broadcast_to([0.25, 0.7], (24, 32, 2))
    maps = Maps(camera, normals, np.concatenate([albedo, shares], axis=2), is_known)
    output, _ = TEXTURED.render(model_of(disc), view_from(camera), Request(backend=REFERENCE))
    weights = np.where(is_known, output.alpha, 0)
    expected = np.einsum("yx,yxc->c", weights, albedo) / weights.sum()
    for backend in (CPU, REFERENCE):
        found = bake(disc, [maps], steps=0, backend=backend)
        assert_allclose(sigmoid(found.albedo_logits)[0], expected, rtol=1e-9)
        assert_allclose(sigmoid(found.metallic_logits), 0.25, rtol=1e-9)
        assert_allclose(sigmoid(found.roughness_logits), 0.7, rtol=1e-9)
        # The disc's normal is +z, away from the camera, so its texture holds the opposite of what is seen.
        assert_allclose(tangent_normals(found.normal_textures)[0], [0, -0.6, 0.8], atol=1e-9)


def test_what_no_view_sees_stays(rng):
    disc = one_disc(0.3, 2, rng)
    both = TexturedSurfels(*(np.concatenate([field, field]) for field in disc))
    both = both._replace(means=both.means + np.array([[0, 0, 0], [0, 0, -50.0]]))
    views = [maps_of(disc, facing(0, 0))]
    found = bake(both, views, steps=2)
    assert_array_equal(found.albedo_logits[1], both.albedo_logits[1])
    assert np.abs(found.albedo_logits[0] - both.albedo_logits[0]).max() > 0
    with pytest.raises(InputError, match="at least one view"):
        bake(both, [])
    with pytest.raises(InputError, match="materials have 31 x 24 pixels and the camera 32 x 24"):
        bake(both, [views[0]._replace(materials=views[0].materials[:, 1:])])
    holed = np.where(views[0].is_known[:, :, None], views[0].normals, np.nan)
    assert_array_equal(bake(both, [views[0]._replace(normals=holed)], steps=2).normal_textures, found.normal_textures)
    with pytest.raises(InputError, match="normals are not finite in some pixels that count"):
        bake(both, [views[0]._replace(normals=np.full_like(holed, np.nan))])


# --- the recipe and its files ---


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("texture_splat")
    settings = {"n_views": 3, "width": 24, "height": 18, "n_points": 60}
    write_scene(make_scene("glossy", supersampling=1, **settings), folder / "scene", settings)
    scene = str(folder / "scene")
    first = ["--recipe", "reflective", "--iterations", "10", "--out", str(folder / "reflective")]
    assert main(["train", scene, *first]) == 0
    second = ["--recipe", "texture-splat", "--init", str(folder / "reflective"), "--iterations", "6"]
    assert main(["train", scene, *second, "--set", "texels=3", "--out", str(folder / "textured")]) == 0
    return folder


def test_a_run_starts_from_reflective_surfels_and_keeps_their_centres(runs):
    before = load_ply(runs / "reflective" / "point_cloud.ply", ReflectiveSurfels)
    after = EXTENSION.load(runs / "textured" / "point_cloud.ply", TexturedSurfels)
    assert_array_equal(after.means, before.means)
    assert count_texels(after) == 3 and np.ptp(after.albedo_logits.reshape(-1, 9, 3), axis=1).max() > 0
    assert after.normal_textures.any()
    with np.load(runs / "textured" / "shared.npz") as shared:
        assert shared[STAGE] == WITH_OCCLUSION and np.ptp(shared[ENVIRONMENT]) > 0


def test_a_run_shows_its_maps_and_can_be_continued(runs, capsys):
    assert main(["render", str(runs / "textured"), "--map", "normal"]) == 0
    assert all(read_image(path).max() > 20 for path in (runs / "textured" / "views").glob("*_normal.png"))
    again = ["--recipe", "texture-splat", "--init", str(runs / "textured"), "--iterations", "1"]
    assert main(["train", str(runs / "scene"), *again, "--out", str(runs / "again")]) == 0
    assert count_texels(EXTENSION.load(runs / "again" / "point_cloud.ply", TexturedSurfels)) == 4  # the recipe's
    resumed = ["train", "--resume", str(runs / "textured"), "--iterations", "7"]
    assert main(resumed) == 0
    assert count_texels(EXTENSION.load(runs / "textured" / "point_cloud.ply", TexturedSurfels)) == 3


def test_bad_input_gets_one_line(runs, capsys):
    scene = ["train", str(runs / "scene"), "--recipe", "texture-splat", "--iterations", "1"]
    for size, init in (("0", []), ("-2", ["--init", str(runs / "reflective")]), ("None", [])):
        assert main([*scene, *init, "--set", f"texels={size}", "--out", str(runs / "none")]) == 2
        assert f"a texture of {size} x {size} texels does not exist" in capsys.readouterr().err.splitlines()[-1]
        assert not (runs / "none").exists()
    surfels = EXTENSION.load(runs / "textured" / "point_cloud.ply", TexturedSurfels)
    for name, columns, said in (
        ("metallic_logits", 5, "metallic_logits has 5 columns, where square textures of one size have T^2"),
        ("normal_textures", 17, "normal_textures has 17 columns"),
        ("roughness_logits", 1, "roughness_logits has 1 columns, where square textures of one size have T^2"),
    ):
        path = runs / f"{name}.ply"
        save_ply(path, surfels._replace(**{name: getattr(surfels, name)[:, :columns]}), EXTENSION.label)
        assert main(["render", str(path)]) == 2
        [line] = [line for line in capsys.readouterr().err.splitlines() if name in line or said in line]
        assert said in line and str(path) in line


def test_a_float32_model_stays_float32(rng):
    g = as_dtype(painted(with_textures(with_material(make_gaussians(rng, 8), rng), rng, texels=2), rng), np.float32)
    shared = {ENVIRONMENT: np.zeros((4, 8, 3), np.float32), STAGE: np.full(1, PER_PIXEL, np.float32)}
    output, tape = TEXTURED.render(Model(g, shared), view_from(make_camera()), Request())
    assert output.image.dtype == np.float32
    v = TEXTURED.render_vjp(tape, np.ones_like(output.image))
    assert all(getattr(v.gaussians, name).dtype == np.float32 for name in (*CHANNELS, "quats", "means"))
