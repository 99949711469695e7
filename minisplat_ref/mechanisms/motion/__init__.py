"""Motion of Gaussians: smooth fields over space and time, with their velocities.

:mod:`.field` is the field, a sum of radial basis functions whose coefficients are polynomials of time; :mod:`.velocity`
has the velocity of a warp in its three forms and integrates it. A relative defines what the field moves, and which
parameters its coefficients are. Linear motion, ``mu(t) = mu + t nu``, is the case of degree 1.
"""
