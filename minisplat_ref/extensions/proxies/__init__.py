"""Editing and physics: Gaussians that follow a mesh, fall like cloth, or are edited in part.

There are three ways to change a trained scene without training it again.

- *Affine edits* (:mod:`.edit`) apply x -> A x + b to the Gaussians that a box, a ball or a mesh selects. They are
  exact: mu' = A mu + b, Sigma' = A Sigma A^T, refactored into quaternion and scales by singular values
  (``mechanisms.editing.deformation``); colours rotate with the rotation in A (``mechanisms.editing.sh_rotation``).
- *Binding to a mesh* (:mod:`.binding`), after GaMeS (arXiv 2402.01459): each Gaussian belongs to the nearest triangle,
  by barycentric coordinates, an offset along the normal, and its axes in the frame of the triangle
  (``mechanisms.meshes.mesh``). When the mesh is deformed, Sigma' = F Sigma F^T with the triangle's deformation gradient
  F.
- *Physics* (:mod:`.mass_spring`): the mesh moves as masses and springs under gravity, integrated by
  velocity Verlet with an account of the energy, and the scene bound to it follows.

:mod:`.binding` lists the deviations from GaMeS: any Gaussians are bound, and the whole of F acts on them. The
extension ``games`` trains them on the faces. Left out are collisions of a sheet with itself, solids, and relighting of
rotated parts. ``docs/family/proxies.md`` has the measured figures.

    minisplat-ref proxies edit runs/fox out.ply --sphere 0 0 2 0.5 --rotate 0 30 0
    minisplat-ref proxies cage runs/banana sheet.ply --cells 20
    minisplat-ref proxies follow runs/banana sheet.ply bent.ply out.ply
    minisplat-ref proxies fall runs/banana sheet.ply --pin-top 0.02 --out fallen
"""

from minisplat_ref.extensions.extension import Extension
from minisplat_ref.extensions.proxies import binding, cage, edit, fall

EXTENSION = Extension("proxies", commands=(edit, cage, binding, fall))
