"""The losses of EOGS, the recipe ``satellite``, and what the gradient check covers.

Few Gaussians are opaque, a camera beside sees the same surface, and shadows are there or not.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from minisplat_ref.constants import SH_C0
from minisplat_ref.extensions.satellite.model import (
    CHANNELS,
    HAS_SHADOWS,
    IN_SHADOW,
    MIN_ALPHA,
    RADIOMETRY,
    REFERENCE_VIEW,
    SATELLITE,
    Tape,
    altitudes,
    altitudes_vjp,
    choose_affine,
    depth_sums,
    sample,
    sample_vjp,
    sheared,
    splat_view,
    splat_view_vjp,
)
from minisplat_ref.methods.gaussian_splatting import GS, lower_opacities, prune_faint
from minisplat_ref.oracle.models import Drawn, model_stage
from minisplat_ref.oracle.setting import Setting
from minisplat_ref.oracle.stages import Stage
from minisplat_ref.rendering.backends import Backend
from minisplat_ref.training.losses import Cotangents, LossTerm, Rendered
from minisplat_ref.training.rates import LogLinear, Rates
from minisplat_ref.training.representation import Representation
from minisplat_ref.training.schedule import At, During, Every
from minisplat_ref.training.state import Iteration, TrainState
from minisplat_ref.types import Floats, Gaussians, Optics, Scene

FLOOR = 0.05  # of a shadow and of its complement inside the logarithms of the entropy, as released
SHADOWS_FROM = 1_000  # of 5,000 iterations; views are compared from then on, too
ITERATIONS = 5_000
START_OPACITY, START_SIZE = 0.005, 0.5  # of points in the volume; size relative to the distance of neighbours
SKY_LIGHT = 0.05  # k at the start
ALL = frozenset(CHANNELS)
SUN = -1.0, 1.0, 1.0  # of the checked stage
TIE = 1e-12
"""Of a shadow or a slope, in float64: a thousand roundings of values near 1."""


def opacity_sparsity(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return ``sum o / N_0``, N_0 the number of points that training begins with.

    ``dL/dlogit = o (1 - o) / N_0``.
    """
    logits = rendered.model.gaussians.opacity_logits
    o = 1 / (1 + np.exp(-logits))
    n = max(len(rendered.scene.points), 1)
    return float(o.sum() / n), Cotangents(gaussians={"opacity_logits": o * (1 - o) / logits.dtype.type(n)})


def shadow_entropy(rendered: Rendered) -> tuple[float, Cotangents]:
    """Return the mean of ``-s log2 t - (1 - s) log2(1 - t)``, bits, with t = s kept between 0.05 and 0.95.

    Its slope is ``log2((1 - t) / t)``.
    """
    s = rendered.channel("shadow")
    t = np.clip(s, FLOOR, 1 - FLOOR)
    entropy = -s * np.log2(t) - (1 - s) * np.log2(1 - t)
    slope = np.log2((1 - t) / t) / s.dtype.type(s.size)
    return float(np.mean(entropy, dtype=np.float64)), Cotangents({"shadow": slope})


def make_shear(rendered: Rendered, noise: float) -> Floats:
    """Return a random shear of the view in pixels per metre of altitude, the same whenever the iteration is done.

    ``M' = I + noise`` of the paper is in coordinates of -1 to 1 across the image, and in metres along the altitude; no
    draw is above one standard deviation.
    """
    camera = choose_affine(rendered.view.camera, rendered.request.conventions)
    drawn = np.random.default_rng([rendered.step, max(rendered.view.view_id, 0)]).normal(size=2)
    x, y = noise * np.clip(drawn, -1, 1)
    return np.array([x * camera.width / 2, y * camera.height / 2])


