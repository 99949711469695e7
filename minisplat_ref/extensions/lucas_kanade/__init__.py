"""Lucas-Kanade: a warp moves the Gaussians, and its flow is held to that of photographs.

This follows Gaussian Splatting Lucas-Kanade, 2024, arXiv 2407.11309. The Gaussians are those of time 0; at time t

    mu(t) = W(mu, t) = mu + f(mu, t),   q(t) = (1, r(mu, t) / 2) q,   ln s(t) = ln s + g(mu, t)

and each of f, r and g is a sum of radial basis functions whose coefficients are polynomials of time
(:mod:`minisplat_ref.mechanisms.motion.field`), so that velocity and Jacobian have closed forms. The velocity has three
(:mod:`minisplat_ref.mechanisms.motion.velocity`), among them that of Lucas and Kanade, ``J^+ dW/dt`` with J = dW/dx,
and is integrated to scene flow by a step of Runge-Kutta. Up to degree 4 that step is ``W(mu, t') - W(mu, t)`` exactly,
so neither the velocity nor the pseudo-inverse plays a part in training; only in ``claims lucas-kanade/forms``. Two
losses join the photometric one:

    flow          5: |sum_i w_i (pi'(x_i(t')) - pi(x_i(t))) - A f| to the next photograph, in image widths
    depth_order   0: max(0, m + ln d_near - ln d_far) of pairs of pixels whose order of depth is known

The flow f is found in the photographs by the classical method on a pyramid
(:mod:`~minisplat_ref.extensions.lucas_kanade.pyramid`), or given; the order of depths is that of the sparse points, or
of given maps. The camera may move: x and x' are seen by their own cameras.

    minisplat-ref train SCENE --recipe lucas-kanade --out runs/moving
    minisplat-ref train SCENE --recipe lucas-kanade --set flows=DIR --set depths=DIR --set depth_order=0.1
    minisplat-ref render runs/moving --time 0.5
    python -m data_tools.claims lucas-kanade/forms
    python -m data_tools.claims lucas-kanade/body --out DIR
    minisplat-ref oracle gradients --extension lucas-kanade

``docs/family/lucas-kanade.md`` has the measured figures. A PLY has the Gaussians of time 0, which any viewer shows; the
warp is in ``shared.npz`` beside it. ``velocity`` is the case of degree 1 in which every Gaussian has its own
coefficient.

This deviates from the paper as follows. The paper's warp is a network, trained by automatic differentiation. Its flow
and depth come from trained networks; ours do not, and ``--set flows=DIR`` and ``depths=DIR`` take theirs. Weights,
margin, rates, number of centres and degree are ours, since no released value was found. Left out: a first stage without
motion, and the rotation of spherical harmonics with their Gaussian.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.lucas_kanade.model import WARPED
from minisplat_ref.extensions.lucas_kanade.recipe import LUCAS_KANADE, stages

EXTENSION = Extension("lucas-kanade", recipes=(LUCAS_KANADE,), representation=WARPED, stages=stages)
