"""Trace rays through Gaussians of any shape, and differentiate what the rays of an image see.

A relative brings the shape of its primitives, twice:

- in NumPy a :class:`~.blending.Meeting`: where a ray meets a primitive and with which alpha, and the gradient;
- for the kernels a :class:`~.tile_kernels.RayResponse`, the same for eight rays at a time, and the regions in which its
  primitives are met: ellipsoids for the rays of an image, boxes for any others.

:class:`~.renderer.Traced` joins both to its population, and :func:`~.renderer.make_ray_renderer` makes a renderer of
it. With :func:`~.gradient_checks.trace_stages` the gradient check records which thresholds the rays cross.

In the order of a ray: :mod:`.pixel_rays` (rays of a camera, and what they return), :mod:`.blending` (every ray against
every primitive, NumPy), :mod:`.tile_lists` (which primitives the rays of a tile may meet), :mod:`.tile_kernels` (the
same by these lists, with the gradient), :mod:`.renderer`. Rays from anywhere need a tree: :mod:`.bvh`,
:mod:`.traversal` (which primitives a ray meets, in which order), :mod:`.kernels`.
"""
