"""Trace a ray per pixel through a tree of Gaussians of any shape, and differentiate what the rays see.

A relative brings the shape of its primitives, twice:

- in NumPy a :class:`~.blending.Meeting`: where a ray meets a primitive and with which alpha, and the gradient;
- for the kernels a :class:`~.kernels.RayResponse`, the same for eight rays at a time, and the boxes of its primitives.

:class:`~.renderer.Traced` joins both to its population, and :func:`~.renderer.make_ray_renderer` makes a renderer of
it. With :func:`~.gradient_checks.trace_stages` the gradient check records which thresholds the rays cross.

In the order of a ray: :mod:`.pixel_rays` (rays of a camera, and what they return), :mod:`.bvh` (the tree),
:mod:`.traversal` (which primitives a ray meets, in which order), :mod:`.blending` (every ray against every primitive,
NumPy), :mod:`.kernels` (the same through the tree), :mod:`.renderer`.
"""
