"""The alternatives of all stages but the background, whose formulas are in :mod:`.backgrounds` beside them.

An alternative is a function, and ``--set STAGE=NAME`` takes those of this file that have the same parameters:

- ``initialiser``, the Gaussians with which a training begins: takes the Gaussians of the scene's points, and the scene;
  None leaves the former as they are.
- ``representation``, the kind of primitives. All have the six fields of 3DGS.
- ``photo_loss``, the comparison of an image with its photograph.
- ``sky_mask``, the pixels of a photograph that show the sky. GauStudio takes masks from a network. Here they are an
  input, or derived from the colours: from the upper edge of the photograph down, pixels that are bright and more blue
  than red, or white. That takes for sky whatever looks like it.
- ``density``, the treatment of Gaussians whose images move, at the dates of 3DGS.
"""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from minisplat_ref.errors import InputError
from minisplat_ref.io.images import read_mask, resize_mask
from minisplat_ref.mechanisms.oriented.planes import N_AXES, flatten_on_planes
from minisplat_ref.mechanisms.surfels.discs import as_surfels
from minisplat_ref.mechanisms.surfels.renderer import SURFELS
from minisplat_ref.methods.gaussian_splatting import clone_and_split
from minisplat_ref.rendering import SPLATTING, Renderer
from minisplat_ref.strategy.halving import halves as halve
from minisplat_ref.strategy.initialization import gaussians_from_means, gaussians_from_points
from minisplat_ref.strategy.ops import n_rows
from minisplat_ref.training.dense_start import densify_points
from minisplat_ref.training.losses import Cotangents, Rendered, photometric
from minisplat_ref.training.representation import as_it_is
from minisplat_ref.training.state import Iteration, TrainState, apply_edit
from minisplat_ref.types import Bools, Gaussians, Scene, View

BOX_SHARE = 0.02  # of the points that may lie outside of the box on either side of an axis
LARGEST = 0.05  # of the scene's extent, a standard deviation in the box: density control removes those above 0.1
DSSIM_WEIGHT = 0.2  # of 3DGS
BRIGHT = 110  # of 255, in blue
BLUER = 1.1  # times the red: in the shade roads are bluish, too. Chosen on photographs with a sky and without
WHITE = 225  # of 255, in the darkest channel: a cloud, whatever its tint
ASPECT = 0.02  # relative difference of the ratios of sides beyond which a mask is not of this photograph
THRESHOLD, SIZE_FRACTION = 2e-4, 0.01  # of 3DGS


# --- initialiser ---


