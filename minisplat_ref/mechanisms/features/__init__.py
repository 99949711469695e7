"""Features of images: maps of filter responses, each with its gradient, and channels that Gaussians blend.

A :class:`~minisplat_ref.mechanisms.features.bank.FeatureBank` is a pair of functions: ``features(image)`` returns maps
[h, w, C], from fine to coarse, and a tape; ``features_vjp(tape, v_maps)`` returns the gradient with respect to the
image. There are two:

- :data:`~minisplat_ref.mechanisms.features.filters.CLASSICAL`: Gabor filters of four orientations, their energies, and
  mean colours, at three scales. Its numbers are chosen, none is learned. **It is not VGG**: it responds to edges,
  stripes and colours, not to shapes or objects.
- :func:`~minisplat_ref.mechanisms.features.network.load_bank`: convolutions with weights that the user provides as an
  .npz. That module's docstring has the layout, and how VGG16's weights get into it.

:mod:`minisplat_ref.mechanisms.features.blending` goes the other way: any number of channels of Gaussians become
those of pixels.

The gradients of the layers are in :mod:`minisplat_ref.mechanisms.features.layers`; their forward functions are those of
LPIPS (:mod:`minisplat_ref.metrics.lpips`).
"""
