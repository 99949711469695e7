"""Mechanisms: what two or more relatives of 3DGS are made of, built once. No mechanism imports a relative.

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

The docstring of each package says what a relative must bring. When a second relative needs what the first one built, it
moves here; a formula of the papers that the core needs, too, moves to ``reference/`` and ``scalar/`` instead.
"""
