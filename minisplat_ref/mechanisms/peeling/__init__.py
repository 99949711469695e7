"""Render translucent triangle meshes by depth peeling, and differentiate the image.

A relative brings a :class:`~.layers.TranslucentMesh`: vertices, a colour and an opacity at each, and triangles. It gets
an image, alpha, and gradients with respect to vertices, colours and opacities. :mod:`.layers` has the equations and the
bundles, :mod:`.reference` the loop over layers in NumPy, :mod:`.kernels` the compiled one.
"""
