"""The contract of a backend: one protocol per stage, in the order of a training step.

A protocol states what a stage takes and returns, with the shapes as comments; the function of the same name in
:mod:`minisplat_ref.reference` documents the meaning and the equations. There are N Gaussians, K spherical-harmonic
coefficients per channel, D image channels, H x W pixels and P points of structure from motion. The arrays of one call
share a dtype, float32 or float64, and so do the results; only conics and their gradient may be float64 throughout. Only
:class:`AdamUpdate` changes arrays in place.

The tape of a loss belongs to the backend that made it: it may be any value, which only that backend's gradient reads.
"""

from typing import Any, Protocol

from minisplat_ref.constants import Conventions
from minisplat_ref.types import (
    AdamStep,
    Bools,
    Camera,
    CompositeGradient,
    Floats,
    Ints,
    PrimitiveGradient,
    Projection,
    ProjectionGradient,
    RenderOutput,
    SHGradient,
    SurfacePoints,
    TileBins,
    TileGrid,
)


class Project(Protocol):
    """Project every Gaussian into the image."""

    def __call__(
        self,
        means: Floats,  # [N, 3] world frame
        quats: Floats,  # [N, 4] wxyz, any length but zero
        scales: Floats,  # [N, 3] standard deviations, world units
        opacities: Floats,  # [N] in [0, 1]
        camera: Camera,
        conventions: Conventions,
    ) -> Projection: ...


class ProjectVjp(Protocol):
    """Chain the gradient of a projection to the Gaussians and the camera's pose."""

    def __call__(
        self,
        means: Floats,  # [N, 3], and so on as for Project
        quats: Floats,  # [N, 4]
        scales: Floats,  # [N, 3]
        opacities: Floats,  # [N]
        camera: Camera,
        conventions: Conventions,
        projection: Projection,
        v_projection: ProjectionGradient,
    ) -> PrimitiveGradient: ...


class SHColors(Protocol):
    """Evaluate the colours [N, 3] towards the camera; zeros where a Gaussian was culled."""

    def __call__(
        self,
        means: Floats,  # [N, 3] world frame
        sh_dc: Floats,  # [N, 3]
        sh_rest: Floats,  # [N, K-1, 3]
        camera: Camera,
        degree: int | Ints,  # active, at most the stored one: of all Gaussians, or [N] of each
        radii: Ints,  # [N, 2] of the projection, 0 where culled
    ) -> Floats: ...


class SHColorsVjp(Protocol):
    """Chain the gradient of the colours to means, coefficients and the camera's pose."""

    def __call__(
        self,
        means: Floats,  # [N, 3], and so on as for SHColors
        sh_dc: Floats,  # [N, 3]
        sh_rest: Floats,  # [N, K-1, 3]
        camera: Camera,
        degree: int | Ints,
        radii: Ints,  # [N, 2]
        v_colors: Floats,  # [N, 3]
    ) -> SHGradient: ...


class BinGaussians(Protocol):
    """List for every tile the Gaussians that may touch it, front to back."""

    def __call__(self, projection: Projection, grid: TileGrid, conventions: Conventions) -> TileBins: ...


class Composite(Protocol):
    """Blend every tile's Gaussians front to back."""

    def __call__(
        self,
        projection: Projection,
        colors: Floats,  # [N, D]
        background: Floats,  # [D]
        bins: TileBins,
        conventions: Conventions,
        *,
        with_stats: bool = False,
        with_median_depth: bool = False,
    ) -> RenderOutput: ...


class CompositeVjp(Protocol):
    """Chain the gradient of the image to footprints, colours and background."""

    def __call__(
        self,
        projection: Projection,
        colors: Floats,  # [N, D]
        background: Floats,  # [D]
        bins: TileBins,
        conventions: Conventions,
        output: RenderOutput,  # of the same backend's Composite
        v_image: Floats,  # [H, W, D]
        v_alpha: Floats,  # [H, W]
    ) -> CompositeGradient: ...


class RemovalChanges(Protocol):
    """Compute for each Gaussian [N], float64, the squared change of the image without it."""

    def __call__(
        self,
        projection: Projection,
        colors: Floats,  # [N, D]
        bins: TileBins,
        conventions: Conventions,
        output: RenderOutput,  # of the same backend's Composite, and perhaps light from behind all hits in its image
    ) -> Floats: ...


class ComputeSurfacePoints(Protocol):
    """Find where each pixel's ray meets its dominant Gaussian."""

    def __call__(
        self,
        means: Floats,  # [N, 3] world frame
        quats: Floats,  # [N, 4] wxyz
        scales: Floats,  # [N, 3]
        camera: Camera,
        dominant_ids: Ints,  # [H, W] -1 where there is none
    ) -> SurfacePoints: ...


class SurfacePointsVjp(Protocol):
    """Chain the gradient of the surface points to means [N, 3], quats [N, 4] and scales [N, 3]."""

    def __call__(
        self,
        means: Floats,  # [N, 3]
        quats: Floats,  # [N, 4]
        scales: Floats,  # [N, 3]
        camera: Camera,
        dominant_ids: Ints,  # [H, W]
        v_points: Floats,  # [H, W, 3]
        v_depths: Floats,  # [H, W]
    ) -> tuple[Floats, Floats, Floats]: ...


class PhotometricLoss(Protocol):
    """Evaluate the distance of an image from a photograph; return it with a tape for the gradient."""

    def __call__(
        self,
        image: Floats,  # [H, W, 3]
        target: Floats | Ints,  # [H, W, 3], uint8 or in [0, 1]
        dssim_weight: float,
        mask: Bools | None = None,  # [H, W] True where a pixel counts
    ) -> tuple[float, Any]: ...


class PhotometricLossVjp(Protocol):
    """Chain ``v_loss`` to the image [H, W, 3]."""

    def __call__(self, tape: Any, v_loss: float = 1.0) -> Floats: ...


class AdamUpdate(Protocol):
    """Update values and both moments in place, one step of Adam."""

    def __call__(
        self,
        values: Floats,  # [N, W]
        gradient: Floats,  # [N, W]
        first: Floats,  # [N, W] mean gradient
        second: Floats,  # [N, W] mean squared gradient
        rows: Ints | None,  # [V] to update, each once; None for all
        step: AdamStep,
        widths: Ints | None = None,  # [N] numbers of each row to update, the first ones; None for all
    ) -> None: ...
