"""Random scenes of many kinds, each at three sizes, to cover the space between the hand-made cases.

A hand-made case tests one thing at its hardest. Here every number of a kind is random, many Gaussians overlap, and
tiles, lists and sums are as long as in small trainings. Each kind has three sizes: a few Gaussians in a
thumbnail, some, and many in several tiles whose size does not divide the image's.
"""

import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, MINI_SPLATTING2
from minisplat_ref.oracle.hard_cases.scenes import (
    ANTIALIASED,
    BACKGROUND,
    camera,
    intrinsics,
    rotation_quat,
    round_to_float32,
)
from minisplat_ref.oracle.hard_cases.subjects import Call, HardCase, Parameters, Subject
from minisplat_ref.oracle.tolerances import BEHIND, DEEP, HARMONICS, LONG, ORDINARY, WORLD, HardCaseTolerance
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.types import Camera, Floats, Gaussians

SIZES = {"few": (4, 9, 7), "some": (40, 33, 21), "many": (150, 67, 45)}
ALPHA_MIN = 1 / 256  # near enough to 1/255, and a number of both precisions


class Draw(NamedTuple):
    """The parameters of a random scene."""

    rng: np.random.Generator
    n: int
    width: int
    height: int

    def view(self, **changes: object) -> Camera:
        """Return a camera at the origin, whose focal lengths are a little longer than the image is wide."""
        focal = {"fx": 1.2 * self.width, "fy": 1.1 * self.width}
        return camera(self.width, self.height, **focal | changes)

    def means(self, depths: Floats | None = None, view: Camera | None = None) -> Floats:
        """Return means [N, 3] all over a view and a little beside it, 2 to 4 units away unless told."""
        view = self.view() if view is None else view
        z = self.rng.uniform(2, 4, self.n) if depths is None else depths
        x = (self.rng.uniform(-0.1, 1.1, self.n) * view.width - view.cx) / view.fx
        y = (self.rng.uniform(-0.1, 1.1, self.n) * view.height - view.cy) / view.fy
        return np.column_stack([x * z, y * z, z])

    def log_uniform(self, low: float, high: float, *shape: int) -> Floats:
        """Return log-uniform random numbers between two bounds."""
        return np.exp(self.rng.uniform(np.log(low), np.log(high), shape))

    def gaussians(self, sh_degree: int = 0, **changes: Floats) -> Gaussians:
        """Return Gaussians of ordinary shapes; replaced arrays are rounded to float32, too."""
        rng, n = self.rng, self.n
        fields = {
            "means": self.means(),
            "quats": rng.normal(size=(n, 4)),
            "log_scales": np.log(self.log_uniform(0.02, 0.5, n, 3)),
            "opacity_logits": rng.normal(size=n),
            "sh_dc": rng.normal(size=(n, 3)),
            "sh_rest": 0.3 * rng.normal(size=(n, (sh_degree + 1) ** 2 - 1, 3)),
        }
        return Gaussians(**{name: round_to_float32(value) for name, value in (fields | changes).items()})

    def call(self, n_channels: int = 3, options: dict | None = None, **changes: Floats) -> Call:
        """Return the same activated."""
        view, rng, n = self.view(), self.rng, self.n
        arrays = {
            "means": self.means(),
            "quats": rng.normal(size=(n, 4)),
            "scales": self.log_uniform(0.02, 0.5, n, 3),
            "opacities": rng.uniform(size=n),
            "colors": rng.uniform(size=(n, n_channels)),
            "viewmats": np.eye(4)[None],
            "Ks": intrinsics(view.fx, view.fy, view.cx, view.cy),
        }
        arrays = {name: round_to_float32(value) for name, value in (arrays | changes).items()}
        backgrounds = np.resize(BACKGROUND, (1, n_channels))
        return Call(arrays, self.width, self.height, {"backgrounds": backgrounds, **(options or {})})


def _draw_scales(low: float, high: float, **changes: object) -> Callable[[Draw], Subject]:
    """Scales between two numbers, for each axis by itself."""
    return lambda d: Parameters(
        d.gaussians(log_scales=np.log(d.log_uniform(low, high, d.n, 3))),
        d.view(),
        **changes,  # type: ignore[arg-type]
    )


def _draw_shapes(long: float, short: float, n_long: int) -> Callable[[Draw], Subject]:
    """One or two axes of a length and the others of another, rotated at random."""

    def make(d: Draw) -> Subject:
        axes = np.where(np.arange(3) < n_long, long, short) * d.log_uniform(0.3, 3, d.n, 3)
        return Parameters(d.gaussians(log_scales=np.log(axes)), d.view())

    return make


