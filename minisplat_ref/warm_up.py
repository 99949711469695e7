"""Compile the kernels of training, rendering and evaluation ahead of their use, on all processors.

A process compiles one function at a time, so a first iteration would wait for one kernel after the other. Here several
processes compile the stages one by one, and whatever runs later finds them on disk. A single stage needs arguments of
the types that the stages before it return; these come from the reference, which compiles nothing. An extension is
warmed up after the stages, by drawing and differentiating a tiny model with its renderer and losses; by then the
kernels that are not its own are on disk.

Left out: other numbers of channels than training and rendering use (3, and 4 with depth), which gsplat's signature
allows, the kernels of ``bench``, and those of an extension's actions. They are compiled at their first use.
"""

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import active_children, get_context, parent_process
from typing import NamedTuple, ParamSpec, TypeVar

import numpy as np

from minisplat_ref.backends import CPU, REFERENCE, Backend
from minisplat_ref.constants import Conventions
from minisplat_ref.cpu.compositing.records import record_size
from minisplat_ref.errors import InputError
from minisplat_ref.extensions.extension import Extension, load_extension
from minisplat_ref.methods.gaussian_splatting import GS
from minisplat_ref.rendering import RenderTape, Request, render, render_vjp
from minisplat_ref.training.losses import Rendered, total_loss
from minisplat_ref.types import (
    AdamStep,
    Camera,
    CompositeGradient,
    Floats,
    Gaussians,
    Model,
    Projection,
    RenderOutput,
    Scene,
    TileBins,
    View,
)

WIDTH, HEIGHT = 24, 18
N_GAUSSIANS = 4
DEGREE = 1  # of the spherical harmonics: known only at run time, so any value will do

Dtype = type[np.floating]
Arguments = ParamSpec("Arguments")
HasConics = TypeVar("HasConics", Projection, CompositeGradient)


class Compiled(NamedTuple):
    """One stage that has been compiled."""

    name: str
    """Key of ``STAGES``, or ``extension NAME``."""
    seconds: float
    """Time that it took; little where it was on disk already."""
    problem: str = ""
    """Why an extension could not be drawn, in one line; empty if it could."""


def _stage(name: str, with_depth: bool = False, with_stats: bool = False) -> Callable[[Dtype], None]:
    """Return a task that draws and differentiates a view with one stage compiled."""

    def compile_stage(dtype: Dtype) -> None:
        backend = replace(_REFERENCE, **{name: getattr(CPU, name)})
        tape = _render_view(dtype, backend, with_depth, with_stats)
        if name.endswith("_vjp"):
            render_vjp(tape, np.ones_like(tape.splats.output.image))

    return compile_stage


def _surface_points(dtype: Dtype) -> None:
    tape = _render_view(dtype, _REFERENCE, False, with_stats=True)
    primitives, stats = tape.splats.primitives, tape.splats.output.stats
    assert stats is not None
    CPU.surface_points(primitives.means, primitives.quats, primitives.scales, tape.splats.camera, stats.dominant_ids)


def _removal_changes(dtype: Dtype) -> None:
    s = _render_view(dtype, _REFERENCE, False, with_stats=False).splats
    CPU.removal_changes(s.projection, s.channels, s.bins, s.conventions, s.output)


def _photometric_loss(dtype: Dtype) -> None:
    image, photograph = np.zeros((HEIGHT, WIDTH, 3), dtype), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    CPU.photometric_loss_vjp(CPU.photometric_loss(image, photograph, 0.2)[1])


def _adam(dtype: Dtype) -> None:
    for rows in (None, np.arange(N_GAUSSIANS)):  # all, and the visible
        values, gradient, first, second = np.zeros((4, N_GAUSSIANS, 3), dtype)
        CPU.adam_update(values, gradient, first, second, rows, AdamStep(0.1, 0.9, 0.999, 1e-15))


STAGES: dict[str, Callable[[Dtype], None]] = {
    "tile lists": _stage("bin_gaussians"),
    "blending": _stage("composite"),
    "blending, backward": _stage("composite_vjp"),
    "photometric loss, both ways": _photometric_loss,
    "colours, backward": _stage("sh_colors_vjp"),
    "projection, backward": _stage("project_vjp"),
    "projection": _stage("project"),
    "colours": _stage("sh_colors"),
    "Adam": _adam,
    # Those below are not used by every training, nor by ordinary rendering.
    "blending with depth, backward": _stage("composite_vjp", with_depth=True),
    "blending with depth": _stage("composite", with_depth=True),
    "blend statistics": _stage("composite", with_stats=True),
    "surface points": _surface_points,
    "removal of Gaussians": _removal_changes,
}
"""What is compiled together, by name; slow ones first, so that no process ends up with a slow one last."""

FIRST_ITERATION = tuple(STAGES)[:9]
"""Those that the first iteration of every training needs."""


