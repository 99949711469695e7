"""Render Gaussians by their footprints on tangent planes of the unit sphere, each pixel with its own order.

A relative provides the size of the buffer in which a pixel sorts its hits (None for an exact order) and, if it needs
one, a limit of the rendered extent; :mod:`.renderer` does the rest. :mod:`.planes` has the equations in NumPy,
:mod:`.kernels` the same as a response for the plain kernels, :mod:`.rays` colours on given rays, for studies of a
camera that turns, and :mod:`.gradient_checks` its stage for the gradient check.
"""
