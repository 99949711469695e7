"""Compile the kernels of training, rendering and evaluation ahead of their use, those of extensions included.

An extension needs no additional code for this: its renderer and its losses render and differentiate a tiny model, after
the stages, so that the kernels of others are on disk by then. The kernels of its actions are left out.
"""

from collections.abc import Generator, Iterable

import numpy as np

from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import Extension, load_extension
from minisplat_ref.jit.warm_up import Compiled, Dtype, Task, compile_all
from minisplat_ref.methods.gaussian_splatting import GS
from minisplat_ref.rendering import Request
from minisplat_ref.rendering.warm_up import (
    HEIGHT,
    N_GAUSSIANS,
    STAGES,
    WIDTH,
    compile_stage,
    tiny_camera,
    tiny_gaussians,
)
from minisplat_ref.training.losses import Rendered, total_loss
from minisplat_ref.types import Model, Scene, View


def warm_up(
    stages: Iterable[str] | None = None,
    dtype: Dtype = np.float32,
    n_processes: int | None = None,
    extensions: Iterable[str] = (),
) -> Generator[Compiled, None, None]:
    """Compile stages and extensions, as :func:`minisplat_ref.jit.warm_up.compile_all`, and yield each when it is ready.

    Parameters
    ----------
    stages : iterable of str, optional
        Keys of :data:`minisplat_ref.rendering.warm_up.STAGES`; all by default.
    dtype : type
        ``numpy.float32``, or ``numpy.float64``.
    n_processes : int, optional
        One per processor by default.
    extensions : iterable of str, optional
        Names of extensions, whose renderers and losses come after the stages. None by default.
    """
    of_stages = [Task(name, compile_stage) for name in (STAGES if stages is None else stages)]
    of_extensions = [Task(f"extension {name}", compile_extension) for name in extensions]
    return compile_all((of_stages, of_extensions), dtype, n_processes)


def compile_extension(title: str, dtype: Dtype) -> str:
    """Draw and differentiate with ``extension NAME``; return why it could not be done, empty if it could."""
    name = title.removeprefix("extension ")
    try:
        draw_extension(load_extension(name), dtype)
    except InputError as error:
        return " ".join(str(error).split())
    except Exception as error:  # an extension's renderer may raise anything
        return f"extension {name} does not draw: {type(error).__name__}: {' '.join(str(error).split())}"
    return ""


def draw_extension(extension: Extension, dtype: Dtype) -> None:
    """Draw a tiny model, take every loss of the extension, and differentiate."""
    representation, rng = extension.representation, np.random.default_rng(0)
    gaussians = tiny_gaussians(dtype)
    ids, gray = np.arange(N_GAUSSIANS), np.full((N_GAUSSIANS, 3), 128, np.uint8)
    photograph = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = View("a", tiny_camera(), photograph, None, point_ids=ids, view_id=0, time=0.5)
    scene = Scene("tiny", (view,), (), gaussians.means.astype(np.float64), gray, np.zeros(3), extent=1.0)
    populate = extension.sample or representation.extend
    model = Model(populate(gaussians, rng), representation.shared(scene, rng))
    renderer, own = representation.renderer, [term._replace(weight=1.0) for term in extension.losses]
    for terms in (GS.losses, (*GS.losses, *own)):
        request = Request(np.zeros(3, dtype), wants=frozenset[str]().union(*(term.wants for term in terms)))
        output, tape = renderer.render(model, view, request)
        channels = renderer.channels(request.wants)
        loss = total_loss(terms, Rendered(output, channels, view, scene, model, step=1, request=request))
        renderer.render_vjp(tape, loss.v_image, loss.v_alpha)
