"""The golden format: every array by name, and the page that explains it to readers who will never see our Python.

An array has a name, a stage, a role, a shape, a unit, a meaning, and the tolerance within which it must be reproduced.
Names are unique in a scene. The arrays of a stage are in one file; its inputs from other stages are in theirs. Left
out: the activations (exponential, sigmoid), which belong to the trainer.
"""

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from minisplat_ref.constants import Conventions
from minisplat_ref.interface.reporting import markdown_table
from minisplat_ref.oracle.tolerances import (
    ADAM,
    EXACT,
    EXPECTED_DEPTH,
    GRADIENT,
    IMAGE,
    LOSS,
    POSITION,
    SHAPE,
    SURFACE,
    StageTolerance,
)
from minisplat_ref.types import Camera

Arrays = dict[str, NDArray[Any]]
Role = Literal["input", "output", "cotangent", "gradient"]


class ArraySpec(NamedTuple):
    """One array."""

    name: str
    """Unique in a scene."""
    stage: str
    """Stage that it belongs to; name of its file."""
    role: Role
    """Its role in that stage."""
    shape: tuple[str | int, ...]
    """N Gaussians, R = K - 1 higher SH coefficients, M pairs, T1 = tiles + 1, H x W pixels, F channels, I x J rays,
    A x P parameters, V rows of them."""
    kind: Literal["float64", "int32", "int64"]
    """As exported; other integers and float32 are accepted from others."""
    unit: str
    """Unit and frame."""
    meaning: str
    """One line."""
    tolerance: StageTolerance


