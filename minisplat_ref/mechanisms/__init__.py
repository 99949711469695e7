"""Mechanisms: building blocks of two or more relatives of 3DGS, built once. No mechanism imports a relative.

==================  ====================================================================================
:mod:`.rays`        rays through a tree of Gaussians of any shape, forward and backward
:mod:`.orders`      each pixel takes its hits in its own order, exactly or within a buffer
:mod:`.tangent`     footprints on tangent planes of the unit sphere, each pixel with its own order
:mod:`.peeling`     translucent triangle meshes by depth peeling, with gradients
:mod:`.payload`     footprints of 3DGS with data that change their pixels: a texture, a cut, vertices
:mod:`.editing`     Gaussians under a deformation, with rotated colours
:mod:`.meshes`      triangle meshes, their files and distances; fans of triangles from flat Gaussians, and back
:mod:`.fusion`      depth maps of many views as one surface (TSDF), which the command ``mesh`` needs, too
:mod:`.sampling`    sampling intervals of cameras, and images at other sampling rates
==================  ====================================================================================

The docstring of each package lists what a relative must provide. When a second relative needs a part of the first one,
the part moves here; a formula of the papers that the core needs, too, moves to ``reference/`` and ``scalar/`` instead.
"""
