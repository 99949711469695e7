"""Readable, proved reference of 3D Gaussian Splatting and Mini-Splatting, accelerated on the CPU.

The public names below are loaded when they are first used: importing the package costs nothing, and neither NumPy nor
Numba is loaded before something needs it. Stages are reached through their modules, for example
``minisplat_ref.reference.projection`` or ``minisplat_ref.rendering``. ``docs/ARCHITECTURE.md`` has the reading order.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, INRIA, MINI_SPLATTING2, PROFILES, Conventions
    from minisplat_ref.errors import InputError
    from minisplat_ref.gsplat.call import rasterization, rasterization_vjp
    from minisplat_ref.io import load_scene
    from minisplat_ref.io.ply import load_ply, load_points, save_ply
    from minisplat_ref.rendering import render, render_vjp
    from minisplat_ref.rendering.backends import CPU, REFERENCE, Backend, get_backend
    from minisplat_ref.types import Camera, Gaussians, RenderOutput, Scene, View

__version__ = "0.3.0"  # stated here; pyproject.toml reads it, so that a checkout that is not installed knows it, too

_MODULES = {
    "minisplat_ref.rendering.backends": ("CPU", "REFERENCE", "Backend", "get_backend"),
    "minisplat_ref.constants": ("GSPLAT_1_5", "GSPLAT_MAIN", "INRIA", "MINI_SPLATTING2", "PROFILES", "Conventions"),
    "minisplat_ref.errors": ("InputError",),
    "minisplat_ref.io": ("load_scene",),
    "minisplat_ref.io.ply": ("load_ply", "load_points", "save_ply"),
    "minisplat_ref.gsplat.call": ("rasterization", "rasterization_vjp"),
    "minisplat_ref.rendering": ("render", "render_vjp"),
    "minisplat_ref.types": ("Camera", "Gaussians", "RenderOutput", "Scene", "View"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "CPU",
    "GSPLAT_1_5",
    "GSPLAT_MAIN",
    "INRIA",
    "MINI_SPLATTING2",
    "PROFILES",
    "REFERENCE",
    "Backend",
    "Camera",
    "Conventions",
    "Gaussians",
    "InputError",
    "RenderOutput",
    "Scene",
    "View",
    "get_backend",
    "load_ply",
    "load_points",
    "load_scene",
    "rasterization",
    "rasterization_vjp",
    "render",
    "render_vjp",
    "save_ply",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names, which completion in a notebook offers before they are loaded."""
    return sorted(__all__)
