"""Scenes of one to forty Gaussians, each of which isolates one rule of a renderer, and their camera.

The contract: a PLY in the 3DGS layout, the view matrix and the intrinsics in OpenCV's axes, the size in pixels, and a
background. A renderer answers with the pixels. Colours are such that 8 bits show the rule.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0, Conventions
from minisplat_ref.io.ply import save_ply
from minisplat_ref.oracle.golden.format import Golden
from minisplat_ref.oracle.golden.running import run_stages
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import REFERENCE
from minisplat_ref.types import Camera, Floats, Gaussians

WIDTH, HEIGHT, FOCAL = 96, 64, 80.0  # px
BLACK, WHITE, RED = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1.0, 0.0, 0.0)
ROUND = (1.0, 0.0, 0.0, 0.0)  # quaternion
UNSEEN = -5.3  # logit of an opacity of 1.3/255, which loaders do not drop
UNSEEN_DEPTH = 12.0
TURNED = (0.9, 0.3, -0.2, 0.25)


class Probe(NamedTuple):
    """One scene, one picture."""

    name: str
    rule: str
    """That it isolates."""
    gaussians: Gaussians
    background: tuple[float, float, float] = BLACK
    centre: tuple[float, float] = (WIDTH / 2, HEIGHT / 2)
    """Principal point, px."""
    cam_from_world: tuple[tuple[float, ...], Floats] = (ROUND, np.zeros(3))
    """Rotation as a quaternion, and translation."""
    is_single: bool = True
    """Whether one rule is shown, so that planted faults are tried."""

    @property
    def camera(self) -> tuple[Floats, Floats]:
        """Return R and t."""
        return rotation_matrices(np.array([self.cam_from_world[0]]))[0], np.asarray(self.cam_from_world[1])


def _one(
    pixel: tuple[float, float],
    depth: float,
    sigmas: tuple[float, float, float] | float,
    opacity: float,
    color: tuple[float, float, float] = WHITE,
    quat: tuple[float, ...] = ROUND,
) -> dict[str, Any]:
    """Return a Gaussian at a pixel, with deviations in pixels at its depth."""
    x, y = (pixel[0] - WIDTH / 2) / FOCAL * depth, (pixel[1] - HEIGHT / 2) / FOCAL * depth
    scales = np.broadcast_to(sigmas, 3) * abs(depth) / FOCAL
    return {
        "means": (x, y, depth),
        "quats": quat,
        "log_scales": np.log(scales),
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "sh_dc": (np.array(color) - 0.5) / SH_C0,
    }


def _scene(*rows: dict[str, Any], sh_rest: Floats | None = None) -> Gaussians:
    fields = {name: np.array([row[name] for row in rows], np.float32) for name in rows[0]}
    rest = np.zeros((len(rows), 0, 3), np.float32) if sh_rest is None else sh_rest.astype(np.float32)
    return Gaussians(**fields, sh_rest=rest)


def _crowd() -> Gaussians:
    rng = np.random.default_rng(0)
    rows = [
        _one(
            (rng.uniform(5, WIDTH - 5), rng.uniform(5, HEIGHT - 5)),
            rng.uniform(2, 6),
            tuple(rng.uniform(1, 7, 3)),
            rng.uniform(0.3, 0.9),
            tuple(rng.uniform(0.1, 0.9, 3)),
            tuple(rng.normal(size=4)),
        )
        for _ in range(40)
    ]
    return _scene(*rows)


def _faint() -> list[dict[str, Any]]:
    return [_one((47, 31), 3 + 0.01 * k, 8.0, 0.9 / 255) for k in range(40)]


def _harmonics() -> Gaussians:
    """Two broad Gaussians whose colours by degree 3 are positive, and below 0 in red, before a grey one."""
    rng = np.random.default_rng(1)
    rows = [_one((30, 30), 3, 6.0, 0.8, (0.5, 0.5, 0.5)), _one((66, 34), 3, 6.0, 0.8, (-0.3, 0.6, 0.4))]
    rest = 0.12 * rng.normal(size=(2, 15, 3))
    return _scene(*rows, _one((48, 32), 5, 20.0, 0.6, (0.5, 0.5, 0.5)), sh_rest=np.vstack([rest, np.zeros((1, 15, 3))]))


PROBES = (
    Probe("centre", "the centre of a pixel at 0.5, the exponent, sRGB", _scene(_one((41.3, 27.8), 4, 3.0, 0.8))),
    Probe("tiny", "the low-pass: a Gaussian of 0.1 pixel", _scene(_one((40.9, 30.7), 4, 0.1, 0.9))),
    Probe("disc", "a round Gaussian on the axis, whose eigenvectors are any", _scene(_one((48, 32), 4, 5.0, 0.8))),
    Probe("needle", "an ellipse, turned", _scene(_one((50, 30), 4, (9.0, 2.0, 4.0), 0.9, WHITE, TURNED))),
    Probe("tail", "how far a Gaussian reaches", _scene(_one((47.3, 31.2), 4, 6.0, 0.99, WHITE, TURNED))),
    Probe("border", "centres beyond the border", _scene(_one((-3, 20), 4, 5.0, 0.9), _one((100, 40), 4, 5.0, 0.9))),
    Probe("faint", "the least alpha: forty of opacity 0.9/255", _scene(*_faint())),
    Probe(
        "opaque",
        "the largest alpha: black of opacity 0.9999 before white",
        _scene(_one((47, 31), 3, 6.0, 0.9999, BLACK), _one((47, 31), 4, 14.0, 0.9999)),
    ),
    Probe(
        "order",
        "order by z or by distance: red has the larger z and the smaller distance",
        _scene(_one((47, 31), 4.0, 40.0, 0.8, RED), _one((90, 30), 3.7, 40.0, 0.8)),
    ),
    Probe(
        "equal",
        "order at one depth: the first of the file is in front",
        _scene(_one((44, 31), 4, 7.0, 0.9, RED), _one((52, 31), 4, 7.0, 0.9)),
    ),
    Probe("harmonics", "degree 3, and colours below 0", _harmonics()),
    Probe("bright", "colours above 1", _scene(_one((47, 31), 4, 8.0, 0.5, (1.8, 0.5, 1.2)))),
    Probe(
        "near",
        "the near plane: z of 0.15, and one behind the camera",
        _scene(_one((30, 31), 0.15, 5.0, 0.8), _one((66, 32), -3, 5.0, 0.8)),
    ),
    Probe("huge", "a Gaussian of 2,000 pixels", _scene(_one((47, 31), 4, 2000.0, 0.5, (0.3, 0.6, 0.9)))),
    Probe(
        "beside",
        "the Jacobian far from the axis",
        _scene(_one((-60, 32), 1.0, (60.0, 8.0, 60.0), 0.9, WHITE, TURNED)),
    ),
    Probe(
        "background",
        "the background, premultiplied or not",
        _scene(_one((41.3, 27.8), 4, 5.0, 0.6, RED)),
        (0.2, 0.6, 0.8),
    ),
    Probe(
        "off-centre",
        "a principal point beside the middle",
        _scene(_one((60, 40), 4, 4.0, 0.8)),
        BLACK,
        (30.0, 40.0),
    ),
    Probe(
        "turned",
        "a view that is turned and moved",
        _scene(_one((50, 30), 4, (7.0, 2.0, 4.0), 0.9, WHITE, TURNED)),
        cam_from_world=((0.98, 0.05, -0.1, 0.1), np.array([0.2, -0.1, 0.3])),
    ),
    Probe("crowd", "all of it: forty Gaussians", _crowd(), is_single=False),
)


def with_unseen(probe: Probe, n_more: int) -> Gaussians:
    """Return a probe's Gaussians, and black ones of little opacity in a corner, for viewers that need some.

    They are so far behind, and to the lower right, that GaussianSplats3D has them last in its buffer, and loses one.
    """
    last = Gaussians._make(field[-1:].copy() for field in probe.gaussians)
    R, t = probe.camera
    corner = np.array([(WIDTH - 1 - probe.centre[0]) / FOCAL, (HEIGHT - 1 - probe.centre[1]) / FOCAL, 1.0])
    unseen = last._replace(
        means=((UNSEEN_DEPTH * corner - t) @ R)[None].astype(np.float32),
        log_scales=np.full((1, 3), -7, np.float32),
        opacity_logits=np.array([UNSEEN], np.float32),
        sh_dc=np.full((1, 3), -0.5 / SH_C0, np.float32),
        sh_rest=0 * last.sh_rest,
    )
    rows = [probe.gaussians, *[unseen] * n_more]
    return Gaussians._make(np.concatenate(fields) for fields in zip(*rows, strict=True))


def write(probe: Probe, folder: Path, n_more: int = 0) -> dict[str, Any]:
    """Write a probe's PLY with ``n_more`` unseen Gaussians into a folder, and return the request of the contract."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{probe.name}.ply"
    save_ply(path, with_unseen(probe, n_more))
    R, t = probe.camera
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = R, t
    request = {
        "name": probe.name,
        "ply": path.name,
        "width": WIDTH,
        "height": HEIGHT,
        "cam_from_world": view.tolist(),
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": probe.centre[0],
        "cy": probe.centre[1],
        "background": list(probe.background),
    }
    (folder / f"{probe.name}.json").write_text(json.dumps(request))
    return request


