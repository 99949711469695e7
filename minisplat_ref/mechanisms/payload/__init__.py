"""Render Gaussians that are projected and listed as in 3DGS, and carry data that change their pixels.

A relative provides a :class:`~.renderer.Payload`: the content of its :class:`~.footprints.Footprints`, and their
response in a pixel (in NumPy and for the plain kernels). :func:`~.renderer.payload_renderer` adds activations,
projection, colours, tile lists and the gradient of all of them. A payload may also have further channels, such as a
depth at every pixel, and another one for each set of them. :mod:`.gradient_checks` records for the gradient check which
thresholds the hits cross.
"""