def _spread_depths(low: float, high: float, **options: object) -> Callable[[Draw], Subject]:
    """Depths from one number to another, logarithms uniform; footprints of some pixels."""

    def make(d: Draw) -> Subject:
        z = d.log_uniform(low, high, d.n)
        scales = d.log_uniform(0.01, 0.2, d.n, 3) * z[:, None]
        return d.call(means=d.means(z), scales=scales, options=options)

    return make


def _surround_camera(d: Draw) -> Subject:
    return Parameters(
        d.gaussians(means=d.rng.normal(size=(d.n, 3)), log_scales=np.log(d.log_uniform(0.1, 3, d.n, 3))), d.view()
    )


def _touch_near_plane(d: Draw) -> Subject:
    z = 0.5 + np.spacing(np.float32(0.5)) * d.rng.integers(-2, 3, d.n)
    return d.call(means=d.means(z), scales=d.log_uniform(1e-3, 0.05, d.n, 3), options={"near_plane": 0.5})


def _pick_opacities(values: list[float], n_ulps: int = 2, **options: object) -> Callable[[Draw], Subject]:
    """Opacities at the given numbers, and a few units in the last place away."""

    def make(d: Draw) -> Subject:
        chosen = d.rng.choice(np.array(values, np.float32), d.n)
        chosen = chosen + d.rng.integers(-n_ulps, n_ulps + 1, d.n) * np.spacing(chosen)
        chosen[-1] = 0.5  # one that is surely seen
        return d.call(opacities=np.clip(chosen, 0, 1), options=options)

    return make


