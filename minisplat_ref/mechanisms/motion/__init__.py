"""Motion of Gaussians: smooth fields over space and time, what moves where and how fast.

:mod:`.field` is the field, a sum of radial basis functions whose coefficients are polynomials of time; :mod:`.velocity`
has the velocity of a warp in its three forms and integrates it. A relative brings what the field moves, and whose
parameters its coefficients are. Linear motion, ``mu(t) = mu + t nu``, is the case of degree 1.
"""