def view_consistency(
    rendered: Rendered, *, altitude: float, color: float, noise: float, limit: float
) -> tuple[float, Cotangents]:
    """Compare the view with one that is sheared at random: both see the same albedo and altitude of a point.

    A pixel p of altitude h is seen at ``p' = p - g h``. Where ``|h - h'(p')| < limit``, else something hides it::

        L = mean(w_h |h - h'(p')| + w_a sum_c |a - a'(p')|)      over the pixels that count; 0 if none does

    Derivatives go to the view's channels and, by the second rendering, to the population; a' and h' are read between
    pixels, so p' depends on h.

    Parameters
    ----------
    rendered : Rendered
        With ``albedo`` and ``altitude``.
    altitude, color : float
        w_h, per unit of altitude, and w_a.
    noise : float
        Standard deviation of the shear, per metre; see :func:`make_shear`.
    limit : float
        Units of altitude.
    """
    h, a = rendered.channel("altitude")[..., 0], rendered.channel("albedo")
    camera = choose_affine(rendered.view.camera, rendered.request.conventions)
    shift = make_shear(rendered, noise)
    tape = splat_view(rendered.model, sheared(camera, shift, (0, 0)), rendered.request)
    sums, alpha = depth_sums(tape)
    other = np.concatenate([tape.output.image[..., :3], altitudes(sums, alpha)[..., None]], axis=2)
    height, width = h.shape
    x, y = np.arange(width) + 0.5 - shift[0] * h, np.arange(height)[:, None] + 0.5 - shift[1] * h
    read = sample(other, x, y)
    differences = np.concatenate([a, h[..., None]], axis=2) - read.values  # [H, W, 4]
    is_seen = (np.abs(differences[..., 3]) < limit) & (x > 0) & (x < width) & (y > 0) & (y < height)
    weights = np.array([color] * 3 + [altitude]) / max(int(is_seen.sum()), 1)
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
ENTROPY = LossTerm("shadow_entropy", shadow_entropy, 0.01, frozenset({"shadow"}), start=SHADOWS_FROM)


