"""Deform Gaussians exactly: affine maps of ellipsoids, and colours that rotate along.

A relative brings a deformation: at each Gaussian a new mean and the deformation gradient F there.
:mod:`.deformation` applies it to means, quaternions and scales, :mod:`.sh_rotation` rotates spherical harmonics, and
:mod:`.model_file` reads the model that a command edits.
"""
