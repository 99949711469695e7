"""A trained scene in the browser, rendered by the renderer that trained it.

The content of a frame is decided without a browser: :mod:`.poses` (the pose of a camera, and paths through several),
:mod:`.progression` (the size of the next frame), :mod:`.layers` (the layers that it can show). Only :mod:`.browser`
uses viser, an optional package, and passes the camera of each connected browser to these.

All rendering happens in the thread that calls :meth:`.browser.Viewer.render_next`, the main one: kernels never run
twice at once, and during a training frames are rendered between two iterations.
"""