_WORLD, _PX = "world units, world frame", "px"
_MEDIAN = "depth of the hit that takes T below 1/2; 0 where none"
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
    ("mask", "loss", "input", ("H", "W"), "int32", "1", "1 where a pixel of the masked loss counts, else 0", EXACT),
    ("target_bytes", "loss", "input", ("H", "W", 3), "int32", "1/255", "photograph of the masked loss, bytes", EXACT),
    ("loss", "loss", "output", (), "float64", "1", "that loss of image", LOSS),
    ("masked_loss", "loss", "output", (), "float64", "1", "that of image and target_bytes / 255 in the mask", LOSS),
    ("v_image_of_loss", "loss", "gradient", ("H", "W", 3), "float64", "1", "d loss/d image", GRADIENT),
    ("v_image_of_masked_loss", "loss", "gradient", ("H", "W", 3), "float64", "1", "d masked_loss/d image", GRADIENT),
    ("features", "features", "input", ("N", "F"), "float64", "1", "further channels, blended as colours are", EXACT),
    ("feature_background", "features", "input", ("F",), "float64", "1", "what is behind them", EXACT),
    ("feature_image", "features", "output", ("H", "W", "F"), "float64", "1", "features blended, background in", IMAGE),
    ("accumulated_depth", "features", "output", ("H", "W"), "float64", "world units", "sum of w depths", IMAGE),
    ("v_feature_image", "features", "cotangent", ("H", "W", "F"), "float64", "1", "dF/d feature_image, random", EXACT),
    ("v_accumulated_depth", "features", "cotangent", ("H", "W"), "float64", "1", "dF/d accumulated_depth", EXACT),
    ("v_features", "features", "gradient", ("N", "F"), "float64", "1", "dF/d features", GRADIENT),
    ("v_feature_background", "features", "gradient", ("F",), "float64", "1", "dF/d feature_background", GRADIENT),
    ("v_depths_features", "features", "gradient", ("N",), "float64", "1", "dF/d depths", GRADIENT),
    ("v_means2d_features", "features", "gradient", ("N", 2), "float64", "px^-1", "dF/d means2d", GRADIENT),
    ("v_conics_features", "features", "gradient", ("N", 3), "float64", "px^2", "dF/d (a, b, c)", GRADIENT),
    ("v_opacities2d_features", "features", "gradient", ("N",), "float64", "1", "dF/d opacities2d", GRADIENT),
    ("blend_weight_sum", "statistics", "output", ("N",), "float64", "1", "sum of w over the pixels", IMAGE),
    ("blend_weight_max", "statistics", "output", ("N",), "float64", "1", "largest w of a pixel", IMAGE),
    ("hit_count", "statistics", "output", ("N",), "int32", "1", "pixels with a blended hit", EXACT),
    ("dominant_count", "statistics", "output", ("N",), "int32", "1", "pixels in which its w is the largest", EXACT),
    ("dominant_ids", "statistics", "output", ("H", "W"), "int32", "row", "of the largest w; -1 where no hit", EXACT),
    ("median_depth", "statistics", "output", ("H", "W"), "float64", "world units", _MEDIAN, POSITION),
    (
        "surface_ids",
        "surface",
        "input",
        ("I", "J"),
        "int32",
        "row",
        "Gaussian of the ray of pixel (i, j), or -1",
        EXACT,
    ),
    ("surface_points", "surface", "output", ("I", "J", 3), "float64", _WORLD, "densest point on the ray", SURFACE),
    ("surface_depths", "surface", "output", ("I", "J"), "float64", "world units", "camera z of it", SURFACE),
    ("v_surface_points", "surface", "cotangent", ("I", "J", 3), "float64", "1", "dS/d surface_points, random", EXACT),
    ("v_surface_depths", "surface", "cotangent", ("I", "J"), "float64", "1", "dS/d surface_depths, random", EXACT),
    ("v_means_surface", "surface", "gradient", ("N", 3), "float64", "1", "dS/d means", GRADIENT),
    ("v_quats_surface", "surface", "gradient", ("N", 4), "float64", "1", "dS/d quats", GRADIENT),
    ("v_scales_surface", "surface", "gradient", ("N", 3), "float64", "1", "dS/d scales", GRADIENT),
    ("view", "view", "output", ("H", "W", 4), "float64", "1", "image; expected depth, 0 where no hit", EXPECTED_DEPTH),
    ("view_alpha", "view", "output", ("H", "W"), "float64", "1", "alpha of the same call", IMAGE),
    ("v_expected_depth", "view", "cotangent", ("H", "W"), "float64", "1", "dV/d expected depth, random", EXACT),
    ("v_means_view", "view", "gradient", ("N", 3), "float64", "1", "dV/d means", GRADIENT),
    ("v_quats_view", "view", "gradient", ("N", 4), "float64", "1", "dV/d quats", GRADIENT),
    ("v_scales_view", "view", "gradient", ("N", 3), "float64", "1", "dV/d scales", GRADIENT),
    ("v_opacities_view", "view", "gradient", ("N",), "float64", "1", "dV/d opacities", GRADIENT),
    ("v_sh_dc_view", "view", "gradient", ("N", 3), "float64", "1", "dV/d sh_dc", GRADIENT),
    ("v_sh_rest_view", "view", "gradient", ("N", "R", 3), "float64", "1", "dV/d sh_rest", GRADIENT),
    (
        "v_viewmat",
        "view",
        "gradient",
        (3, 4),
        "float64",
        "1",
        "dV/d (R, t), twelve entries; six are compared",
        GRADIENT,
    ),
    ("v_background_view", "view", "gradient", (3,), "float64", "1", "dV/d background", GRADIENT),
    ("adam_values", "adam", "input", ("A", "P"), "float64", "1", "parameters", EXACT),
    ("adam_gradient", "adam", "input", ("A", "P"), "float64", "1", "g, their gradient", EXACT),
    ("adam_first", "adam", "input", ("A", "P"), "float64", "1", "m, decaying mean of g", EXACT),
    ("adam_second", "adam", "input", ("A", "P"), "float64", "1", "v, decaying mean of g^2", EXACT),
    ("adam_rows", "adam", "input", ("V",), "int32", "row", "to update; the others stay as they are", EXACT),
    ("adam_settings", "adam", "input", (5,), "float64", "1", "rate, beta1, beta2, eps, number of the step k", EXACT),
    ("adam_values_after", "adam", "output", ("A", "P"), "float64", "1", "parameters after the step", ADAM),
    ("adam_first_after", "adam", "output", ("A", "P"), "float64", "1", "m after the step", ADAM),
    ("adam_second_after", "adam", "output", ("A", "P"), "float64", "1", "v after the step", ADAM),
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
    "total": (),
    "loss": ("image", "target", "dssim_weight", "mask", "target_bytes"),
    "features": (
        *("means2d", "conics", "opacities2d", "boxes", "depths", "features", "feature_background"),
        *("gaussian_ids", "tile_offsets", "tile_size", "image_size"),
    ),
    "statistics": (
        *("means2d", "conics", "opacities2d", "boxes", "depths"),
        *("gaussian_ids", "tile_offsets", "tile_size", "image_size"),
    ),
    "surface": (
        *("means", "quats", "scales", "cam_from_world_R", "cam_from_world_t", "intrinsics"),
        "surface_ids",
    ),
    "view": (
        *("means", "quats", "scales", "opacities", "sh_dc", "sh_rest", "background"),
        *("cam_from_world_R", "cam_from_world_t", "intrinsics", "image_size"),
    ),
    "adam": ("adam_values", "adam_gradient", "adam_first", "adam_second", "adam_rows", "adam_settings"),
}
"""The arrays that each stage reads."""

