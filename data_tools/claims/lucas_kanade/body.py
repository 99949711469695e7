"""A body that turns and grows, photographed while it does: the scene of both claims, known exactly."""

from typing import NamedTuple

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering import render
from minisplat_ref.rendering.backends import CPU
from minisplat_ref.types import Camera, Floats, Gaussians, Scene, View, number_views

N_GAUSSIANS, N_FRAMES, TEST_EVERY = 400, 25, 4
WIDTH, HEIGHT, FOCAL = 240, 135, 260.0  # pixels
DISTANCE, RADIUS = 5.0, 1.0  # of the camera from the middle, and of the body, world units
BULGE = 0.4  # depth of the dome, radii
ANGLE, GROWTH = 1.0, 0.25  # by which the body turns, radians, and grows, from time 0 to 1
AXIS = np.array([0.3, 0.4, 1.0]) / np.linalg.norm([0.3, 0.4, 1.0])  # y points down, z away from the camera
ARC = 0.2  # radians by which the slow camera moves around the body


class Body(NamedTuple):
    """Gaussians at time 0, and how they move."""

    gaussians: Gaussians
    """float32; their centres are about the origin."""

    def at(self, time: float) -> Gaussians:
        """Return the Gaussians at a time: ``mu(t) = s R mu``, with s = 1 + GROWTH t and R by the angle ANGLE t."""
        g, half = self.gaussians, ANGLE * time / 2
        turn = np.array([np.cos(half), *(np.sin(half) * AXIS)])
        R, scale = rotation_matrices(turn[None])[0], 1 + GROWTH * time
        moved = g._replace(
            means=scale * g.means @ R.T,
            quats=_product(turn, g.quats.astype(float)),
            log_scales=g.log_scales + np.log(scale),
        )
        return Gaussians(*(field.astype(np.float32) for field in moved))


def _product(p: Floats, q: Floats) -> Floats:
    """Return the quaternions ``p q``, [N, 4]."""
    w, u = q[:, :1], q[:, 1:]
    a, b = p[0], p[1:]
    return np.concatenate([a * w - u @ b[:, None], a * u + w * b + np.cross(b, u)], axis=1)


def make_body(rng: np.random.Generator) -> Body:
    """Return a dome of flat Gaussians with random colours, which bulges towards the camera.

    Of one layer, so that nothing is hidden and what an image shows is what moves.
    """
    i = np.arange(N_GAUSSIANS) + 0.5
    r, phi = np.sqrt(i / N_GAUSSIANS), np.pi * (1 + 5**0.5) * i
    x, y = r * np.cos(phi), r * np.sin(phi)
    normals = np.stack([-2 * BULGE * x, -2 * BULGE * y, np.ones(N_GAUSSIANS)], axis=1)  # [N, 3] away from the camera
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    gaussians = Gaussians(
        means=RADIUS * (np.stack([x, y, BULGE * (r * r - 0.5)], axis=1) + 0.01 * rng.normal(size=(N_GAUSSIANS, 3))),
        quats=np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(N_GAUSSIANS)]),  # z to normal
        log_scales=np.log(RADIUS * np.array([0.055, 0.055, 0.01])) + 0.15 * rng.normal(size=(N_GAUSSIANS, 3)),
        opacity_logits=np.full(N_GAUSSIANS, 3.0),
        sh_dc=rng.uniform(-1.7, 1.7, size=(N_GAUSSIANS, 3)),
        sh_rest=np.zeros((N_GAUSSIANS, 0, 3)),
    )
    return Body(Gaussians(*(field.astype(np.float32) for field in gaussians)))


def camera_at(azimuth: float) -> Camera:
    """Return a camera on a circle around the y axis that looks at the origin; y points down."""
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    R = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])  # cam_from_world
    return Camera(R, np.array([0.0, 0.0, DISTANCE]), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def film(body: Body, arc: float) -> Scene:
    """Return the body photographed at times from 0 to 1 by one camera, which moves by an angle; every fourth held out.

    The points are the centres at time 0, with their colours, as structure from motion would have them.
    """
    views = []
    for i in range(N_FRAMES):
        time = i / (N_FRAMES - 1)
        camera = camera_at(arc * (time - 0.5))
        image = render(body.at(time), camera, backend=CPU)[0].image
        levels = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)  # [H, W, 3]
        views.append(View(f"{i:04d}", camera, levels, None, time=time))
    g = body.gaussians
    colors = np.round(255 * np.clip(0.5 + SH_C0 * g.sh_dc, 0, 1)).astype(np.uint8)
    held_out = [view for i, view in enumerate(views) if i % TEST_EVERY == TEST_EVERY // 2]
    kept = number_views(view for i, view in enumerate(views) if i % TEST_EVERY != TEST_EVERY // 2)
    return Scene("body", kept, tuple(held_out), g.means.astype(float), colors, np.zeros(3), extent=1.1 * DISTANCE)
