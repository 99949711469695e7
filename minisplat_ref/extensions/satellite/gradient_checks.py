"""The stages of the gradient check: the renderer with an affine camera and the sun's shadows, all channels.

Its kinks besides those of splatting: alpha at 0.05, where h passes h_s, the borders of the bilinear cells, the border
of the sun's image, and colours at 0. A difference across one of them is refused.

Ties are no kinks. A pixel that a lone Gaussian covers, in the photograph and in the sun's image, has ``h = h_s`` and
equal neighbours wherever the Gaussian moves; rounding decides which is larger, and every step would be refused. Values
less than :data:`TIE` apart count as equal.
"""

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.satellite.affine_fit import AFFINE
from minisplat_ref.extensions.satellite.method import SEEN_FROM_ABOVE
from minisplat_ref.extensions.satellite.reference import MIN_ALPHA
from minisplat_ref.extensions.satellite.renderer import CHANNELS, Tape
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Camera, Optics

ALL = frozenset(CHANNELS)
TIE = 1e-12
"""Of a shadow or a slope, in float64: a thousand roundings of values near 1."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer with the sun: by an orthographic camera, instead of that without, and by an affine one.

    The affine camera, as those of satellites, has depths of both signs.
    """
    per_unit = np.array([setting.camera.fx, setting.camera.fy, 1.0]) / 3  # the Gaussians lie at depth 3
    shift = 1.3, -0.9
    A = per_unit[:, None] * (setting.camera.cam_from_world_R + 0.02 * rng.normal(size=(3, 3)))
    b = per_unit * setting.camera.cam_from_world_t + [setting.camera.width / 2, setting.camera.height / 2, -1]
    flat = setting.camera._replace(fx=per_unit[0], fy=per_unit[1], optics=Optics("orthographic", shift))
    affine = Camera(A, b, 1.0, 1.0, 0.0, 0.0, flat.width, flat.height, Optics(AFFINE, shift))
    name = SEEN_FROM_ABOVE.name
    return _stage(backend, setting, flat, name, rng), _stage(backend, setting, affine, f"{name}, {AFFINE}", rng)


def _stage(backend: Backend, setting: Setting, camera: Camera, name: str, rng: np.random.Generator) -> Stage:
    named = SEEN_FROM_ABOVE._replace(name=name)
    seen = setting._replace(camera=camera)
    return model_stage(backend, seen, named, rng, wants=ALL, sides_of=_sides, fixed=("sh_rest",))  # which is empty


def _sides(drawn: Drawn) -> list[np.ndarray]:
    tape: Tape = drawn.tape
    assert tape.of_sun is not None and tape.shadow is not None
    faint = [part.output.alpha > MIN_ALPHA for part in (tape.seen, tape.of_sun)]
    inside = np.abs(tape.shadow.sampled.slopes) > TIE
    is_shaded, is_lit = tape.shadow.shadows < 1 - TIE, SH_C0 * drawn.model.gaussians.sh_dc + 0.5 > 0
    return [*faint, is_shaded, tape.shadow.sampled.corners, inside, is_lit]