def warm_up(
    stages: Iterable[str] | None = None,
    dtype: Dtype = np.float32,
    n_processes: int | None = None,
    extensions: Iterable[str] = (),
) -> Generator[Compiled, None, None]:
    """Compile stages in other processes and yield each when it is ready; closing the generator ends the processes.

    Each of those processes imports the program's main module: a script must call this under
    ``if __name__ == "__main__"``.

    Parameters
    ----------
    stages : iterable of str, optional
        Keys of ``STAGES``; all by default.
    dtype : type
        ``numpy.float32``, or ``numpy.float64``.
    n_processes : int, optional
        One per processor by default; each takes some 300 MB.
    extensions : iterable of str, optional
        Names of extensions, whose renderers and losses come after the stages. None by default.
    """
    names, extension_names = tuple(STAGES if stages is None else stages), tuple(extensions)
    n_processes = min(n_processes or os.cpu_count() or 1, max(len(names), len(extension_names)))
    # Fresh interpreters, because a fork of a process in which kernels have run cannot run any.
    context = get_context("spawn")
    pool, others = ProcessPoolExecutor(n_processes, context, initializer=_prepare_process), active_children()
    try:
        for task, batch in ((_compile, names), (_compile_extension, extension_names)):
            futures = [pool.submit(task, name, dtype) for name in batch]
            for future in as_completed(futures):
                yield future.result()
    except BaseException:  # nothing waits for the rest after an error, or after Ctrl-C, which the processes ignore
        for process in active_children():
            if process not in others:
                process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare_process() -> None:
    gc.disable()  # the compiler makes many small objects, of which few can be freed
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the parent is killed; it would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _compile(name: str, dtype: Dtype) -> Compiled:
    start = time.perf_counter()
    STAGES[name](dtype)
    return Compiled(name, time.perf_counter() - start)


def _compile_extension(name: str, dtype: Dtype) -> Compiled:
    start, problem = time.perf_counter(), ""
    try:
        _draw_extension(load_extension(name), dtype)
    except InputError as error:
        problem = " ".join(str(error).split())
    except Exception as error:  # an extension's renderer may raise anything
        problem = f"extension {name} does not draw: {type(error).__name__}: {' '.join(str(error).split())}"
    return Compiled(f"extension {name}", time.perf_counter() - start, problem)


def _draw_extension(extension: Extension, dtype: Dtype) -> None:
    """Draw a tiny model, take every loss of the extension, and differentiate."""
    representation, rng = extension.representation, np.random.default_rng(0)
    gaussians = _gaussians(dtype)
    ids, gray = np.arange(N_GAUSSIANS), np.full((N_GAUSSIANS, 3), 128, np.uint8)
    photograph = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    view = View("a", _camera(), photograph, None, point_ids=ids, view_id=0, time=0.5)
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


def _in_kernel_types(function: Callable[Arguments, HasConics]) -> Callable[Arguments, HasConics]:
    """Return a stage of the reference whose conics, or their gradient, are float64 as in the kernels."""

    def stage(*args: Arguments.args, **named: Arguments.kwargs) -> HasConics:
        bundle = function(*args, **named)
        bundle = bundle._replace(conics=bundle.conics.astype(np.float64))
        return type(bundle)._make(map(np.ascontiguousarray, bundle))

    return stage


def _with_records(
    projection: Projection, colors: Floats, background: Floats, bins: TileBins, conventions: Conventions, **asked: bool
) -> RenderOutput:
    """Composite with the reference and add the kernels' records, which their gradient would otherwise have to make."""
    records = np.zeros((len(colors), record_size(colors.shape[1])), colors.dtype)
    output = REFERENCE.composite(projection, colors, background, bins, conventions, **asked)
    return output._replace(saved=records)


_REFERENCE = replace(
    REFERENCE,
    tile_width=CPU.tile_width,
    tile_height=CPU.tile_height,
    project=_in_kernel_types(REFERENCE.project),
    composite=_with_records,
    composite_vjp=_in_kernel_types(REFERENCE.composite_vjp),
)


def _render_view(dtype: Dtype, backend: Backend, with_depth: bool = False, with_stats: bool = False) -> RenderTape:
    return render(_gaussians(dtype), _camera(), backend=backend, with_depth=with_depth, with_stats=with_stats)[1]


def _camera() -> Camera:
    return Camera(np.eye(3), np.zeros(3), 20.0, 20.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def _gaussians(dtype: Dtype) -> Gaussians:
    """Return a few Gaussians, one behind the other in the middle of the view."""
    n = N_GAUSSIANS

    def full(value: float, *shape: int) -> Floats:
        return np.full((n, *shape), value, dtype)

    means = np.zeros((n, 3), dtype)
    means[:, 2] = 2 + np.arange(n)
    return Gaussians(means, full(0.5, 4), full(-2, 3), full(0), full(0.5, 3), full(0.1, (DEGREE + 1) ** 2 - 1, 3))
