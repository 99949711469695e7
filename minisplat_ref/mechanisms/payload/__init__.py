"""Render Gaussians that are projected and listed as in 3DGS, and carry data that change their pixels.

A relative brings a :class:`~.renderer.Payload`: what its :class:`~.footprints.Footprints` consist of, and what they do
to a pixel (a response in NumPy and one for the plain kernels). :func:`~.renderer.payload_renderer` adds activations,
projection, colours, tile lists and the gradient of all of them. A payload may also have channels of its own, such as a
depth at every pixel, and another one for each set of them. :mod:`.stages` tells the gradient check which
thresholds the hits cross.
"""