def without_directions(gaussians: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians without the harmonics of degree 1 and above, which parallel rays cannot tell from the first."""
    return gaussians._replace(sh_rest=np.ascontiguousarray(gaussians.sh_rest[:, :0]))


def first_light(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    """Return identity radiometry [V, 3, 4], the light of the sky [V, 3] in each photograph's shadows, and none yet."""
    n, dtype = len(scene.train_views), np.float32
    return {
        RADIOMETRY: np.tile(np.eye(3, 4, dtype=dtype), (n, 1, 1)),
        IN_SHADOW: np.full((n, 3), SKY_LIGHT, dtype),
        HAS_SHADOWS: np.zeros(1, dtype),
    }


def cast_shadows(state: TrainState, iteration: Iteration) -> None:
    """Let the sun's image shade the photographs from now on."""
    state.shared[HAS_SHADOWS][:] = 1


def begin_transparent(state: TrainState, iteration: Iteration, *, opacity: float, size: float) -> None:
    """Give all Gaussians one opacity, and multiply their sizes, so that light passes through the whole volume.

    Points that fill a volume are a fog if they are as opaque as those on a surface (0.1), and a fog explains a few
    photographs as well as a surface does. Of nearly transparent ones some grow, and the others are pruned. As long as
    nearly nothing is opaque, altitudes count as the lowest and nothing shades, which favours a ground that lies there.
    """
    g = state.gaussians
    lower_opacities(state, np.full_like(g.opacity_logits, np.log(opacity / (1 - opacity))))
    log_scales = g.log_scales + g.log_scales.dtype.type(np.log(size))
    state.gaussians = state.gaussians._replace(log_scales=log_scales)


def hold_sky(state: TrainState, iteration: Iteration) -> None:
    """Keep the light in shadows between none and the sun's: while surfaces are unsettled, its gradient is unbounded."""
    np.clip(state.shared[IN_SHADOW], 0, 1, out=state.shared[IN_SHADOW])


def fold_reference(state: TrainState, iteration: Iteration) -> str | None:
    """Give the colours the radiometry of the reference photograph, and every photograph its own relative to it.

    With C_0 and c_0 of the reference: ``a' = C_0 a + c_0``, ``C' = C C_0^-1``, ``c' = c - C' c_0``. All photographs
    stay the same where nothing of the background comes through.
    """
    radiometry = state.shared[RADIOMETRY]
    first = radiometry[REFERENCE_VIEW].astype(np.float64)
    C, c = first[:, :3], first[:, 3]
    if np.linalg.cond(C) > 1e6:
        return "nothing done: the reference's colour matrix cannot be inverted"
    g = state.gaussians
    colors = np.maximum(0.5 + SH_C0 * g.sh_dc.astype(np.float64), 0) @ C.T + c
    state.gaussians = g._replace(sh_dc=((colors - 0.5) / SH_C0).astype(g.sh_dc.dtype))
    matrices = radiometry[..., :3] @ np.linalg.inv(C)
    radiometry[..., 3] -= (matrices @ c).astype(radiometry.dtype)
    radiometry[..., :3] = matrices
    return None


CONSISTENCY = LossTerm(
    "view_consistency",
    partial(view_consistency, altitude=0.01, color=0.1, noise=0.01, limit=0.3),
    weight=1.0,
    wants=frozenset({"albedo", "altitude"}),
    start=SHADOWS_FROM,
)

SEEN_FROM_ABOVE = Representation(
    "gaussians seen by satellites",
    extend=without_directions,
    shared=first_light,
    renderer=SATELLITE,
    rates=Rates({RADIOMETRY: 0.01, IN_SHADOW: 0.01, HAS_SHADOWS: 0.0}, frozenset()),
    takes_optics=True,
)

RECIPE = GS._replace(
    name="satellite",
    iterations=ITERATIONS,
    learning_rates=GS.learning_rates.change(means=LogLinear(6.4e-3, 6.4e-4, ITERATIONS), opacity_logits=0.1),
    sh_degree=0,
    sh_milestones=(),
    has_random_background=True,
    losses=(*GS.losses, SPARSITY, CONSISTENCY, ENTROPY),
    events=(
        At(1, partial(begin_transparent, opacity=START_OPACITY, size=START_SIZE)),
        At(SHADOWS_FROM, cast_shadows),
        During(hold_sky),
        Every(100, partial(prune_faint, min_opacity=0.005), start=500, min_gap=20),
        At(ITERATIONS, fold_reference),
    ),
)
"""``satellite``: no density control but pruning, colours without directions, 5,000 iterations."""


def stages(backend: Backend, setting: Setting, rng: np.random.Generator) -> tuple[Stage, ...]:
    """Return the renderer: by an orthographic camera, instead of that without, and by an affine one with the sun.

    The affine camera, as those of satellites, has depths of both signs: the Gaussians are moved about altitude 0.
    """
    fx, fy = setting.camera.fx / 3, setting.camera.fy / 3  # the Gaussians lie at depth 3
    flat = setting.camera._replace(fx=fx, fy=fy, optics=Optics("orthographic"))
    affine = flat._replace(optics=Optics("affine", (0.1, 4.0, *SUN)))
    means = setting.gaussians.means - np.median(setting.gaussians.means, axis=0) * [0, 0, 1]
    around = setting._replace(gaussians=setting.gaussians._replace(means=means.astype(setting.gaussians.means.dtype)))
    name = SEEN_FROM_ABOVE.name
    dark = _stage(backend, setting._replace(camera=flat), name, rng, (IN_SHADOW,))
    return dark, _stage(backend, around._replace(camera=affine), f"{name}, affine", rng)


def _stage(
    backend: Backend, setting: Setting, name: str, rng: np.random.Generator, fixed: tuple[str, ...] = ()
) -> Stage:
    named = SEEN_FROM_ABOVE._replace(name=name, shared=_with_shadows)
    still = ("sh_rest", *fixed)  # the first is empty
    return model_stage(backend, setting, named, rng, wants=ALL, sides_of=_sides, fixed=still)


def _with_shadows(scene: Scene, rng: np.random.Generator) -> Mapping[str, Floats]:
    return {**first_light(scene, rng), HAS_SHADOWS: np.ones(1, np.float32)}


def _sides(drawn: Drawn) -> list[np.ndarray]:
    tape: Tape = drawn.tape
    sides = [tape.seen.output.alpha > MIN_ALPHA, SH_C0 * drawn.model.gaussians.sh_dc + 0.5 > 0]
    if tape.of_sun is None or tape.shadow is None:
        return sides
    inside = np.abs(tape.shadow.sampled.slopes) > TIE
    is_shaded = tape.shadow.shadows < 1 - TIE
    return [*sides, tape.of_sun.output.alpha > MIN_ALPHA, is_shaded, tape.shadow.sampled.corners, inside]
