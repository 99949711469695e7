"""Hard cases of position: means that no camera sees, cameras that no photographer has, worlds far from the origin."""

import numpy as np

from minisplat_ref.constants import INRIA
from minisplat_ref.oracle.hard_cases.scenes import call, camera, cloud, gaussians, intrinsics, move_world
from minisplat_ref.oracle.hard_cases.subjects import Call, HardCase, Parameters
from minisplat_ref.oracle.tolerances import BESIDE, LONG, ORDINARY, WORLD

COVERS = "it covers the image with half of its opacity"
CULLED = "culled: the background, and no gradient"
BEYOND_CLAMP = [[1.2, 0.1, 1.0], [-1.4, -0.3, 1.0], [0.2, 1.1, 1.0], [0.1, 0.2, 3.0]]  # slopes beyond 1.3 tan(fov / 2)


CAMERAS = (
    HardCase(
        "on-the-near-plane",
        "z is the near plane itself",
        CULLED,
        lambda: call([[0, 0, 0.5]], near_plane=0.5),
        is_background=True,
    ),
    HardCase(
        "just-beyond-the-near-plane",
        "one float32 beyond",
        "drawn, 100 times larger than at arm's length",
        lambda: call([[0, 0, float(np.nextafter(np.float32(0.5), np.float32(1)))]], 0.05, near_plane=0.5),
    ),
    HardCase(
        "near-plane-of-the-profile",
        "0.01 is no float32: float32's 0.01 lies before it",
        CULLED,
        lambda: call([[0, 0, 0.01]]),
        is_background=True,
    ),
    HardCase(
        "behind",
        "z is negative: the pinhole mirrors it into the image",
        CULLED,
        lambda: call([[0, 0, -3.0]]),
        is_background=True,
    ),
    HardCase("beside", "z = 0: the slope is infinite", CULLED, lambda: call([[1, 0, 0.0]], 1.0), is_background=True),
    HardCase(
        "at-the-camera-centre",
        "x = y = z = 0: the slope is 0 / 0",
        CULLED,
        lambda: call([[0, 0, 0.0]], 1.0),
        is_background=True,
    ),
    HardCase(
        "at-the-camera-centre-without-near-plane",
        "nothing but z > 0 keeps it out",
        CULLED,
        lambda: call([[0, 0, 0.0]], 1.0, near_plane=0.0),
        is_background=True,
    ),
    HardCase(
        "behind-beside-and-before",
        "one of each in a batch",
        "only what is before is drawn",
        lambda: call([[0, 0, -3], [1, 0, 0], [0, 0, 0], [0, 0, 3], [0.1, 0, 1e-3]]),
    ),
    HardCase(
        "1e-6-before-the-camera",
        "1 / z^2 = 1e12, without a near plane",
        "its footprint covers the image",
        lambda: call([[1e-8, 1e-8, 1e-6]], 0.1, near_plane=0.0),
        LONG,
    ),
    HardCase(
        "1e-25-before-the-camera",
        "z^2 is 0 in float32",
        "its footprint covers the image",
        lambda: call([[0, 0, 1e-25]], 1e-26, near_plane=0.0),
    ),
    HardCase(
        "1e25-away",
        "z^2 is infinite in float32",
        "its footprint, as of a small one near by",
        lambda: call([[0, 0, 1e25]], 1e24, far_plane=1e30),
    ),
    HardCase(
        "on-the-far-plane",
        "z is the far plane itself",
        CULLED,
        lambda: call([[0, 0, 8.0]], far_plane=8.0),
        is_background=True,
    ),
    HardCase("beyond-the-far-plane", "z = 1e11", CULLED, lambda: call([[0, 0, 1e11]], 1e11), is_background=True),
    HardCase(
        "clamp-active",
        "means beside the view whose footprints reach in: the Jacobian is frozen at 1.3 tan(fov / 2)",
        "no gradient through the frozen slope",
        lambda: call(BEYOND_CLAMP, 0.4, size=(24, 18)),
    ),
    HardCase(
        "clamp-active-inria",
        "the same, counted from the axis",
        "as above",
        lambda: call(BEYOND_CLAMP, 0.4, size=(24, 18), profile="INRIA"),
    ),
    HardCase(
        "clamp-off-centre",
        "the clamp counts from a principal point at the edge",
        "limits that are not symmetric",
        lambda: call(BEYOND_CLAMP, 0.4, size=(24, 18), Ks=intrinsics(30, 28, 2.0, 16.0)),
    ),
    HardCase(
        "principal-point-off-centre",
        "cx = 3 and cy = 15 of 24 x 18",
        "the image moves with it",
        lambda: Parameters(cloud(), camera(cx=3.0, cy=15.0)),
    ),
    HardCase(
        "principal-point-outside",
        "the axis does not meet the image",
        "what is left of the image",
        lambda: Parameters(cloud(60, scales=0.5), camera(cx=-8.0, cy=30.0)),
    ),
    HardCase(
        "principal-point-ignored",
        "INRIA's rasteriser centres it whatever the camera says",
        "the image of the centred camera",
        lambda: Parameters(cloud(), camera(cx=3.0, cy=15.0), conventions=INRIA),
    ),
    HardCase(
        "fov-170-degrees",
        "focal length 1 pixel of 24: Jacobians are extreme at the edges",
        "small footprints, stretched outwards",
        lambda: Parameters(cloud(), camera(fx=1.05, fy=1.05)),
    ),
    HardCase(
        "fov-0.01-degrees",
        "focal length 1e5 pixels, things 1e4 units away",
        "as seen through a telescope",
        lambda: call(
            np.random.default_rng(4).uniform(-1, 1, (20, 3)) * [1, 1, 50] + [0, 0, 1e4],
            0.2,
            Ks=intrinsics(1e5, 1e5, 4.5, 4.5),
        ),
    ),
    HardCase(
        "focal-length-1e-3",
        "everything falls into a thousandth of a pixel",
        "the low-pass's dot, all Gaussians in one pixel",
        lambda: Parameters(cloud(), camera(fx=1e-3, fy=1e-3)),
    ),
    HardCase(
        "focal-length-1e6",
        "a Gaussian of 0.2 units is 1e5 pixels wide",
        "a constant image",
        lambda: Parameters(gaussians([[0, 0, 3]]), camera(fx=1e6, fy=1e6)),
    ),
    HardCase(
        "focal-lengths-differ-1e3",
        "pixels that are 1000 times taller than wide",
        "stretched footprints",
        lambda: Parameters(cloud(), camera(fx=3000.0, fy=3.0)),
        LONG,
    ),
    HardCase(
        "mirrored-view",
        "the matrix mirrors: its determinant is -1",
        "the mirrored image; nine free entries, no rotation assumed",
        lambda: call([[0.1, 0.2, 3], [-0.3, 0, 4]], viewmats=np.diag([-1.0, 1, 1, 1])[None]),
    ),
    HardCase(
        "view-in-other-units",
        "R and t times 1000: the camera's frame is in millimetres",
        "the same image",
        lambda: call([[0.1, 0.2, 3], [-0.3, 0, 4]], viewmats=np.diag([1e3, 1e3, 1e3, 1])[None]),
    ),
    HardCase(
        "sheared-view",
        "R is no rotation",
        "the linear map that is given; its inverse takes the camera to its centre",
        lambda: call(
            [[0.1, 0.2, 3], [-0.3, 0, 4]],
            viewmats=np.array([[[1, 0.5, 0, 0.125], [0, 1, 0.25, 0], [0, 0, 1, 0.5], [0, 0, 0, 1.0]]]),
        ),
    ),
    HardCase(
        "far-beside",
        "a footprint 1e6 pixels away that covers the image",
        "a gentle slope of alpha",
        lambda: Parameters(gaussians([[3e3, 0, 1]], 1e5), camera()),
        LONG,
    ),
    HardCase(
        "radius-of-7e7",
        "just before the near plane and 1,000 units beside: its centre is 2e7 pixels away",
        COVERS,
        lambda: call([[1e3, 0, 0.02]], 1e3, 0.9, size=(32, 32), Ks=intrinsics(400, 400, 16, 16)),
        BESIDE,
    ),
    *(
        HardCase(
            f"radius-beyond-int32{name}",
            "centre and radius are 1e10 pixels and more: a radius that is clamped before the box is made culls it",
            COVERS,
            lambda options=options: call(  # type: ignore[misc]
                [[1e3, 0, 1]], 1e3, 0.9, size=(32, 32), Ks=intrinsics(1e7, 1e7, 16, 16), **options
            ),
            BESIDE,
        )
        for name, options in (("", {}), ("-inria", {"profile": "INRIA"}))
    ),
)


