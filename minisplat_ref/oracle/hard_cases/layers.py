"""Opacities at both ends, hits on a threshold, and more layers over a pixel than it can show."""

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, MINI_SPLATTING2
from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, gaussians, rotation_quat, round_to_float32
from minisplat_ref.oracle.hard_cases.subjects import HardCase, Parameters
from minisplat_ref.oracle.tolerances import BEHIND, DEEP
from minisplat_ref.reference.covariance import rotation_matrices

ALPHA_MIN = float(np.float32(1 / 255))
AT_1_OF_256 = GSPLAT_MAIN._replace(name="AT_1_OF_256", alpha_min=1 / 256)


def _stack(n: int, logit: float, **changes: object) -> Parameters:
    """One Gaussian behind the other, all over the image."""
    means = np.column_stack([np.zeros((n, 2)), np.linspace(2, 4, n)])
    return Parameters(gaussians(means, 1.0, logits=logit), camera(6, 5), **changes)  # type: ignore[arg-type]


def _wall() -> Parameters:
    rng, R = np.random.default_rng(8), rotation_matrices(rotation_quat(0.7, (1, 2, 3))[None])[0]
    on_wall = np.column_stack([rng.uniform((-1.6, -1.2), (1.6, 1.2), size=(100, 2)), np.full(100, 4.0)])
    wall = gaussians(on_wall @ R, 0.05, logits=rng.normal(1, 1, 100))
    return Parameters(wall, camera(48, 36, fx=60.0, fy=60.0, cam_from_world_R=R))


def _seen_through_layers() -> Parameters:
    """A faint needle behind three layers that let 0.02 % through; its short quaternion has the longest gradient."""
    population = gaussians([[0, 0, 2], [0, 0, 2.5], [0, 0, 3], [0.1, 0.05, 4]], [[1.0] * 3] * 3 + [[0.05, 0.02, 0.02]])
    quats, logits = population.quats.copy(), np.array([2.9, 2.9, 2.9, -3.0])
    quats[3] *= 2.0**-20
    return Parameters(population._replace(quats=quats, opacity_logits=round_to_float32(logits)), camera())


