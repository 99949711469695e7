"""Render surfels: flat Gaussians on discs in space, hit by the ray of each pixel (2D Gaussian Splatting).

:mod:`.projection` has the equations from a surfel to its map from pixels, :mod:`.response` those of a hit, both in
NumPy; :mod:`.kernels` states the hit once more, for the plain kernels. The quantities that depend on the order of the
hits, the median depth and gsplat's distortion, are in :mod:`.ray_measures` and, for kernels, in :mod:`.ray_kernels`.
:mod:`.renderer` chooses between the two, and is the pair that training calls. Normals and depths are channels of the
image like colours, so their gradients need no further code. :mod:`.discs` and :mod:`.disagreement` are shared by
recipes of surfels: start, density control, and the loss on normals.
"""