def points(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """A round Gaussian at each point of the scene, as in 3DGS."""
    return None


def planes(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """The same, flattened onto the planes of their neighbours."""
    return None if n_rows(gaussians) < N_AXES else flatten_on_planes(gaussians, gaussians.means)


def stereo(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """The scene's points, and points between them that stereo finds."""
    found, colors = densify_points(scene)
    degree = int(np.sqrt(gaussians.sh_rest.shape[1] + 1)) - 1
    return None if len(found) <= N_AXES else gaussians_from_points(found, colors, degree)


def box(gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Gaussians | None:
    """As many, grey, at random in the box of the points.

    They are no larger than a twentieth of the scene's extent.
    """
    if n_rows(gaussians) <= N_AXES:
        return None
    low, high = np.quantile(gaussians.means.astype(np.float64), [BOX_SHARE, 1 - BOX_SHARE], axis=0)
    means = rng.uniform(low, high, gaussians.means.shape)
    made = gaussians_from_means(means, np.zeros_like(gaussians.sh_dc), int(np.sqrt(gaussians.sh_rest.shape[1] + 1)) - 1)
    return made._replace(
        log_scales=np.minimum(made.log_scales, made.log_scales.dtype.type(np.log(LARGEST * scene.extent)))
    )


# --- representation ---


class Primitive(NamedTuple):
    """An alternative of the stage ``representation``."""

    renderer: Renderer
    extend: Callable[[Gaussians, np.random.Generator], Gaussians]
    """Makes them of Gaussians."""


def gaussians() -> Primitive:
    """3D Gaussians."""
    return Primitive(SPLATTING, as_it_is)


def surfels() -> Primitive:
    """Gaussians on discs, those of 2DGS."""
    return Primitive(SURFELS, _as_discs)


def _as_discs(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return surfels; Gaussians that an initialiser has turned, which are not round, keep their axes."""
    discs, is_round = as_surfels(gaussians, rng), np.ptp(gaussians.log_scales, axis=1) == 0  # [N]
    return discs._replace(quats=np.where(is_round[:, None], discs.quats, gaussians.quats))


# --- photo_loss ---


def l1_and_dssim(rendered: Rendered) -> tuple[float, Cotangents]:
    """0.8 L1 + 0.2 (1 - SSIM), that of 3DGS."""
    return photometric(rendered, dssim_weight=DSSIM_WEIGHT)


def l1(rendered: Rendered) -> tuple[float, Cotangents]:
    """The mean absolute difference alone."""
    return photometric(rendered, dssim_weight=0.0)


def squared(rendered: Rendered) -> tuple[float, Cotangents]:
    """The mean squared difference, of which PSNR is the logarithm.

    ::

        L = mean (c - p)^2,   v_c = 2 (c - p) / n        n numbers that the mask leaves
    """
    colors, view = rendered.channel("rgb"), rendered.view
    weights = np.ones(colors.shape[:2], colors.dtype) if view.mask is None else view.mask.astype(colors.dtype)
    n = max(3 * float(weights.sum()), 1.0)
    apart = weights[..., None] * (colors - view.image.astype(colors.dtype) / 255)
    return float(np.sum(apart.astype(np.float64) ** 2)) / n, Cotangents({"rgb": (2 / n * apart).astype(colors.dtype)})


# --- sky_mask ---


def by_color(view: View, mask_folder: str) -> Bools:
    """What is bright and blue, or white, and reaches the upper edge."""
    red, green, blue = view.image.astype(np.float32).transpose(2, 0, 1)
    is_blue = (blue >= BRIGHT) & (blue >= BLUER * red) & (blue >= green)
    is_like_sky = is_blue | (view.image.min(axis=2) >= WHITE)
    regions, _ = label(is_like_sky)
    at_top = np.unique(regions[0])
    return np.isin(regions, at_top[at_top > 0])


def left_out(view: View, mask_folder: str) -> Bools | None:
    """What the photograph's own mask leaves out; no colours are learned there."""
    return None if view.mask is None else ~view.mask


def from_files(view: View, mask_folder: str) -> Bools | None:
    """White pixels of NAME.png in the folder of --set mask_folder=DIR.

    Raises
    ------
    InputError
        There is no folder, no such file, or the mask is of another shape.
    """
    if not mask_folder:
        raise InputError("sky_mask=from_files has no folder to read: add --set mask_folder=DIR")
    return read_for(Path(mask_folder) / f"{view.name}.png", view.camera.width, view.camera.height)


@lru_cache(maxsize=4096)
def read_for(path: Path, width: int, height: int) -> Bools:
    """Return a mask file at the size of a view."""
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such mask; minisplat-ref gaustudio masks SCENE --out {path.parent} writes one for"
            " each photograph"
        )
    mask = read_mask(path)
    if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > ASPECT:
        raise InputError(
            f"{path} has {mask.shape[1]} x {mask.shape[0]} pixels, which is not the shape of the photograph, {width} x"
            f" {height}: give the mask of this photograph"
        )
    return resize_mask(mask, width, height)


# --- density ---


def clones(state: TrainState, iteration: Iteration) -> str | None:
    """Small ones are cloned, large ones split in two at random, as in 3DGS."""
    return clone_and_split(state, iteration, threshold=THRESHOLD, size_fraction=SIZE_FRACTION)


def halves(state: TrainState, iteration: Iteration) -> str | None:
    """Each is replaced by two halves that look the same together."""
    means = state.stats.pop("gradient_sum") / np.maximum(state.stats.pop("view_count"), 1)
    apply_edit(state, halve(state.gaussians, np.flatnonzero(means >= THRESHOLD)))
    return None


def fixed(state: TrainState, iteration: Iteration) -> str | None:
    """Nothing: there are never more than at the start."""
    return "nothing done: the number is fixed"
