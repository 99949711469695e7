"""Oriented points and primitives: planes through near points, and the normal of a Gaussian.

:mod:`.planes` fits a plane to the neighbours of each point; :mod:`.thin_axis` is the normal of a population with its
gradient, so that a loss on normals serves both Gaussians (their shortest axis) and surfels (their third).
"""