LAYERS = (
    HardCase(
        "logit-plus-30",
        "1 - sigmoid(30) is 0 in float32, so o (1 - o) has no digit",
        "opaque; alpha stops at its clamp, and so does the gradient",
        lambda: Parameters(cloud(opacity_logits=np.full(30, 30.0)), camera()),
        BEHIND,
    ),
    HardCase(
        "logit-plus-9",
        "1 - o = 1e-4 has three digits in float32 where it is a difference",
        "a gradient with respect to the logit with all digits",
        lambda: Parameters(cloud(scales=0.3, opacity_logits=np.full(30, 9.0)), camera()),
        BEHIND,
    ),
    HardCase(
        "logit-minus-30",
        "opacity 1e-13, below any threshold",
        "culled: the background",
        lambda: Parameters(cloud(opacity_logits=np.full(30, -30.0)), camera()),
        is_background=True,
    ),
    HardCase(
        "logits-plus-minus-30",
        "opaque and invisible, alternating",
        "only the opaque are drawn and have gradients",
        lambda: Parameters(cloud(opacity_logits=np.tile([30.0, -30.0], 15)), camera()),
        BEHIND,
    ),
    HardCase(
        "logits-that-overflow",
        "exp(1000) is infinite in both precisions",
        "opacity 0 or 1, gradient 0, no warning",
        lambda: Parameters(cloud(opacity_logits=np.tile([1e3, -1e3, 0.5], 10)), camera()),
        BEHIND,
    ),
    HardCase(
        "opacity-0",
        "exactly 0: its logarithm is -inf",
        "the background",
        lambda: call([[0, 0, 3.0]], opacities=0.0),
        is_background=True,
    ),
    HardCase(
        "opacity-1",
        "exactly 1: without the clamp T would be 0",
        "alpha_max at the centre",
        lambda: call([[0, 0, 3.0]], opacities=1.0),
    ),
    HardCase(
        "opacity-1-of-many",
        "every hit is at the clamp; backward divides by 1 - 0.99",
        "two hits end a pixel",
        lambda: call(np.column_stack([np.zeros((20, 2)), np.linspace(2, 4, 20)]), 2.0, 1.0),
        BEHIND,
    ),
    HardCase(
        "alpha-at-1-of-255",
        "the peak's alpha is alpha_min itself, where a hit begins to count",
        "a hit or none, counted as a flip; never more than 1/255",
        lambda: call([[0, 0, 3.0], [0.3, 0.2, 4]], opacities=[ALPHA_MIN, 0.5]),
    ),
    HardCase(
        "opacities-around-alpha-min",
        "alpha_min itself, which 1/256 is in every precision, one rounding below and one above",
        "below and at it culled: the extent is nothing; above it one pixel, which a centre on the mean's place may hit",
        lambda: call(
            [[0.013, 0.007, 3], [0.11, 0.17, 3], [0, 0, 3.0], [0.3, 0.2, 4]],
            opacities=[float(opacity) for opacity in (*_list_neighbours(np.float32(1 / 256)), 0.5)],
            profile=AT_1_OF_256,
        ),
    ),
    HardCase(
        "opacities-around-alpha-min-inria",
        "the same where the extent does not depend on the opacity",
        "below it culled; at it and above drawn, as far as alpha reaches",
        lambda: call(
            [[0.013, 0.007, 3], [0.11, 0.17, 3], [0, 0, 3.0], [0.3, 0.2, 4]],
            opacities=[float(opacity) for opacity in (*_list_neighbours(np.float32(1 / 256)), 0.5)],
            profile=AT_1_OF_256._replace(has_full_support=False),
        ),
    ),
    HardCase(
        "opacity-at-alpha-min",
        "a Gaussian of radius 0 whose box holds a pixel: it must be in no list, since nothing writes its record",
        "culled: the background",
        lambda: call([[0.013, 0.007, 3]], opacities=1 / 256, profile=AT_1_OF_256),
        is_background=True,
    ),
    HardCase(
        "opacity-of-one-byte",
        "1 / 255 as a .splat file gives it: in float32 alpha_min itself, and by a rounding more than float64's",
        "one dot at most, fainter than any image shows",
        lambda: call([[0.013, 0.007, 3], [0.3, 0.2, 4]], opacities=[ALPHA_MIN, 0.5]),
    ),
    HardCase(
        "opacity-below-1-of-255",
        "one float32 below alpha_min",
        "culled: the background",
        lambda: call([[0, 0, 3.0]], opacities=float(np.nextafter(np.float32(ALPHA_MIN), np.float32(0)))),
        is_background=True,
    ),
    HardCase(
        "alpha-at-the-clamp",
        "the peak's alpha is alpha_max, where its gradient ends",
        "the same image either way; the pixel is counted",
        lambda: call([[0, 0, 3.0], [0.3, 0.2, 4]], opacities=[float(np.float32(0.99)), 0.5]),
    ),
    HardCase(
        "transmittance-at-the-stop",
        "two clamped hits leave (1 - 0.99)^2, which is the stop threshold but for rounding",
        "the second hit counts or not, a flip of at most 1 %",
        lambda: call([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]], opacities=1.0),
        BEHIND,
    ),
    HardCase(
        "transmittance-at-the-stop-inria",
        "INRIA stops below the threshold, not at it",
        "as above, with the other comparison",
        lambda: call([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]], opacities=1.0, profile="INRIA"),
        BEHIND,
    ),
    HardCase(
        "clamp-0.999",
        "gsplat 1.5 clamps at 0.999: backward divides by 1e-3",
        "one opaque hit leaves 1e-3, the second ends the pixel",
        lambda: _stack(10, 8.0, conventions=GSPLAT_1_5),
        BEHIND,
    ),
    HardCase(
        "saturated-inria",
        "INRIA passes the gradient through the clamp",
        "its gradient, not the derivative",
        lambda: Parameters(cloud(scales=0.4, opacity_logits=np.full(30, 6.0)), camera(), conventions=INRIA),
        BEHIND,
    ),
    HardCase(
        "saturated-mini-splatting2",
        "passes it to the means only",
        "its gradient, not the derivative",
        lambda: Parameters(cloud(scales=0.4, opacity_logits=np.full(30, 6.0)), camera(), conventions=MINI_SPLATTING2),
        BEHIND,
    ),
    HardCase(
        "4000-faint-layers",
        "a product of 1,500 factors before the stop",
        "T at the stop after the same number of layers, to rounding",
        lambda: _stack(4000, -5.0),
        DEEP,
    ),
    HardCase(
        "4000-opaque-layers",
        "only the first few count",
        "no gradient behind the stop",
        lambda: _stack(4000, 4.0),
        BEHIND,
    ),
    HardCase(
        "layers-of-all-opacities",
        "2000 layers, opacities from 1e-4 to 1",
        "the order of depths decides",
        lambda: Parameters(
            _stack(2000, 0.0).gaussians._replace(opacity_logits=round_to_float32(np.linspace(-9, 3, 2000))),
            camera(6, 5),
        ),
        DEEP,
    ),
    HardCase(
        "equal-depths",
        "thirty Gaussians at one depth",
        "blended in the order of their rows, in every precision",
        lambda: call(np.column_stack([np.random.default_rng(1).uniform(-0.3, 0.3, size=(30, 2)), np.full(30, 3.0)])),
    ),
    HardCase(
        "same-gaussian-fifty-times",
        "equal in everything but the colour",
        "blended in the order of their rows",
        lambda: call(np.tile([[0, 0, 3.0]], (50, 1)), opacities=0.2),
    ),
    HardCase(
        "depths-one-ulp-apart",
        "neighbouring float32 depths, in reverse order of the rows",
        "sorted by the last bit",
        lambda: call(_ulp_depths(), opacities=0.4),
    ),
    HardCase(
        "median-depth",
        "layers that take T through one half at other depths in every pixel",
        "the depth of the hit that crosses one half, 0 where none does",
        lambda: Parameters(cloud(scales=0.3), camera(), with_median_depth=True),
    ),
    HardCase(
        "median-depth-at-one-half",
        "alpha is one half: T is 0.5 but for rounding, and the crossing is at below one half",
        "the second hit's depth, or a counted pixel",
        lambda: Parameters(gaussians([[0, 0, 2], [0, 0, 3]], 0.5, logits=0.0), camera(9, 9), with_median_depth=True),
    ),
    HardCase(
        "wall-facing-a-turned-camera",
        "a wall of depth 4: rounding its means spreads their depths by 1e-7, which float32 cannot tell apart",
        "blended in the order of that noise, or of the rows; pixels with two of them are flips",
        _wall,
    ),
    HardCase(
        "alone-behind-opaque-layers",
        "what is left behind three opaque hits is a difference from the whole pixel, and here the whole gradient",
        "the gradient with respect to a short quaternion, to three digits less than others",
        _seen_through_layers,
        BEHIND,
    ),
    HardCase(
        "subnormal-gradients",
        "derivatives with respect to the image of 1e-40: subnormal in float32, their products are 0",
        "finite gradients, as good as zero",
        lambda: Parameters(cloud(), camera(), cotangent_scale=1e-40),
    ),
    HardCase(
        "huge-gradients",
        "derivatives with respect to the image of 1e20: their squares are beyond float32",
        "1e20 times the gradient",
        lambda: Parameters(cloud(), camera(), cotangent_scale=1e20),
    ),
    HardCase(
        "stop-at-zero",
        "transmittance_min is 0: no pixel is ever finished",
        "all layers are blended; T may become subnormal",
        lambda: _stack(60, 6.0, conventions=GSPLAT_MAIN._replace(name="NO_STOP", transmittance_min=0.0)),
        BEHIND,
    ),
)


def _list_neighbours(number: np.float32) -> tuple[np.float32, np.float32, np.float32]:
    """Return a number between its neighbours."""
    return np.nextafter(number, np.float32(0)), number, np.nextafter(number, np.float32(1))


def _ulp_depths() -> np.ndarray:
    depths = 3 + np.arange(20)[::-1] * float(np.spacing(np.float32(3)))
    return np.column_stack([np.random.default_rng(2).uniform(-0.2, 0.2, size=(20, 2)), depths])
