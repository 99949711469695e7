"""Every array of the golden format: its name, stage, role, shape, unit and meaning, and how exactly it must be met.

A name belongs to one array of a scene. The arrays of a stage stand in one file; a stage's inputs that other stages made
stand in theirs. Left out: the activations (exponential, sigmoid), which belong to the trainer.
"""

from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from minisplat_ref.oracle.tolerances import EXACT, GRADIENT, IMAGE, LOSS, POSITION, SHAPE, StageTolerance

Arrays = dict[str, NDArray[Any]]
Role = Literal["input", "output", "cotangent", "gradient"]


class ArraySpec(NamedTuple):
    """One array."""

    name: str
    """Unique in a scene."""
    stage: str
    """Stage that it belongs to; name of its file."""
    role: Role
    """What it is for that stage."""
    shape: tuple[str | int, ...]
    """N Gaussians, R = K - 1 higher SH coefficients, M pairs, T1 = tiles + 1, H x W pixels."""
    kind: Literal["float64", "int32", "int64"]
    """As exported; other integers and float32 are accepted from others."""
    unit: str
    """Unit and frame."""
    meaning: str
    """One line."""
    tolerance: StageTolerance


_WORLD, _PX = "world units, world frame", "px"
_SPECS: tuple[tuple[Any, ...], ...] = (
    ("means", "scene", "input", ("N", 3), "float64", _WORLD, "centres", EXACT),
    ("quats", "scene", "input", ("N", 4), "float64", "1", "rotations world_from_gaussian, wxyz, any length", EXACT),
    ("scales", "scene", "input", ("N", 3), "float64", "world units", "standard deviations along the axes", EXACT),
    ("opacities", "scene", "input", ("N",), "float64", "1", "in [0, 1], activated", EXACT),
    ("sh_dc", "scene", "input", ("N", 3), "float64", "1", "spherical-harmonic coefficient of degree 0, RGB", EXACT),
    ("sh_rest", "scene", "input", ("N", "R", 3), "float64", "1", "coefficients of degree 1 and above, all used", EXACT),
    ("background", "scene", "input", (3,), "float64", "1", "RGB behind everything", EXACT),
    ("cam_from_world_R", "scene", "input", (3, 3), "float64", "1", "rotation of x_cam = R x_world + t", EXACT),
    ("cam_from_world_t", "scene", "input", (3,), "float64", "world units", "translation of the same", EXACT),
    ("intrinsics", "scene", "input", (4,), "float64", _PX, "fx, fy, cx, cy", EXACT),
    ("image_size", "scene", "input", (2,), "int32", _PX, "width W, height H", EXACT),
    ("means2d", "project", "output", ("N", 2), "float64", _PX, "projected centres; 0 where culled", POSITION),
    ("depths", "project", "output", ("N",), "float64", "world units", "camera z; 0 where culled", POSITION),
    ("conics", "project", "output", ("N", 3), "float64", "px^-2", "a, b, c of a dx^2 + 2 b dx dy + c dy^2", SHAPE),
    ("opacities2d", "project", "output", ("N",), "float64", "1", "opacities times antialiasing compensation", SHAPE),
    ("radii", "project", "output", ("N", 2), "int32", _PX, "half-extents along x and y; 0 where culled", EXACT),
    ("boxes", "project", "output", ("N", 4), "int32", _PX, "x0, y0, x1, y1, half-open: pixels it may touch", EXACT),
    ("tile_size", "tiles", "input", (2,), "int32", _PX, "width, height of a tile", EXACT),
    ("gaussian_ids", "tiles", "output", ("M",), "int32", "row", "by tile (row-major), then by depth, then row", EXACT),
    ("tile_offsets", "tiles", "output", ("T1",), "int64", "1", "tile t owns ids[offsets[t]:offsets[t + 1]]", EXACT),
    ("colors", "colors", "output", ("N", 3), "float64", "1", "RGB, max(0, 0.5 + SH sum); 0 where culled", IMAGE),
    ("alpha", "composite", "output", ("H", "W"), "float64", "1", "1 - T, T the transmittance left", IMAGE),
    ("image", "composite", "output", ("H", "W", 3), "float64", "1", "RGB with background", IMAGE),
    ("v_image", "composite", "cotangent", ("H", "W", 3), "float64", "1", "dL/d image, random", EXACT),
    ("v_alpha", "composite", "cotangent", ("H", "W"), "float64", "1", "dL/d alpha, random", EXACT),
    ("v_colors", "composite", "gradient", ("N", 3), "float64", "1", "dL/d colors", GRADIENT),
    ("v_background", "composite", "gradient", (3,), "float64", "1", "dL/d background", GRADIENT),
    ("v_means2d", "composite", "gradient", ("N", 2), "float64", "px^-1", "dL/d means2d", GRADIENT),
    ("v_conics", "composite", "gradient", ("N", 3), "float64", "px^2", "dL/d (a, b, c); b counts as one", GRADIENT),
    ("v_opacities2d", "composite", "gradient", ("N",), "float64", "1", "dL/d opacities2d", GRADIENT),
    ("v_depths", "project", "cotangent", ("N",), "float64", "1", "dL/d depths, random", EXACT),
    ("v_means_projection", "project", "gradient", ("N", 3), "float64", "1", "dL/d means by project alone", GRADIENT),
    ("v_quats", "project", "gradient", ("N", 4), "float64", "1", "dL/d quats", GRADIENT),
    ("v_scales", "project", "gradient", ("N", 3), "float64", "1", "dL/d scales", GRADIENT),
    ("v_opacities", "project", "gradient", ("N",), "float64", "1", "dL/d opacities", GRADIENT),
    ("v_R_projection", "project", "gradient", (3, 3), "float64", "1", "dL/d R by project, nine free entries", GRADIENT),
    ("v_t_projection", "project", "gradient", (3,), "float64", "1", "dL/d t by project alone", GRADIENT),
    ("v_means_colors", "colors", "gradient", ("N", 3), "float64", "1", "dL/d means by viewing direction", GRADIENT),
    ("v_sh_dc", "colors", "gradient", ("N", 3), "float64", "1", "dL/d sh_dc", GRADIENT),
    ("v_sh_rest", "colors", "gradient", ("N", "R", 3), "float64", "1", "dL/d sh_rest", GRADIENT),
    ("v_R_colors", "colors", "gradient", (3, 3), "float64", "1", "dL/d R by the camera centre -R^T t", GRADIENT),
    ("v_t_colors", "colors", "gradient", (3,), "float64", "1", "dL/d t by the same", GRADIENT),
    ("v_means", "total", "gradient", ("N", 3), "float64", "1", "dL/d means: both shares", GRADIENT),
    ("v_R", "total", "gradient", (3, 3), "float64", "1", "dL/d cam_from_world_R: both shares", GRADIENT),
    ("v_t", "total", "gradient", (3,), "float64", "1", "dL/d cam_from_world_t: both shares", GRADIENT),
    ("target", "loss", "input", ("H", "W", 3), "float64", "1", "photograph that image is compared with", EXACT),
    ("dssim_weight", "loss", "input", (), "float64", "1", "w of (1 - w) L1 + w (1 - SSIM)", EXACT),
    ("loss", "loss", "output", (), "float64", "1", "that loss of image", LOSS),
    ("v_image_of_loss", "loss", "gradient", ("H", "W", 3), "float64", "1", "d loss/d image", GRADIENT),
)