RELATIVE = "the image of the means that float32 holds: the camera's centre is subtracted before anything is rounded"


def _georeferenced_call() -> Call:
    """Through `rasterization`, whose view matrix is rounded like everything else: t = -R c is 1e6 too."""
    subject = move_world((448000, 5412000, 300), scale=50.0)
    viewmat, K = np.eye(4), np.eye(3)
    view, g = subject.camera, subject.gaussians
    viewmat[:3, :3], viewmat[:3, 3] = np.eye(3), -np.array([448000, 5412000, 300.0])
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = view.fx, view.fy, view.cx, view.cy
    means = (50 * cloud().means + [448000, 5412000, 300]).astype(np.float32).astype(np.float64)
    arrays = {
        "means": means,
        "quats": g.quats,
        "scales": np.exp(g.log_scales).astype(np.float32).astype(np.float64),
        "opacities": np.full(len(means), 0.5),
        "colors": g.sh_dc,
        "viewmats": viewmat[None],
        "Ks": K[None],
    }
    return Call(arrays, view.width, view.height, {})


def _displace(offset: tuple[float, float, float], scale: float) -> Parameters:
    return move_world(offset, scale=scale)


WORLD_CASES = (
    HardCase(
        "world-at-1e6",
        "means of 1e6 are multiples of 1/16 in float32, and R mu + t cancels",
        RELATIVE,
        lambda: _displace((1e6, -1e6, 1e6), 20.0),
        WORLD,
    ),
    HardCase(
        "world-utm",
        "a UTM position, 448 km east, 5412 km north",
        RELATIVE,
        lambda: _displace((448e3, 5412e3, 300), 50.0),
        WORLD,
    ),
    HardCase(
        "world-earth-centred",
        "earth-centred coordinates of 6.4e6 metres",
        RELATIVE,
        lambda: _displace((4.2e6, 0.8e6, 4.7e6), 50.0),
        WORLD,
    ),
    HardCase("world-utm-call", "a view matrix whose t is 5e6", RELATIVE, _georeferenced_call, WORLD),
    HardCase(
        "world-at-1e6-coarse",
        "a scene of one unit: every mean is rounded to a sixteenth of it",
        RELATIVE,
        lambda: _displace((1e6, -1e6, 1e6), 1.0),
        WORLD,
    ),
    HardCase(
        "world-in-metres-of-a-map",
        "a scene that is 1e5 units wide",
        "as at any size",
        lambda: _displace((0, 0, 0), 1e5),
        ORDINARY,
    ),
    HardCase(
        "world-of-centimetres",
        "a scene of a twentieth of a unit, at the near plane's scale",
        "as at any size",
        lambda: _displace((0, 0, 0), 0.05),
        ORDINARY,
    ),
)
