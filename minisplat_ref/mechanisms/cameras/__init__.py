"""Cameras as values with functions: a point's pixel and its derivative, a pixel's ray, a depth that orders.

The ``optics`` of a :class:`~minisplat_ref.types.Camera` describe its effect on directions; :func:`~.models.model_of`
returns the :class:`~.models.CameraModel` of it: perspective, Brown's distortion, Kannala and Brandt's fisheye,
orthographic or affine. In the order of use: :mod:`.distortion` (lens distortion of directions, and the inverse),
:mod:`.models` (the cameras), :mod:`.unscented` (the bounds of a Gaussian in the image of any camera), :mod:`.affine`
(cameras without perspective, whose projection of a Gaussian is exact, for the conic kernels), :mod:`.ray_footprints`
and :mod:`.kernels` (3D Gaussians hit by a camera's true rays), :mod:`.gsplat_call` (gsplat's call with these cameras),
and :mod:`.oracle` for that call. Kernels read rays from the table of :func:`~.models.ray_table`, so no kernel depends
on a camera's formula.
"""
