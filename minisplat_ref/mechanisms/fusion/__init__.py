"""Fusion: depth maps of many views become one surface, a signed distance on a grid of voxels (TSDF)."""
