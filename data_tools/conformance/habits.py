"""The rules of a renderer: a profile, and habits that no profile has; the reference renders by both.

A profile says what rasterisers of trainers choose. Viewers draw quads: they cut Gaussians off at the border of the
quad, lower them to 0 there, bound them in pixels, hide those whose centre is outside, and store colours in bytes.
"""

from typing import Any, NamedTuple

import numpy as np

from data_tools.conformance.probes import Probe, camera_of
from data_tools.conformance.storing import EXACT, Storage
from minisplat_ref.constants import GSPLAT_1_5, GSPLAT_MAIN, Conventions
from minisplat_ref.oracle.faults import FAULTS, Fault
from minisplat_ref.oracle.faults.forward import with_slope_limits
from minisplat_ref.reference.hits import TileHits, tile_hits, transmit
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.types import Bools, Camera, Floats, Gaussians, Projection, TileBins, TileGrid

VIEWER = GSPLAT_MAIN._replace(name="VIEWER", alpha_max=1.0, transmittance_min=0.0)
"""The rules of a blending unit: no clamp of alpha, no stop."""
SQRT_8 = 8**0.5
NONE = Fault("", "projection")
FORWARD = tuple(f for f in FAULTS if f.is_forward and "expected depths" not in f.what and "accumulated" not in f.what)
"""Planted faults that change a picture."""
TILE = 16
FAR_SLOPES = 1e6
FLAT = 1e-9  # off-diagonal of a covariance that is none


