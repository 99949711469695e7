"""Triangle meshes: files, the frame of a triangle, and fans of triangles from flat Gaussians and back.

A relative brings a PLY with faces, or flat Gaussians. :mod:`.mesh` reads, checks and writes a mesh and gives each
triangle a frame; :mod:`.fans` makes regular polygons of flat Gaussians, and Gaussians of polygons that were edited.
"""