STAGE_COTANGENTS = {
    "project": ("v_means2d", "v_depths", "v_conics", "v_opacities2d"),
    "tiles": (),
    "colors": ("v_colors",),
    "composite": ("v_image", "v_alpha"),
    "total": ("v_means_projection", "v_means_colors", "v_R_projection", "v_R_colors", "v_t_projection", "v_t_colors"),
    "loss": (),
    "features": ("v_feature_image", "v_accumulated_depth"),
    "statistics": (),
    "surface": ("v_surface_points", "v_surface_depths"),
    "view": ("v_image", "v_alpha", "v_expected_depth"),
    "adam": (),
}
"""The arrays that each stage's gradient reads in addition; the loss's starts from dL/d loss = 1, and ``total`` adds
shares."""


def names_of(stage: str, *roles: Role) -> tuple[str, ...]:
    """Names of a stage's own arrays in these roles."""
    return tuple(spec.name for spec in SPECS.values() if spec.stage == stage and spec.role in roles)


class Golden(NamedTuple):
    """A scene with arrays of the golden format: its inputs alone, or all."""

    name: str
    what: str
    conventions: Conventions
    arrays: Arrays
    is_exact: bool = False
    """Whether values equal their thresholds in binary, so that nothing is left to rounding in float64."""

    @property
    def camera(self) -> Camera:
        """The view, in float64."""
        a = self.arrays
        fx, fy, cx, cy = map(float, a["intrinsics"])
        width, height = map(int, a["image_size"])
        return Camera(a["cam_from_world_R"], a["cam_from_world_t"], fx, fy, cx, cy, width, height)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics; all that is stored is used."""
        return round((self.arrays["sh_rest"].shape[1] + 1) ** 0.5) - 1


FRAMES = {
    "world": "right-handed; any unit, here called world unit",
    "camera": "right-handed, OpenCV axes: x right, y down, z forward; x_cam = R x_world + t",
    "image": "pixels, x right, y down; the centre of the top-left pixel is at (0.5, 0.5)",
    "quaternions": "w, x, y, z; any length, used after division by their length",
    "matrices": "row-major, as C arrays",
    "spherical harmonics": "real, orthonormal, with Condon-Shortley signs, order m = -l..l: as in 3DGS PLY files",
}

DIFFERENTIATED = "L = sum(v_image * image) + sum(v_alpha * alpha) + sum(v_depths * depths)"

TEXT = """\
# Golden vectors of a Gaussian-splatting renderer

Inputs, outputs, cotangents and gradients of every stage, in float64, from the reference of minisplat_ref. With them a
renderer in any language can be tested, stage by stage, without our code.

## In three lines

    minisplat-ref oracle export golden    # this folder
    YOUR_PROGRAM golden mine              # reads golden/SCENE/*.npz, writes mine/SCENE/*.npz
    minisplat-ref oracle compare mine     # a table; names the first stage that differs

Write only what your program can give, into .npz files of any name in `mine/SCENE/`, by the names below; float32 or
float64. What is missing is reported as not given. To find the stage that is wrong, feed every stage with the arrays of
*this* folder (the table of stages says which), not with your own results of the stage before.
`oracle compare mine --against golden` compares with this very folder instead of recomputing the reference.

## How to read it

`manifest.json` says the same as this page, for programs: format version, frames, arrays, tolerances, stages and, for
each scene, its conventions in numbers and the SHA-256 of its files. An .npz is an uncompressed zip of .npy files, one
for each array (`means2d.npy`, ...). A .npy is a short header with dtype, shape and order (always C order,
little-endian), then the numbers. https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html

## Frames

{frames}

## The loss that is differentiated

    {loss}

`v_x` is dL/dx and has the shape of x. So `v_image`, `v_alpha` and `v_depths` are given, and every other `v_` follows
by the chain rule. The cotangents of images are 0 at pixels whose alpha or transmittance is so near a threshold that
rounding decides, and `v_depths` is 0 at culled Gaussians.

The other stages are each by itself; nothing of L depends on them:

- `loss`: `v_image_of_loss` and `v_image_of_masked_loss` are the gradients of `loss` and of `masked_loss`. Outside the
  mask the image is replaced by the photograph before anything is computed, and the means run over the mask.
- `features`: other channels than three, and depths blended as one more with the background 0. Its gradients are those
  of F = sum(v_feature_image * feature_image) + sum(v_accumulated_depth * accumulated_depth).
- `statistics`: of the weights w = alpha T with which hits are blended. Of equal weights the front-most dominates.
- `surface`: where the ray of pixel (i, j), of camera z 1, meets the Gaussian `surface_ids[i, j]`: the point of least
  Mahalanobis distance from its mean; 0 where there is none or it lies behind the camera. The gradients are those of
  S = sum(v_surface_points * surface_points) + sum(v_surface_depths * surface_depths).
