"""Loss terms: few opaque Gaussians, the same surface from a camera beside, shadows that are there or not (EOGS)."""

import numpy as np

from minisplat_ref.extensions.satellite.reference import altitudes, altitudes_vjp, sample, sample_vjp
from minisplat_ref.extensions.satellite.renderer import affine_of, depth_sums, sheared, splat_view, splat_view_vjp
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.types import Floats

FLOOR = 1e-6  # of a shadow and of its complement in the entropy, whose slope at 0 has no bound


def opacity_sparsity(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return ``sum o / N_0``, N_0 the number of points that training begins with.

    ``dL/dlogit = o (1 - o) / N_0``.
    """
    logits = rendered.model.gaussians.opacity_logits
    o = 1 / (1 + np.exp(-logits))
    n = max(len(rendered.scene.points), 1)
    return float(o.sum() / n), Cotangents(gaussians={"opacity_logits": o * (1 - o) / logits.dtype.type(n)})


def shadow_entropy(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of ``-s ln s - (1 - s) ln(1 - s)``; its slope is ``ln((1 - s) / s)``, 0 where s is 0 or 1."""
    s = rendered.channel("shadow")
    inside = (s > FLOOR) & (s < 1 - FLOOR)
    kept = np.where(inside, s, s.dtype.type(0.5))
    entropy = -kept * np.log(kept) - (1 - kept) * np.log(1 - kept)
    slope = np.where(inside, np.log((1 - kept) / kept), 0).astype(s.dtype) / s.dtype.type(s.size)
    return float(np.sum(np.where(inside, entropy, 0)) / s.size), Cotangents({"shadow": slope})


def shear_of(rendered: Rendered, noise: float) -> tuple[float, float]:
    """Return a random shear of the view in pixels per unit of altitude, the same whenever the iteration is done.

    ``M' = I + noise`` of the paper is in coordinates of -1 to 1; there the altitudes of the Gaussians span 2.
    """
    camera = affine_of(rendered.view.camera, rendered.request.conventions)
    held = rendered.constant.model.gaussians.means
    z = held @ np.asarray(camera.cam_from_world_R, np.float64)[2]
    half = max(float(np.ptp(z)) / 2, 1e-9) if len(z) else 1.0
    x, y = np.random.default_rng([rendered.step, max(rendered.view.view_id, 0)]).normal(size=2)
    return noise * x * camera.width / 2 / half, noise * y * camera.height / 2 / half


def view_consistency(
    rendered: Rendered, *, altitude: float, color: float, noise: float, limit: float
) -> tuple[float, Cotangents]:
    """Compare the view with one that is sheared at random: both see the same albedo and altitude of a point.

    A pixel p of altitude h is seen at ``p' = p - g h``. Where ``|h - h'(p')| < limit``, else something hides it::

        L = mean(w_h |h - h'(p')| + w_a mean_c |a - a'(p')|)

    Derivatives go to the view's channels and, by the second rendering, to the population; a' and h' are read between
    pixels, so p' depends on h.

    Parameters
    ----------
    rendered : Rendered
        With ``albedo`` and ``altitude``.
    altitude, color : float
        w_h, per unit of altitude, and w_a.
    noise : float
        Standard deviation of the shear; see :func:`shear_of`.
    limit : float
        Units of altitude.
    """
    h, a = rendered.channel("altitude")[..., 0], rendered.channel("albedo")
    camera = affine_of(rendered.view.camera, rendered.request.conventions)
    shift = shear_of(rendered, noise)
    tape = splat_view(rendered.model, sheared(camera, shift, (0, 0)), rendered.request)
    sums, alpha = depth_sums(tape)
    other = np.concatenate([tape.output.image[..., :3], altitudes(sums, alpha)[..., None]], axis=2)
    height, width = h.shape
    x, y = np.arange(width) + 0.5 - shift[0] * h, np.arange(height)[:, None] + 0.5 - shift[1] * h
    read = sample(other, x, y)
    differences = np.concatenate([a, h[..., None]], axis=2) - read.values  # [H, W, 4]
    is_seen = (np.abs(differences[..., 3]) < limit) & (x > 0) & (x < width) & (y > 0) & (y < height)
    weights = np.array([color / 3] * 3 + [altitude]) / h.size
    v = (np.sign(differences) * weights * is_seen[..., None]).astype(h.dtype)  # [H, W, 4]
    v_other, v_places = sample_vjp(read, other.shape, -v)
    v_h = v[..., 3] - shift[0] * v_places[0] - shift[1] * v_places[1]
    of_h = altitudes_vjp(sums, alpha, v_other[..., 3])
    v_image = np.concatenate([v_other[..., :3], of_h.sums[..., None]], axis=2)
    population, _ = splat_view_vjp(rendered.model, tape, np.ascontiguousarray(v_image), of_h.alpha)
    value = float(np.sum(np.abs(differences) * weights * is_seen[..., None]))
    direct: dict[str, Floats] = {name: field for name, field in population._asdict().items() if name != "sh_rest"}
    return value, Cotangents({"albedo": v[..., :3], "altitude": v_h[..., None]}, gaussians=direct)


SPARSITY = LossTerm("opacity_sparsity", opacity_sparsity, weight=0.1)
ENTROPY = LossTerm("shadow_entropy", shadow_entropy, weight=0.01, wants=frozenset({"shadow"}))
