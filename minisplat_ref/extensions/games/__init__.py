"""GaMeS: Gaussians that are trained on the faces of a mesh.

This follows GaMeS: Mesh-Based Adapting and Modification of Gaussian Splatting (2024), arXiv 2402.01459, for a scene
whose mesh is given. Each face carries a fixed number of Gaussians. A Gaussian stores its weights of the three corners
and its size relative to the face, so its mean lies on the face, its normal is that of the face, and its other two axes
are those of the face (:mod:`.model` has the equations). Whatever moves the corners moves the Gaussians.

    minisplat-ref mesh runs/fox --out fox.ply
    minisplat-ref train data/fox --recipe games --init fox.ply --set per_face=5 --out runs/on_mesh
    minisplat-ref proxies follow runs/on_mesh fox.ply bent.ply bent_model.ply
    python -m data_tools.claims games/counts room --out DIR
    minisplat-ref oracle gradients --extension games

``docs/family/games.md`` has the measured figures.

The PLY is one of 3DGS, with means, rotations and scales as they follow; its further columns, which other viewers skip,
continue a training. No Gaussian is cloned, split or pruned, and opacities are not reset.

This deviates from the paper as follows. The thickness is a thousandth of the other two lengths instead of a constant.
Sizes stay above zero as exponentials, and the weights of corners as a softmax. The third length is that of p1 - m
along r3; the paper's formula has p1, which would depend on the origin of the world. The first sizes, the random places,
the colours of the nearest points, and both rates are ours.

Left out are corners that are trained, the soup of triangles for scenes without a mesh, and FLAME for faces.
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.games.model import GAMES, ON_FACES

EXTENSION = Extension("games", recipes=(GAMES,), representation=ON_FACES)
"""Gaussians on faces, the recipe that trains them."""