- `view`: the whole renderer in one call. Its last channel is the expected depth, accumulated depth / alpha. Its
  gradients are those of V = sum(v_image * image) + sum(v_alpha * alpha) + sum(v_expected_depth * expected depth). The
  camera's centre is taken as -R^-1 t, and the twelve entries of (R, t) as free.
- `adam`: one step, m <- beta1 m + (1 - beta1) g and v <- beta2 v + (1 - beta2) g^2, then
  p <- p - rate m' / (sqrt(v') + eps) with m' = m / (1 - beta1^k) and v' = v / (1 - beta2^k).

In a scene that is called exact, some values equal their thresholds in binary (a transmittance, an alpha, a depth). In
float64 no rounding is an excuse there: it shows what a renderer does at equality.

`b` of a conic occurs twice in its matrix; `v_conics[:, 1]` is the derivative with respect to b itself and holds both.
Pose gradients are with respect to the nine entries of R as if they were free; compared is their part on the tangent of
SE(3), vee(R^T v_R) and v_t, in which a camera centre of -R^T t makes no difference. Skips, stops, boxes and the order
of the Gaussians count as fixed.

## Stages

{stages}

## Arrays

N Gaussians, R higher coefficients of the spherical harmonics, M (tile, Gaussian) pairs, T1 tiles + 1, H x W pixels, F
further channels, I x J rays, A x P parameters of Adam, V rows of them that a step updates.
Rows of culled Gaussians are 0 in the outputs and gradients of every stage. Tolerances are parts of the largest
magnitude in the array.

{arrays}

Radii, boxes and tile lists may be larger than ours, or for other tiles (write your `tile_size`): a difference that does
not change the image is reported as harmless.

## Conventions

Each scene has a value for each of these; `manifest.json` holds them in full.

{conventions}

## Scenes

{scenes}
"""


def readme(scenes: Mapping[str, Golden]) -> str:
    """README of a folder with these scenes."""
    stages = [
        (
            stage,
            _list_names(STAGE_INPUTS[stage]),
            _list_names(names_of(stage, "output")),
            _list_names(STAGE_COTANGENTS[stage]),
            _list_names(names_of(stage, "gradient")),
        )
        for stage in STAGE_INPUTS
    ]
    arrays = [
        (
            f"`{spec.name}`",
            f"{spec.stage}.npz",
            spec.kind,
            f"[{', '.join(map(str, spec.shape))}]",
            spec.unit,
            f"{spec.role}: {spec.meaning}",
            f"{spec.tolerance.float64:g}",
            f"{spec.tolerance.float32:g}",
            spec.tolerance.reason,
        )
        for spec in SPECS.values()
    ]
    described = [_scene(scene) for scene in scenes.values()]
    return TEXT.format(
        loss=DIFFERENTIATED,
        conventions="\n".join(f"- `{names}`: {words}" for names, words in convention_words().items()),
        frames="\n".join(f"- {name}: {words}" for name, words in FRAMES.items()),
        stages=_table(("stage", "reads", "gives", "gradient reads also", "gradient gives"), stages),
        arrays=_table(
            ("array", "file", "dtype", "shape", "unit", "role and meaning", "float64", "float32", "reason"), arrays
        ),
        scenes="\n".join(described),
    )


def convention_words() -> dict[str, str]:
    """The meaning of each field of :class:`Conventions`, from its documentation, by its name or names."""
    words: dict[str, str] = {}
    _, _, attributes = inspect.cleandoc(Conventions.__doc__ or "").partition("----------\n")
    for line in attributes.splitlines():
        if not line.startswith(" "):
            names = line.partition(" : ")[0]
        else:
            words[names] = f"{words.get(names, '')} {line.strip()}".strip()
    return words


def _scene(scene: Golden) -> str:
    width, height = scene.arrays["image_size"]
    c = scene.conventions
    rules = (
        f"near {c.near_plane:g}, low-pass {c.eps2d:g} px^2, alpha from {c.alpha_min:.6f} to {c.alpha_max:g}, stop at"
        f" T {'<=' if c.stops_at_equality else '<'} {c.transmittance_min:g},"
        f" {'full support' if c.has_full_support else 'boxes of 3 sigma, rounded to 16 px'},"
        f" principal point {'used' if c.uses_principal_point else 'ignored'},"
        f" {'symmetric' if c.clamp_is_symmetric else 'asymmetric'} clamp of the Jacobian"
        f"{', antialiased' if c.is_antialiased else ''}"
    )
    n, exact = len(scene.arrays["means"]), "exact, " if scene.is_exact else ""
    return f"- `{scene.name}`: {scene.what}. {n} Gaussians, {exact}{width} x {height} px; {c.name}: {rules}."


def _list_names(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _table(headings: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    return markdown_table(headings, rows, is_aligned=False)  # whole sentences in columns would be wider than a screen
