"""Surfels with a material in a learned environment, drawn: the population and the renderer that relatives share.

``population``  fields and start of a surfel with a material, and what all surfels have in common
``around``      the light that a surfel receives from the scene around it, by the direction of reflection
``renderer``    shaded one by one and then blended, or blended and then shaded pixel by pixel
``stages``      the renderer at a stage of shading, for checks of the gradient

:mod:`minisplat_ref.extensions.reflective` trains them as Ref-Gaussian does.
"""