SPECS = {row[0]: ArraySpec(*row) for row in _SPECS}
"""By name, in the order of the pipeline."""

STAGE_INPUTS = {
    "project": (
        *("means", "quats", "scales", "opacities", "cam_from_world_R", "cam_from_world_t"),
        *("intrinsics", "image_size"),
    ),
    "tiles": ("means2d", "depths", "radii", "boxes", "tile_size", "image_size"),
    "colors": ("means", "sh_dc", "sh_rest", "cam_from_world_R", "cam_from_world_t", "radii"),
    "composite": (
        *("means2d", "conics", "opacities2d", "boxes", "colors", "background"),
        *("gaussian_ids", "tile_offsets", "tile_size", "image_size"),
    ),
    "loss": ("image", "target", "dssim_weight"),
    "total": (),
}
"""What each stage reads."""

STAGE_COTANGENTS = {
    "project": ("v_means2d", "v_depths", "v_conics", "v_opacities2d"),
    "tiles": (),
    "colors": ("v_colors",),
    "composite": ("v_image", "v_alpha"),
    "loss": (),
    "total": ("v_means_projection", "v_means_colors", "v_R_projection", "v_R_colors", "v_t_projection", "v_t_colors"),
}
"""What each stage's gradient reads beside that; the loss's starts from dL/d loss = 1, and ``total`` adds shares."""


def names_of(stage: str, *roles: Role) -> tuple[str, ...]:
    """Names of a stage's own arrays in these roles."""
    return tuple(spec.name for spec in SPECS.values() if spec.stage == stage and spec.role in roles)
