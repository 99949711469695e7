"""A trained scene in the browser, drawn by the renderer that trained it.

The content of a frame is decided without a browser: :mod:`.poses` (where a camera is, and paths through several),
:mod:`.progression` (how large the next frame is), :mod:`.layers` (what of it is shown). :mod:`.browser` alone knows
viser, an optional package, and hands these the camera of each browser that is connected.

All rendering happens in the thread that calls :meth:`.browser.Viewer.draw_next`, the main one: kernels never run twice
at once, and during a training frames are rendered between two iterations.
"""
