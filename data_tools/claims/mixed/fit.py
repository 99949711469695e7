"""Fitting an image by few primitives of one kind, in the plane: what claims and notebooks play with.

All lie in one plane that faces the camera, are white or gray and equally bright from everywhere. They begin at random
places as small ellipses, lines or triangles, and are trained by 3DGS's rates; their number and kind stay.

    target = letter_a()
    population = fitted(target, 6, n_vertices=2, iterations=400, seed=0)
    image = drawn(population)
"""

import numpy as np

from minisplat_ref.extensions.mixed.model import MIXED, MIXED_GAUSSIANS
from minisplat_ref.extensions.mixed.population import MixedGaussians, make_ellipses
from minisplat_ref.methods.gaussian_splatting import GS_ACCEL
from minisplat_ref.rendering import Request
from minisplat_ref.training.adam import zero_moments
from minisplat_ref.training.loop import train
from minisplat_ref.training.schedule import scale_recipe
from minisplat_ref.training.state import TrainState
from minisplat_ref.types import Camera, Floats, Gaussians, Model, Scene, View, number_views, view_from

SIZE, FOCAL, DISTANCE = 48, 60.0, 3.0  # px, px, world units
IMAGE = SIZE / FOCAL * DISTANCE  # its side, world units
CAMERA = Camera(np.eye(3), np.zeros(3), FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE)
EXTENT = 10.0  # of the scene: so far primitives may move, in units of the rates of 3DGS
SUPERSAMPLING = 8  # samples along each side of a pixel of a silhouette
_RECIPE = MIXED._replace(events=(), losses=GS_ACCEL.losses, sh_degree=0, representation=MIXED_GAUSSIANS)
NAMES = {1: "ellipses", 2: "lines", 3: "triangles"}
N_FLOATS = {1: 14, 2: 16, 3: 18}  # of one without view-dependent colour: the second and third vertex have two each


def place_in_plane(places: Floats, vertices: Floats, n_vertices: int, thickness: Floats) -> MixedGaussians:
    """Return bright primitives in the plane that faces the camera.

    Parameters
    ----------
    places : ndarray of shape (N, 2)
        Means of the vertices, px from the middle of the image.
    vertices : ndarray of shape (N, 4)
        The second and the third vertex from the mean, px.
    n_vertices : int
        1, 2 or 3.
    thickness : ndarray of shape (N,)
        Standard deviation, px.
    """
    n, scale = len(places), DISTANCE / FOCAL
    depths = DISTANCE + 1e-3 * np.arange(n)
    gaussians = Gaussians(
        means=np.column_stack([scale * places, depths]).astype(np.float32),
        quats=np.tile(np.eye(4, dtype=np.float32)[0], (n, 1)),
        log_scales=np.log(scale * thickness[:, None] * [1.0, 1.0, 0.01]).astype(np.float32),
        opacity_logits=np.full(n, 3, np.float32),
        sh_dc=np.ones((n, 3), np.float32),
        sh_rest=np.zeros((n, 0, 3), np.float32),
    )
    ellipses = make_ellipses(gaussians)
    kinds = np.full(n, n_vertices, np.float32)
    return ellipses._replace(vertices=(scale * vertices).astype(np.float32), n_vertices=kinds)


def scatter(n: int, n_vertices: int, rng: np.random.Generator) -> MixedGaussians:
    """Return n primitives at random places, together about as large as the image."""
    reach = SIZE / np.sqrt(n)
    places = rng.uniform(-0.3, 0.3, (n, 2)) * SIZE * (n > 1)
    vertices = rng.normal(size=(n, 4)) * 0.25 * reach
    start = place_in_plane(places, vertices, n_vertices, np.full(n, reach * (0.25 if n_vertices == 1 else 0.12)))
    return start._replace(opacity_logits=np.ones(n, np.float32), sh_dc=np.zeros((n, 3), np.float32))


def render_primitives(population: MixedGaussians) -> Floats:
    """Return the image [H, W, 3] of a population before black."""
    image: Floats = MIXED_GAUSSIANS.renderer.render(Model(population), view_from(CAMERA), Request())[0].image
    return image


def fit_primitives(target: Floats, n: int, *, n_vertices: int, iterations: int, seed: int) -> MixedGaussians:
    """Return n primitives of one kind, trained on an image [48, 48, 3] in [0, 1]."""
    rng = np.random.default_rng(seed)
    view = View("target", CAMERA, np.rint(255 * np.clip(target, 0, 1)).astype(np.uint8), None)
    none = np.zeros((0, 3))
    scene = Scene("target", number_views([view]), (), none, none.astype(np.uint8), np.zeros(3), EXTENT)
    population = scatter(n, n_vertices, rng)
    recipe = scale_recipe(_RECIPE, iterations)
    state = TrainState(population, zero_moments(population), step=0, view_order=[], rng=rng, stats={})
    fit: MixedGaussians = train(scene, recipe, seed=seed, state=state).gaussians
    return fit


def one_line() -> Floats:
    """Return the image of one line."""
    return render_primitives(place_in_plane(np.zeros((1, 2)), np.array([[14.0, 7.0, 0.0, 0.0]]), 2, np.full(1, 2.0)))


def one_triangle() -> Floats:
    """Return the image of one triangle with a soft rim."""
    return render_primitives(place_in_plane(np.zeros((1, 2)), np.array([[15.0, 5.0, -3.0, -14.0]]), 3, np.full(1, 2.0)))


def one_blob() -> Floats:
    """Return the image of one round Gaussian, where further vertices are of no use."""
    return render_primitives(place_in_plane(np.zeros((1, 2)), np.zeros((1, 4)), 1, np.full(1, 8.0)))


def letter_a() -> Floats:
    """Return a bright letter A, its pixels covered in part by supersampling: no kind's own shape."""
    xs, ys = _samples()
    strokes = (((12, 42), (24, 6)), ((24, 6), (36, 42)), ((16, 30), (32, 30)))
    is_in = np.zeros(xs.shape, bool)
    for (x0, y0), (x1, y1) in strokes:
        u_x, u_y, length = x1 - x0, y1 - y0, np.hypot(x1 - x0, y1 - y0)
        along, across = (xs - x0) * u_x + (ys - y0) * u_y, (xs - x0) * u_y - (ys - y0) * u_x
        is_in |= (np.abs(across) <= 2.5 * length) & (along >= 0) & (along <= length**2)
    return _cover(is_in)


def ring() -> Floats:
    """Return a bright ring, whose curve no straight line follows."""
    xs, ys = _samples()
    radii = np.hypot(xs - SIZE / 2, ys - SIZE / 2)
    return _cover((radii > 12.5) & (radii < 17.5))


def _samples() -> tuple[Floats, Floats]:
    """Return x and y [8 H, 8 W] of the samples, px."""
    steps = (np.arange(SIZE * SUPERSAMPLING) + 0.5) / SUPERSAMPLING
    xs, ys = np.meshgrid(steps, steps)
    return xs, ys


def _cover(is_in: np.ndarray) -> Floats:
    """Return the image of a silhouette: 0.8 times the part of each pixel that it covers."""
    shares = is_in.reshape(SIZE, SUPERSAMPLING, SIZE, SUPERSAMPLING).mean(axis=(1, 3))
    return np.repeat(0.8 * shares[:, :, None], 3, axis=2)
