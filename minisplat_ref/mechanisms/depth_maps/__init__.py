"""Depth maps: their normals, their smoothing, and the agreement of several views.

A relative brings the camera z [H, W] of views, 0 where they show nothing, and their cameras. :mod:`.normals` has the
normals by central differences with their gradient; :mod:`.bilateral` smooths a map, with its gradient, without blurring
over the edges of its photograph; :mod:`.reprojection` carries a map to another view and back, and keeps the depths on
which several views agree.
"""
