"""Wave splatting: a hologram, whose light looks like the scene at every distance.

This follows Gaussian Wave Splatting, 2025, arXiv 2505.06582. A flat Gaussian in space sends out a field whose spectrum
is known in closed form (:mod:`.model`), for light of the wavelength lambda:

    k = (fx, fy, fz),  fz = sqrt(1 / lambda^2 - fx^2 - fy^2),  (u, v) = (e_1, e_2) . (k - (0, 0, 1 / lambda))
    G = 2 pi s_1 s_2 exp(-2 pi^2 (u^2 s_1^2 + v^2 s_2^2)) |n . k| / fz exp(i 2 pi (cz / lambda - f . c + fz (z - cz)))

Blending goes front to back as in 3DGS, with waves for colours (:mod:`.blending`):

    U = sum_i P[T_i o_i c_i u_i],   T_(i+1) = T_i (1 - o_i |u_i|)

with the field u of a Gaussian in its own plane and the propagation P to the display, by the angular spectrum method on
a padded grid (:mod:`.model`). Beside it are the fast approximation, and the silhouette method as a baseline. A display
that shows phases alone gets the double-phase encoding (:mod:`.focus`).

    minisplat-ref wave hologram runs/fox --out fox.npz --phase fox_phase.png
    minisplat-ref wave focus fox.npz --depth 5 --out near.png
    python -m data_tools.claims wave/claims --out DIR
    python -m data_tools.claims wave/scene runs/fox/point_cloud.ply --out DIR
    minisplat-ref oracle gradients --extension wave

``docs/family/wave.md`` has the measured figures.

Any run will do: surfels are flat; other Gaussians lose their thinnest axis, and the number of those that were no discs
is reported. The camera's view is placed in a box of the display's size without perspective, as behind an eyepiece
(:mod:`.hologram`). Images store amplitudes, whose squares are intensities, much as on a screen. So with everything in
focus the absolute values of the field are the rendered image.

This deviates from the paper as follows. Exact blending of a whole scene is done in windows and 64 planes
(:mod:`.blending`), one Gaussian after another in NumPy; without them it takes two transforms of the grid for each
Gaussian. Only the sum of the fast approximation has a kernel. That approximation has one transmittance for each
Gaussian, at its centre, instead of none. Slopes are bounded, because a Gaussian that is steeper than its own light
would shine along its mirrored direction as well. The low-pass is that of 3DGS, for surfels too.

Left out: training on holograms, random phases (they blur parts out of focus more, with speckle), and the paper's
comparison by photographs of a display. There is nothing to train, so the gradients are those of the closed form.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.wave import focus, hologram
from minisplat_ref.extensions.wave.model import stages

EXTENSION = Extension("wave", commands=(hologram, focus), stages=stages)
"""Two commands, the closed form's gradients."""
