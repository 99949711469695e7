"""The golden format in words, for people who will never read our Python."""

import inspect
from collections.abc import Mapping, Sequence

from minisplat_ref.constants import Conventions
from minisplat_ref.oracle.golden.arrays import SPECS, STAGE_COTANGENTS, STAGE_INPUTS, names_of
from minisplat_ref.oracle.golden.scenes import Golden
from minisplat_ref.reporting import markdown_table

FRAMES = {
    "world": "right-handed; any unit, here called world unit",
    "camera": "right-handed, OpenCV axes: x right, y down, z forward; x_cam = R x_world + t",
    "image": "pixels, x right, y down; the centre of the top-left pixel is at (0.5, 0.5)",
    "quaternions": "w, x, y, z; any length, used after division by their length",
    "matrices": "row-major, as C arrays",
    "spherical harmonics": "real, orthonormal, with Condon-Shortley signs, order m = -l..l: as in 3DGS PLY files",
}

LOSS = "L = sum(v_image * image) + sum(v_alpha * alpha) + sum(v_depths * depths)"

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
*this* folder (the table of stages says which), not with your own results of the stage before. `compare mine --against
golden` compares with this very folder instead of computing the reference anew.

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
by the chain rule. `v_image` and `v_alpha` are 0 at pixels whose alpha or transmittance is so near a threshold that
rounding decides, and `v_depths` is 0 at culled Gaussians. The loss stage is by itself: its gradient `v_image_of_loss`
is that of `loss`, not of L.

`b` of a conic stands twice in its matrix; `v_conics[:, 1]` is the derivative by b itself, so it holds both. Pose
gradients are by the nine entries of R as if they were free. Skips, stops, boxes and the order of the Gaussians count as
fixed.

## Stages

{stages}

## Arrays

N Gaussians, R higher coefficients of the spherical harmonics, M (tile, Gaussian) pairs, T1 tiles + 1, H x W pixels.
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
            _listed(STAGE_INPUTS[stage]),
            _listed(names_of(stage, "output")),
            _listed(STAGE_COTANGENTS[stage]),
            _listed(names_of(stage, "gradient")),
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
        loss=LOSS,
        conventions="\n".join(f"- `{names}`: {words}" for names, words in convention_words().items()),
        frames="\n".join(f"- {name}: {words}" for name, words in FRAMES.items()),
        stages=_table(("stage", "reads", "gives", "gradient reads also", "gradient gives"), stages),
        arrays=_table(
            ("array", "file", "dtype", "shape", "unit", "role and meaning", "float64", "float32", "reason"), arrays
        ),
        scenes="\n".join(described),
    )


def convention_words() -> dict[str, str]:
    """What each field of :class:`Conventions` means, by its name or names: the words of its own documentation."""
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
    n = len(scene.arrays["means"])
    return f"- `{scene.name}`: {scene.what}. {n} Gaussians, {width} x {height} px; {c.name}: {rules}."


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _table(headings: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    return markdown_table(headings, rows, is_aligned=False)  # whole sentences in columns would be wider than a screen