def camera_of(probe: Probe) -> Camera:
    """Return the camera of a probe."""
    return Camera(*probe.camera, FOCAL, FOCAL, *probe.centre, WIDTH, HEIGHT)


def golden_of(probe: Probe, conventions: Conventions) -> Golden:
    """Return a probe as a golden scene with the reference's images."""
    g = probe.gaussians
    R, t = probe.camera
    inputs = {
        "means": g.means.astype(np.float64),
        "quats": g.quats.astype(np.float64),
        "scales": np.exp(g.log_scales.astype(np.float64)),
        "opacities": 1 / (1 + np.exp(-g.opacity_logits.astype(np.float64))),
        "sh_dc": g.sh_dc.astype(np.float64),
        "sh_rest": g.sh_rest.astype(np.float64),
        "background": np.array(probe.background),
        "cam_from_world_R": R,
        "cam_from_world_t": t,
        "intrinsics": np.array([FOCAL, FOCAL, *probe.centre]),
        "image_size": np.array([WIDTH, HEIGHT], np.int32),
        "features": np.zeros((len(g.means), 1)),
        "feature_background": np.zeros(1),
    }
    scene = Golden(probe.name, probe.rule, conventions, inputs)
    return scene._replace(arrays=inputs | run_stages(REFERENCE, scene, "float64"))
