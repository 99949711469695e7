"""Shading once per pixel: materials blended by surfels, an environment, and its occlusion.

``environment``  light that comes from infinitely far away, one colour for each direction
``prefilter``    the same light averaged over the lobe of a rough surface, and over the hemisphere of a matte one
``brdf``         what share of it a surface reflects: the table of the split-sum approximation
``shading``      the colour of a surface point from its material, its normal and the light
``lighting``     the environment that a model has, and another from a file
``maps``         materials and normals as pictures
``visibility``   how much of the surfels' own opacity lies in the way of a reflected ray
``population``   surfels with a material, and what they have in common
``around``       the light that a surfel receives from the scene around it
``pixels``       from what a pixel blends to the surface point that it shows
``renderer``     shading surfel by surfel, or pixel by pixel
``training``     the stages of Ref-Gaussian's training

Each function that training differentiates is followed by its gradient. ``shading_kernels``, ``pixel_kernels`` and
``around_kernels`` have the functions of the modules that they are named after as loops, around ``formulas``.
"""
