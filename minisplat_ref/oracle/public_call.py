"""The public call as a stage under test: ``rasterization`` of a batch of two cameras, in every mode.

Between a backend's stages and the user's call there is code that can be wrong by itself: channels are concatenated and
split, an accumulated depth is divided by the opacity, gradients of the cameras are added, and spherical harmonics
depend on the view matrices via the camera's centre. Checks of the stages cover none of it.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from minisplat_ref.gsplat.call import rasterization, rasterization_vjp
from minisplat_ref.oracle.differences import Point
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage, watch
from minisplat_ref.reference.covariance import rotation_matrices
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Floats


class Call(NamedTuple):
    """One way of calling."""

    render_mode: str
    """Of ``rasterization``."""
    n_channels: int = 0
    """Given colours of this many channels; 0: spherical harmonics."""
    has_own_colors: bool = False
    """Whether each camera has its own colours."""
    is_antialiased: bool = False
    """Whether opacities are compensated."""

    @property
    def name(self) -> str:
        """Return its name for reports."""
        colors = f"{self.n_channels} channels" if self.n_channels else "harmonics"
        words = [colors] if self.has_colors else []
        words += ["of each camera"] if self.has_own_colors else []
        words += ["antialiased"] if self.is_antialiased else []
        return " ".join(["rasterization", self.render_mode, *words])

    @property
    def has_colors(self) -> bool:
        """Return whether the image depends on colours and background."""
        return self.render_mode.startswith("RGB")


CALLS = (
    Call("RGB"),
    Call("RGB", n_channels=5, has_own_colors=True),
    Call("D"),
    Call("ED"),
    Call("RGB+D", has_own_colors=True),
    Call("RGB+ED"),
    Call("RGB+ED", n_channels=1, is_antialiased=True),
)
"""Every mode, with and without spherical harmonics, shared and own colours, other numbers of channels than three."""


def rasterization_stage(
    backend: Backend, setting: Setting, call: Call, rng: np.random.Generator, n_cameras: int = 2
) -> Stage:
    """``rasterization`` as a function of Gaussians, colours, the upper rows of view matrices, and backgrounds.

    Parameters
    ----------
    backend : Backend
        Implementation of the stages.
    setting : Setting
        The scene; its camera is the first.
    call : Call
        How it is called.
    rng : Generator
        For colours that are no spherical harmonics, and for backgrounds.
    n_cameras : int
        1 or 2; the second is rotated, moved and of another focal length.
    """
    camera = setting.camera
    fixed: dict[str, Any] = {
        "Ks": _intrinsics(setting)[:n_cameras],
        "width": camera.width,
        "height": camera.height,
        "render_mode": call.render_mode,
        "rasterize_mode": "antialiased" if call.is_antialiased else "classic",
        "sh_degree": None if call.n_channels else math.isqrt(setting.gaussians.sh_rest.shape[1]),
        "profile": setting.conventions,
    }
    colors = _colors(setting, call, rng, n_cameras)
    backgrounds = rng.uniform(0.2, 1, size=(n_cameras, call.n_channels or 3))
    inputs = {**setting.primitives._asdict(), "viewmats": _view_matrices(setting)[:n_cameras, :3]}
    if call.has_colors:
        inputs |= {"colors": colors, "backgrounds": backgrounds}

    def arguments(args: tuple[Floats, ...]) -> dict[str, Any]:
        given = {"colors": colors, "backgrounds": backgrounds, **dict(zip(inputs, args, strict=True))}
        last_rows = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (n_cameras, 1, 4))
        return {**given, "viewmats": np.concatenate([given["viewmats"], last_rows], axis=1)}

    def function(*args: Floats) -> Point:
        on_watch, sides = watch(backend)
        image, alpha, _ = rasterization(**arguments(args), **fixed, backend=on_watch)
        return Point((image, alpha), tuple(sides))

    def vjp(v_image: Floats, v_alpha: Floats) -> tuple[Floats, ...]:
        given = arguments(tuple(inputs.values()))
        v = rasterization_vjp(**given, **fixed, v_render_colors=v_image, v_render_alphas=v_alpha, backend=backend)
        v["v_viewmats"] = v["v_viewmats"][:, :3]
        return tuple(v[f"v_{name}"] for name in inputs)

    return Stage(call.name, inputs, ("image", "alpha"), function, vjp)


def _colors(setting: Setting, call: Call, rng: np.random.Generator, n_cameras: int) -> Floats:
    """Return coefficients [N, K, 3] or channels [N, D], or one such array for each camera."""
    g = setting.gaussians
    n = len(g.means)
    colors = rng.normal(size=(n, call.n_channels)) if call.n_channels else np.hstack([g.sh_dc[:, None], g.sh_rest])
    if not call.has_own_colors:
        return colors
    return np.stack([colors * (1 + 0.3 * c) for c in range(n_cameras)])


def _view_matrices(setting: Setting) -> Floats:
    """Return [2, 4, 4] cam_from_world."""
    R, t = setting.pose.values()
    turn = rotation_matrices(np.array([[1.0, -0.03, 0.05, 0.04]]))[0]
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[0, :3] = np.column_stack([R, t])
    viewmats[1, :3] = np.column_stack([turn @ R, turn @ t + [0.05, -0.1, 0.2]])
    return viewmats


def _intrinsics(setting: Setting) -> Floats:
    """Return [2, 3, 3]."""
    c = setting.camera
    K = np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
    return np.stack([K, K * [[1.1, 1, 0.95], [1, 0.9, 1.05], [1, 1, 1]]])