class Habits(NamedTuple):
    """The rules by which all pictures of a renderer are judged."""

    conventions: Conventions
    deviations: float | None = None
    """Beyond which a Gaussian is cut off."""
    is_lowered: bool = False
    """Whether the falloff is lowered and stretched, so that it is 0 where it is cut off and 1 in the middle."""
    storage: Storage = EXACT
    centres: tuple[float, float] = (0.5, 0.5)
    """Of pixels, in x and y."""
    beyond: float | None = None
    """Times the half image, from its middle, beyond which a centre's Gaussian is hidden."""
    widest: float | None = None
    """Largest deviation, px; wider axes are shortened to it."""
    narrowest: float = 0.0
    """Smallest eigenvalue of the covariance, px^2; smaller ones are raised to it."""
    least_root: float = 0.0
    """Least half difference of the eigenvalues, px^2; what it makes negative is hidden."""
    least_size: float = 0.0
    """Least longest deviation, px; smaller Gaussians are hidden."""
    box: tuple[float, int] | None = None
    """Deviations in x and y, and further pixels, beyond which a Gaussian is cut off."""
    degree: int = 3
    """Of the harmonics that are shown."""
    color_max: float | None = None
    has_distances: bool = False
    """Whether Gaussians are sorted by distance from the camera in place of depth."""
    is_in_file_order: bool = False
    """Whether Gaussians are not sorted: the first of the file is in front."""
    is_last_first: bool = False
    """Whether the last of the file is in front at equal depths."""
    has_free_slopes: bool = False
    """Whether the Jacobian's slopes are not clamped."""
    largest_scale: float | None = None
    """Deviation, in the world's units, from which on a Gaussian is hidden: its covariance overflows."""
    fades_at: float | None = None
    """Near plane before which opacities and colours are dimmed."""
    axis_epsilon: float | None = None
    """Added to four times the longer eigenvalue l, where its axis is (b, l - a) for a covariance [[a, b], [b, d]].

    An upright Gaussian that is at least as wide as high is then hidden, or turned by a right angle. None: it has axes.
    """
    white_tiles: int = 0
    """Side of the tiles, px, that stay white if no Gaussian's square of three deviations touches them."""
    has_raw_directions: bool = False
    """Whether harmonics take directions that are not normalised."""

    @property
    def rules(self) -> dict[str, str]:
        """Return what differs from the profile, in words, by the field."""
        c = self.conventions
        base = next(profile for profile in (VIEWER, GSPLAT_1_5, GSPLAT_MAIN) if profile.name == c.name)
        said = (
            ("near_plane", f"a near plane of {c.near_plane:.3g}"),
            ("eps2d", f"a low-pass of {c.eps2d:.3g} px^2" if c.eps2d else "no low-pass"),
            ("is_antialiased", "opacities compensated for the low-pass"),
            ("alpha_min", f"a least alpha of {c.alpha_min:.3g}"),
            ("alpha_max", f"alpha clamped at {c.alpha_max:.3g}"),
            ("uses_principal_point", "the principal point in the image's middle"),
            ("clamp_is_symmetric", "slopes of the Jacobian clamped on both sides of the axis alike"),
            ("centres", f"pixel centres at {self.centres[0]:.3g} in x and {self.centres[1]:.3g} in y"),
            ("deviations", f"cut at {self.deviations or 0:.2f} deviations"),
            ("is_lowered", "lowered to 0 there"),
            ("box", f"cut at {(self.box or (0, 0))[0]:.0f} deviations in x and in y"),
            ("storage", f"stored in {self.storage.words}"),
            ("degree", f"harmonics of degree {self.degree} at most" if self.degree else "no harmonics"),
            ("color_max", f"colours clamped at {self.color_max or 0:.3g}"),
            ("has_raw_directions", "viewing directions that are not normalised"),
            ("white_tiles", f"tiles of {self.white_tiles} px without a Gaussian white"),
            ("has_distances", "order by distance"),
            ("is_in_file_order", "the order of the file"),
            ("is_last_first", "the last of the file in front at equal depths"),
            ("has_free_slopes", "slopes of the Jacobian that are not clamped"),
            ("beyond", f"hidden with a centre beyond {self.beyond or 0:.3g} half images"),
            ("widest", f"deviations of {self.widest or 0:.0f} px at most"),
            ("narrowest", f"eigenvalues of {self.narrowest:.3g} px^2 at least"),
            ("least_root", f"eigenvalues {2 * self.least_root:.2f} px^2 apart at least, hidden if one is negative"),
            ("least_size", f"hidden below {self.least_size:.2f} px"),
            ("largest_scale", f"hidden with a scale of {self.largest_scale or 0:.3g} or more"),
            ("fades_at", f"dimmed before a depth of {self.fades_at or 0:.3g}"),
            ("axis_epsilon", "upright ellipses at least as wide as high hidden, or turned"),
        )
        plain = base._asdict() | self._field_defaults
        own = c._asdict() | self._asdict()
        return {name: words for name, words in said if own[name] != plain[name]}

    @property
    def name(self) -> str:
        """Return the profile and what differs from it."""
        return ", ".join((self.conventions.name, *self.rules.values()))

    def weigh(self, tile: TileHits, projection: Projection) -> tuple[Floats, Floats]:
        """Return the weights of hits that are cut off, and the share of the background."""
        alphas, falloffs = tile.alphas, tile.hit.place.falloffs
        if self.deviations is not None:
            least = np.exp(-(self.deviations**2) / 2)
            alphas = np.where(falloffs >= least, alphas, 0)
            if self.is_lowered:
                lowered = np.maximum(falloffs - least, 0) / (1 - least)
                alphas = tile.hit.unclamped * lowered / np.maximum(falloffs, least / 2)
                alphas = np.where(
                    alphas >= self.conventions.alpha_min, np.minimum(alphas, self.conventions.alpha_max), 0
                )
        if self.box is not None:
            alphas = np.where(self._in_box(tile, projection), alphas, 0)
        T = transmit(alphas)
        return alphas * T[:-1], T[-1]

    def _in_box(self, tile: TileHits, projection: Projection) -> Bools:
        deviations, more = self.box or (np.inf, 0)
        B = covariances2d(projection)[tile.ids]
        reach = deviations * np.sqrt(np.stack([B[:, 0, 0], B[:, 1, 1]], axis=1))[:, None]
        centres = projection.means2d[tile.ids, None] - 0.5
        pixels = centres - tile.hit.place.offsets
        low, high = np.floor(centres - reach) - more, np.ceil(centres + reach) + more
        return np.asarray(((pixels > low - 0.5) & (pixels < high - 0.5)).all(axis=2))

    def reshape(self, p: Projection) -> Projection:
        """Return the footprints that are shown, with their bounds in pixels."""
        shown = p.radii[:, 0] > 0
        B = covariances2d(p)
        values, vectors = np.linalg.eigh(B)
        shown &= np.sqrt(values[:, 1]) >= self.least_size
        if self.least_root:
            middle, half = values.mean(axis=1), np.maximum((values[:, 1] - values[:, 0]) / 2, self.least_root)
            values = np.stack([middle - half, middle + half], axis=1)
            shown &= values[:, 0] > 0
        if self.axis_epsilon is not None:
            longer = self._longer_axes(B)
            lengths = np.linalg.norm(longer, axis=1, keepdims=True)
            shown &= lengths[:, 0] > 0
            x, y = np.moveaxis(longer / np.maximum(lengths, 1e-30), 1, 0)
            vectors = np.stack([np.stack([y, -x], axis=1), np.stack([x, y], axis=1)], axis=2)
        values = np.clip(values, max(self.narrowest, FLAT), np.inf if self.widest is None else self.widest**2)
        Q = np.einsum("nik,nk,njk->nij", vectors, 1 / values, vectors)
        conics = np.column_stack([Q[:, 0, 0], Q[:, 0, 1], Q[:, 1, 1]])
        return p._replace(conics=np.where(shown[:, None], conics, 0), radii=np.where(shown[:, None], p.radii, 0))

    def _longer_axes(self, B: Floats) -> Floats:
        """Return (b, l - a) of covariances [N, 2], as single precision rounds it."""
        is_upright = np.abs(B[:, 0, 1]) < FLAT * B[:, 0, 0]
        factor = 1 if self.least_root else 4
        a, d = (np.float32(factor) * B[:, k, k].astype(np.float32) for k in (0, 1))
        b = np.where(is_upright, 0, factor * B[:, 0, 1]).astype(np.float32)
        middle = np.float32(0.5) * (a + d)
        if self.least_root:
            root = np.sqrt(np.maximum(np.float32(self.least_root**2), middle * middle - (a * d - b * b)))
        else:
            root = np.sqrt(((a - d) / np.float32(2)) ** 2 + b * b)
        longer = middle + root + np.float32(self.axis_epsilon or 0)
        return np.stack([b, longer - a], axis=1).astype(np.float64)

    def whiten(self, image: Floats, p: Projection) -> Floats:
        """Return an image whose tiles that no square of a Gaussian touches are white."""
        if not self.white_tiles:
            return image
        values = np.linalg.eigvalsh(covariances2d(p))
        apart = np.maximum((values[:, 1] - values[:, 0]) / 2, 0.1**0.5)
        reach = 3 * np.ceil(np.sqrt(values.mean(axis=1) + apart))[:, None]
        size = np.array(image.shape[1::-1])
        low, high = (np.clip(p.means2d - 0.5 + sign * reach, 0, size - 1) for sign in (-1, 1))
        changed, side = image.copy(), self.white_tiles
        for y in range(0, size[1], side):
            for x in range(0, size[0], side):
                corner = np.array([x, y])
                is_touched = (np.minimum(high, corner + side - 1) > np.maximum(low, corner)).all(axis=1)
                if not (is_touched & (p.radii[:, 0] > 0)).any():
                    changed[y : y + side, x : x + side] = 1
        return changed

    def hide(self, p: Projection, scales: Floats, camera: Camera) -> Projection:
        """Return the footprints without those whose centre is too far outside, or whose scales are too large."""
        half, shown = np.array([camera.width, camera.height]) / 2, p.radii[:, 0] > 0
        if self.beyond is not None:
            shown &= (np.abs(p.means2d - half) <= self.beyond * half).all(axis=1)
        if self.largest_scale is not None:
            shown &= (scales < self.largest_scale).all(axis=1)
        return p._replace(radii=np.where(shown[:, None], p.radii, 0))

    def fade(self, depths: Floats) -> Floats:
        """Return factors [N] of opacities and colours: the clip coordinate of the depth plus one, between 0 and 1."""
        if self.fades_at is None:
            return np.ones(len(depths))
        return np.clip(2 - self.fades_at / np.maximum(depths, FLAT), 0, 1)

    def keys(self, p: Projection, means: Floats, camera: Camera) -> Floats:
        """Return what Gaussians are sorted by [N]; 0 where they are not shown."""
        keys = p.depths
        if self.has_distances:
            keys = np.linalg.norm(means @ camera.cam_from_world_R.T + camera.cam_from_world_t, axis=1)
        if self.is_in_file_order:
            keys = 1.0 + np.arange(len(keys))
        if self.is_last_first:
            keys = keys * (1 - 1e-9 * np.arange(len(keys)))
        return np.where(p.radii[:, 0] > 0, keys, 0)

    def shade(self, backend: Backend, g: Gaussians, camera: Camera, radii: Any) -> Floats:
        """Return the colours [N, 3]."""
        degree = min(self.degree, int(np.sqrt(g.sh_rest.shape[1] + 1)) - 1)
        means, seen = g.means.astype(np.float64), camera
        if self.has_raw_directions:
            rays = means @ camera.cam_from_world_R.T + camera.cam_from_world_t
            weights = np.linalg.norm(rays, axis=1)[:, None, None]
            bands = np.repeat([1, 2, 3], [3, 5, 7])[: g.sh_rest.shape[1], None]
            g = g._replace(sh_rest=g.sh_rest * weights**bands)
        colors = backend.sh_colors(means, g.sh_dc.astype(np.float64), g.sh_rest.astype(np.float64), seen, degree, radii)
        return colors if self.color_max is None else np.minimum(colors, self.color_max)


