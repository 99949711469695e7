"""Views whose photographs are read from disk when they are needed, for scenes whose photographs memory cannot hold.

Of such a scene a fixed set of photographs stays in memory: the first that are read, as many as a given number of bytes
holds. Training shows all views in a new order again and again. With room for a part f of the photographs, a fixed set
saves the part f of the reading, whatever the order; a cache that lets go of the least recently used saves
``f + (1 - f) ln(1 - f)``, 15 % with room for half of them, since a photograph that has just been shown is the one that
is needed latest. Where Gaussians need the room, photographs give it up.
"""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from minisplat_ref import memory
from minisplat_ref.types import Bools, View


class Pixels(NamedTuple):
    """What is read of a photograph."""

    image: NDArray[np.uint8]
    """[H, W, 3], as :attr:`View.image`."""
    mask: Bools | None
    """[H, W], as :attr:`View.mask`."""

    @property
    def n_bytes(self) -> int:
        """What they take of memory."""
        return self.image.nbytes + (0 if self.mask is None else self.mask.nbytes)


class Shelf:
    """Room for photographs that stay in memory.

    Parameters
    ----------
    most_bytes : float
        How much all of them may take together.
    """

    def __init__(self, most_bytes: float) -> None:
        self._most_bytes = most_bytes
        self._n_bytes = 0
        self._kept: dict[Photograph, Pixels] = {}
        self._lock = threading.Lock()

    @property
    def n_bytes(self) -> int:
        """What stands there takes of memory."""
        return self._n_bytes

    @property
    def n_free(self) -> float:
        """Bytes that are still free."""
        return self._most_bytes - self._n_bytes

    def get(self, photograph: "Photograph") -> Pixels | None:
        """Return the pixels of a photograph if they stand there."""
        return self._kept.get(photograph)

    def put(self, photograph: "Photograph", pixels: Pixels) -> None:
        """Keep the pixels of a photograph if there is room."""
        with self._lock:
            if pixels.n_bytes <= self.n_free:
                self._kept[photograph] = pixels
                self._n_bytes += pixels.n_bytes

    def resize(self, most_bytes: float) -> None:
        """Give the photographs more room, or less: then the last that have come go first."""
        with self._lock:
            self._most_bytes = most_bytes
            while self._kept and self.n_free < 0:
                self._n_bytes -= self._kept.popitem()[1].n_bytes


class Photograph:
    """A photograph on disk, whose pixels may stay in memory when they have been read.

    Parameters
    ----------
    read : callable
        Reads it; gives the same pixels every time.
    n_pixels : int
        Of the file, which all have to be decoded.
    shelf : Shelf
        Where there may be room for them.
    may_stay : bool
        False for what is computed from another photograph.
    """

    def __init__(self, read: Callable[[], Pixels], n_pixels: int, shelf: Shelf, may_stay: bool = True) -> None:
        self.n_pixels, self.shelf = n_pixels, shelf
        self._read, self._may_stay = read, may_stay
        self._lock = threading.Lock()

    def pixels(self) -> Pixels:
        """Return the pixels, from memory or from disk."""
        with self._lock:  # whoever wants it while another thread reads it waits for that
            pixels = self.shelf.get(self)
            if pixels is None:
                pixels = self._read()
                if self._may_stay:
                    self.shelf.put(self, pixels)
            return pixels


class StoredView(View):
    """A view whose image and mask are read anew whenever they are asked for, unless they stay in memory.

    Who needs both, or one of them twice, calls :meth:`loaded` once. In the place of the image the tuple holds a
    :class:`Photograph`.
    """

    __slots__ = ()

    @property
    def photograph(self) -> Photograph:
        """Where the pixels come from."""
        return cast(Photograph, self[2])

    @property
    def image(self) -> NDArray[np.uint8]:
        """[H, W, 3], as of any view."""
        return self.photograph.pixels().image

    @property
    def mask(self) -> Bools | None:
        """[H, W] or None, as of any view."""
        return self.photograph.pixels().mask

    def loaded(self) -> View:
        """Return a view that holds its pixels."""
        image, mask = self.photograph.pixels()
        return View(*self)._replace(image=image, mask=mask)

    def _replace(self, **fields: Any) -> View:  # type: ignore[override]
        """Return the view with other fields; with another image or mask it holds both of them."""
        if fields.keys() & {"image", "mask"}:
            return self.loaded()._replace(**fields)
        return super()._replace(**fields)

    def changed(self, change: Callable[[Pixels], Pixels]) -> View:
        """Return the view with pixels that are computed from its own whenever they are asked for."""
        photograph = self.photograph
        changed: Any = Photograph(
            lambda: change(photograph.pixels()), photograph.n_pixels, photograph.shelf, may_stay=False
        )
        return super()._replace(image=changed)


def make_room(views: Sequence[View], needed: float) -> float:
    """Let photographs keep a part of the free memory at most, and nothing of what is needed otherwise.

    Parameters
    ----------
    views : sequence of View
    needed : float
        Bytes that something else is about to take.

    Returns
    -------
    float
        How many bytes more the photographs will keep when they have been read.
    """
    shelves = {view.photograph.shelf for view in views if isinstance(view, StoredView)}  # one, or none
    for shelf in shelves:
        free = memory.free_bytes() + shelf.n_bytes
        shelf.resize(max(0.0, min(memory.SHELF_SHARE * free, free - needed)))
    return sum(shelf.n_free for shelf in shelves)


class ReadingAhead(AbstractContextManager["ReadingAhead"]):
    """Reads, in a thread, the photograph that is needed next; the thread ends with the context.

    There is no thread where photographs are in memory anyway. Kernels whose loops run in parallel let go of Python's
    lock, as decoders do: one goes on while the other works.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photographs")
        self._next: tuple[View, Future[View]] | None = None

    def __exit__(self, *_: object) -> None:
        """Wait for the photograph that is being read, if there is one, and forget it."""
        self._next = None
        self._executor.shutdown(cancel_futures=True)

    def load(self, view: View, following: View | None) -> View:
        """Return a view that holds its pixels.

        Parameters
        ----------
        view : View
        following : View, optional
            The view that is needed next, where that is known; its photograph is read from now on.
        """
        expected, self._next = self._next, None
        loaded = expected[1].result() if expected is not None and expected[0] is view else view.loaded()
        if isinstance(following, StoredView):
            self._next = following, self._executor.submit(following.loaded)
        return loaded