def _pick_bytes(d: Draw) -> Subject:
    """Any byte, half of them at most 3."""
    return d.call(opacities=d.rng.integers(0, 256, d.n) // d.rng.choice([1, 64], d.n) / 255)


def _coincident(d: Draw) -> Subject:
    means = d.means()
    return Parameters(d.gaussians(means=means[d.rng.integers(0, max(1, d.n // 8), d.n)]), d.view())


def _one_depth(d: Draw) -> Subject:
    return Parameters(d.gaussians(means=d.means(np.full(d.n, 3.0))), d.view())


def _wall(d: Draw) -> Subject:
    """One depth before a camera that is rotated against the world's axes: rounding the means decides the order."""
    R = rotation_matrices(rotation_quat(0.7, (1, 2, 3))[None])[0]
    means = d.means(np.full(d.n, 4.0)) @ R
    view = d.view(cam_from_world_R=R)
    log_scales = np.log(d.log_uniform(0.02, 0.1, d.n, 3))
    return Parameters(d.gaussians(means=means, log_scales=log_scales), view)


def _layers(logit: float) -> Callable[[Draw], Subject]:
    """Eight times as many, each over the whole image."""

    def make(d: Draw) -> Subject:
        d = d._replace(n=8 * d.n, width=min(d.width, 12), height=min(d.height, 9))
        means = np.column_stack([d.rng.normal(0, 0.1, (d.n, 2)), d.rng.uniform(2, 4, d.n)])
        log_scales = np.log(d.log_uniform(0.5, 2, d.n, 3))
        logits = logit + d.rng.normal(size=d.n)
        return Parameters(d.gaussians(means=means, log_scales=log_scales, opacity_logits=logits), d.view())

    return make


def _strip(is_wide: bool) -> Callable[[Draw], Subject]:
    def make(d: Draw) -> Subject:
        view = d._replace(width=d.width if is_wide else 1, height=1 if is_wide else d.width).view(fx=50.0, fy=50.0)
        return Parameters(d.gaussians(means=d.means(view=view)), view)

    return make


def _principal_point(d: Draw) -> Subject:
    view = d.view(cx=float(d.width * d.rng.choice([-40, 30])), cy=float(d.height * d.rng.choice([-20, 50])))
    log_scales = np.log(d.log_uniform(0.005, 0.1, d.n, 3))
    return Parameters(d.gaussians(means=d.means(view=view), log_scales=log_scales), view)


def _focal(fx: float, fy: float) -> Callable[[Draw], Subject]:
    """Focal lengths in widths of the image."""

    def make(d: Draw) -> Subject:
        view = d.view(fx=fx * d.width, fy=fy * d.width)
        log_scales = np.log(d.log_uniform(0.02, 0.5, d.n, 3) / max(fx, fy))
        return Parameters(d.gaussians(means=d.means(view=view), log_scales=log_scales), view)

    return make


def _harmonics(d: Draw) -> Subject:
    rest = d.rng.normal(size=(d.n, 15, 3)) * d.log_uniform(1, 1e5, d.n, 1, 1)
    return Parameters(d.gaussians(sh_rest=rest), d.view())


def _world(d: Draw) -> Subject:
    R = rotation_matrices(d.rng.normal(size=(1, 4)))[0]
    centre = np.array([448e3, 5412e3, 300]) + d.rng.uniform(-1, 1, 3)
    means = round_to_float32(50 * d.means() @ R + centre)
    log_scales = np.log(d.log_uniform(1, 25, d.n, 3))
    view = d.view(cam_from_world_R=R, cam_from_world_t=-R @ centre)
    return Parameters(d.gaussians(means=means, log_scales=log_scales), view)


def _quaternions(d: Draw) -> Subject:
    quats = d.rng.normal(size=(d.n, 4)) * d.log_uniform(1e-30, 1e30, d.n, 1)
    return Parameters(d.gaussians(quats=quats), d.view())


def _align_with_axes(d: Draw) -> Subject:
    """Draw axes on the world's axes, or nearly, and equal scales, where a rotation's derivatives vanish."""
    quats = np.eye(4)[d.rng.integers(0, 4, d.n)] + d.rng.choice([0, 1e-20, 1e-7], (d.n, 1)) * d.rng.normal(
        size=(d.n, 4)
    )
    scales = d.rng.choice([0.05, 0.2], (d.n, 3))
    return Parameters(d.gaussians(quats=quats, log_scales=np.log(scales)), d.view())


def _log_scales_40(d: Draw) -> Subject:
    """Nearly balls: of a needle with these ends, the reference could not distinguish the thin axis from rounding."""
    sizes = d.rng.uniform(-40, 40, (d.n, 1)) + d.rng.uniform(-1, 1, (d.n, 3))
    return Parameters(d.gaussians(log_scales=sizes), d.view())


def _logits(d: Draw) -> Subject:
    return Parameters(d.gaussians(opacity_logits=d.rng.uniform(-40, 40, d.n)), d.view())


def _channels(n_channels: int) -> Callable[[Draw], Subject]:
    return lambda d: d.call(n_channels)


def _hit_tile_edges(d: Draw) -> Subject:
    """Centres on the corners of tiles of 16 and 32 pixels, of pixels, and on pixel centres."""
    view = d.view(fx=128.0, fy=128.0, cx=float(d.width // 2), cy=float(d.height // 2))
    pixels = np.column_stack([d.rng.choice([0, 15.5, 16, 16.5, 32, d.width], d.n), d.rng.choice([0, 8, 16, 32], d.n)])
    z = d.rng.choice([2.0, 4.0], d.n)
    means = np.column_stack([(pixels - [view.cx, view.cy]) / 128 * z[:, None], z])
    return Parameters(d.gaussians(means=means, log_scales=np.log(d.log_uniform(0.005, 0.1, d.n, 3))), view)


def _place_aside(d: Draw) -> Subject:
    """Up to a thousand widths beside the view, and as large as far away: each covers the image still."""
    far = d.log_uniform(1, 1e3, d.n)
    angle = d.rng.uniform(0, 2 * np.pi, d.n)
    means = np.column_stack([far * np.cos(angle), far * np.sin(angle), d.rng.uniform(0.5, 2, d.n)])
    log_scales = np.log(far[:, None] * d.log_uniform(0.3, 3, d.n, 3))
    return Parameters(d.gaussians(means=means, log_scales=log_scales), d.view())


def _follow(conventions: object) -> Callable[[Draw], Subject]:
    """Shapes of all sizes by the rules of another rasteriser."""
    return _draw_scales(1e-3, 3, conventions=conventions)


def _everything(d: Draw) -> Subject:
    """Each Gaussian may be needle, disc, dot or wall, near or far, opaque or faint."""
    z = d.log_uniform(0.05, 100, d.n)
    scales = d.log_uniform(1e-5, 10, d.n, 3) * z[:, None]
    quats = d.rng.normal(size=(d.n, 4)) * d.log_uniform(1e-10, 1e10, d.n, 1)
    logits = d.rng.uniform(-8, 8, d.n)
    return Parameters(
        d.gaussians(3, means=d.means(z), log_scales=np.log(scales), quats=quats, opacity_logits=logits), d.view()
    )


class Kind(NamedTuple):
    """Random scenes that are hard for one reason."""

    name: str
    why: str
    correct: str
    make: Callable[[Draw], Subject]
    tolerance: HardCaseTolerance = ORDINARY


SHARP = "the sum of their footprints, as float64 has it"
KINDS = (
    Kind("needles", "axis ratio of 1e3 and more at all angles", SHARP, _draw_shapes(1, 1e-3, 1), LONG),
    Kind("discs", "thickness 1e-3 of the width at all angles, some edge-on", SHARP, _draw_shapes(0.5, 5e-4, 2), LONG),
    Kind("enormous", "each covers the image many times", "nearly constant layers", _draw_scales(1e2, 1e5), BEHIND),
    Kind("sub-pixel", "footprints are nothing but the low-pass", "dots", _draw_scales(1e-6, 1e-3)),
    Kind("of-all-scales", "axis ratios up to 1e8 in one Gaussian", SHARP, _draw_scales(1e-6, 1e2), LONG),
    Kind("log-scales-plus-minus-40", "scales from 1e-18 to 1e17", SHARP, _log_scales_40, BEHIND),
    Kind(
        "near-plane", "on the near plane and one or two roundings beside it", "only what is beyond", _touch_near_plane
    ),
    Kind("of-all-depths", "depths from the near plane to the far one", SHARP, _spread_depths(0.011, 1e9)),
    Kind("around-the-camera", "behind, beside and over the camera", "only what is before it", _surround_camera, BEHIND),
    Kind(
        "far-beside", "up to a thousand widths away, covering the image", "gentle slopes of alpha", _place_aside, LONG
    ),
    Kind(
        "opacities-at-thresholds",
        "0, alpha_min, the clamp and 1, and a few roundings beside them",
        "each on its side; flips at the peaks only",
        _pick_opacities([0, ALPHA_MIN, 0.99, 1], profile=GSPLAT_MAIN._replace(alpha_min=ALPHA_MIN)),
        BEHIND,
    ),
    Kind("opacities-of-bytes", "k / 255, as .splat files hold them: 1 / 255 is alpha_min", SHARP, _pick_bytes, BEHIND),
    Kind("logits-plus-minus-40", "opacities of 0 and 1 but for rounding", SHARP, _logits, BEHIND),
    Kind(
        "coincident-means", "eight at each place, of one depth to all digits", "in the order of the rows", _coincident
    ),
    Kind("one-depth", "all of one depth", "in the order of the rows", _one_depth),
    Kind("wall", "one depth but for the rounding of the means", "any order of what float32 cannot tell apart", _wall),
    Kind(
        "faint-layers",
        "hundreds to thousands over every pixel",
        "T at the stop after as many layers",
        _layers(-4),
        DEEP,
    ),
    Kind("opaque-layers", "few of hundreds count", "no gradient behind the stop", _layers(3), BEHIND),
    Kind("strip-wide", "an image of one line", "as a cut from a larger image", _strip(True)),
    Kind("strip-tall", "an image of one column", "as a cut from a larger image", _strip(False)),
    Kind("principal-point-far-outside", "the axis passes tens of images beside", "an oblique view", _principal_point),
    Kind("focal-tiny", "a field of view of 179 degrees", "frozen Jacobians at the edges", _focal(0.01, 0.01)),
    Kind("focal-huge", "a field of view of a thousandth of a degree", "a telescope's view", _focal(1e5, 1e5)),
    Kind("focal-unequal", "pixels 1000 times taller than wide", "stretched footprints", _focal(100, 0.1), LONG),
    Kind("harmonics", "coefficients of degree 3 up to 1e5", "their sum, clamped at 0", _harmonics, HARMONICS),
    Kind("world", "UTM coordinates, 5e6 metres from the origin", "the image of the means as rounded", _world, WORLD),
    Kind("quaternion-lengths", "|q| from 1e-30 to 1e30", "length does not matter", _quaternions),
    Kind("turns-on-axes", "quaternions with zeros, and scales that are equal", "finite gradients", _align_with_axes),
    Kind("channels-1", "one channel, where kernels keep three", "as many channels", _channels(1)),
    Kind("channels-4", "one more channel than kernels keep together", "as many channels", _channels(4)),
    Kind("tile-edges", "centres and boxes on edges of tiles and pixels", "each in all its tiles", _hit_tile_edges),
    Kind("inria", "boxes of three sigma, whole tiles", "INRIA's image and gradient", _follow(INRIA)),
    Kind("gsplat-1.5", "alpha up to 0.999", "its image and gradient", _follow(GSPLAT_1_5)),
    Kind("mini-splatting2", "tight boxes, INRIA's stop", "its image and gradient", _follow(MINI_SPLATTING2)),
    Kind("antialiased", "compensations from their floor to one", "dimmed dots", _follow(ANTIALIASED)),
    Kind("everything", "all of it at once", SHARP, _everything, LONG),
)


def _case(kind: Kind, size: str) -> HardCase:
    name = f"{kind.name}-{size}"

    def build() -> Subject:
        return kind.make(Draw(np.random.default_rng(zlib.crc32(name.encode())), *SIZES[size]))

    return HardCase(name, kind.why, kind.correct, build, kind.tolerance)


RANDOM_SCENES = tuple(_case(kind, size) for kind in KINDS for size in SIZES)