def covariances2d(p: Projection) -> Floats:
    """Return the covariances [N, 2, 2] of footprints, the unit matrix where there is none."""
    Q = np.where((p.radii[:, 0] > 0)[:, None], p.conics, (1, 0, 1))[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.asarray(np.linalg.inv(Q))


class Shown(NamedTuple):
    """A probe by a renderer's habits."""

    image: Floats
    projection: Projection
    bins: TileBins


def show(probe: Probe, habits: Habits, fault: Fault = NONE, size: float = 1.0) -> Shown:
    """Render a probe by a renderer's habits, with a fault.

    A fault of the blending replaces the cut; where the rules cut nothing off, footprints are bounded by alpha alone.
    """
    c, camera, g = habits.conventions, camera_of(probe), habits.storage.change(probe.gaussians)
    backend = with_slope_limits(FAR_SLOPES) if habits.has_free_slopes and not fault.what else fault.plant(size)
    means, quats, logs, logits = (np.asarray(a, np.float64) for a in (g.means, g.quats, g.log_scales, g.opacity_logits))
    scales = np.exp(logs)
    with np.errstate(all="ignore"):
        p = backend.project(means, quats, scales, 1 / (1 + np.exp(-logits)), camera, c)
        p = p._replace(means2d=p.means2d + 0.5 - np.array(habits.centres))
        p = habits.hide(habits.reshape(p), scales, camera)
        fade = habits.fade(p.depths)
        p = p._replace(opacities=p.opacities * fade)
        colors = habits.shade(backend, g, camera, p.radii) * fade[:, None]
        shown = p.radii[:, :1] > 0
        if c.has_full_support and not fault.has_own_bounds:
            p = p._replace(boxes=np.where(shown, [0, 0, camera.width, camera.height], 0).astype(np.int32))
        p = p._replace(boxes=np.where(shown, p.boxes, 0))
        grid = TileGrid(camera.width, camera.height, TILE, TILE)
        bins = backend.bin_gaussians(p._replace(depths=habits.keys(p, g.means, camera)), grid, c)
        behind = np.array(probe.background)
        output = backend.composite(p, colors, behind, bins, c)
        if (habits.deviations is not None or habits.box is not None) and fault.where != "blending":
            for tile in tile_hits(p, bins, c):
                weights, T_end = habits.weigh(tile, p)
                output.image[tile.ys, tile.xs] = weights.T @ colors[tile.ids] + T_end[:, None] * behind
        image = habits.whiten(output.image, p)
        if fault.after is not None:
            image = fault.after({"image": image, "alpha": output.alpha}, size)["image"]
    return Shown(np.nan_to_num(image), p, bins)


def image_of(probe: Probe, habits: Habits, fault: Fault = NONE, size: float = 1.0) -> Floats:
    """Return the reference's image [H, W, 3] of a probe by a renderer's habits, with a fault."""
    return show(probe, habits, fault, size).image
