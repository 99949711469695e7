"""Linear motion: every Gaussian has a velocity, and a view shows the scene at its time.

This is the smallest extension that is a method. It has one more field, a renderer that wraps that of 3DGS, a recipe
and a command, and it is the worked example of ``docs/EXTENDING.md``. The centre of a Gaussian at the time t of a
view is

    mu(t) = mu + t nu

and everything else stays as it is (:mod:`.model`). Velocities start at zero, so that an untrained model is a static
one. Times are those of the views, ``time`` in a transforms.json; they are 0 where a scene has none, which leaves the
velocities without a gradient.

Left out are rotations and colours that change, and motion that is not straight, the subject of 4DGS. No single paper is
followed; linear motion is the first-order case of all of them.

    minisplat-ref train SCENE --recipe velocity
    minisplat-ref velocity freeze runs/SCENE-velocity/point_cloud.ply --time 0.5 --out still.ply
    minisplat-ref oracle gradients --extension velocity
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.velocity import freeze
from minisplat_ref.extensions.velocity.model import MOVING, VELOCITY

EXTENSION = Extension("velocity", recipes=(VELOCITY,), representation=MOVING, commands=(freeze,))
