"""The book: every formula of the renderer once, as matrices in NumPy, forward and derivative side by side.

Read the modules in this order; it is that of the papers.

===================  ==============================================================  ============================
module               what you will know after reading it                             equations
===================  ==============================================================  ============================
covariance           how a quaternion and three scales make an ellipsoid             3DGS (6)
pinhole              where a camera sees a point, and how that moves with the point  EWA splatting (29)
antialiasing         how to make up for the blur that keeps ellipses visible         EWA splatting, Mip-Splatting
projection           how the camera flattens an ellipsoid to an ellipse in pixels    3DGS (5), EWA splatting (31)
extent               which pixels that ellipse can reach                             Mini-Splatting2, gsplat
spherical_harmonics  how its colour depends on the viewing direction                 3DGS sec. 3
tiling               how ellipses are sorted, tile by tile, front to back            3DGS sec. 6
hits                 how strongly an ellipse covers a pixel, and what it leaves      3DGS (3), (4)
blend_stats          which ellipses matter to a pixel, and its median depth          Mini-Splatting sec. 3
compositing          how hits become a pixel, and a pixel's error becomes theirs     3DGS (3)
removal              how much an image would change without one of the ellipses      LeCun et al. 1990
depth                the depth of what a pixel shows, by two definitions             Mini-Splatting appendix D
loss                 how far a rendered image is from a photograph                 3DGS (7), Wang et al. 2004
adam                 how a gradient becomes a step                                   Kingma and Ba 2015
===================  ==============================================================  ============================

Nothing here is written for speed, and no framework differentiates it. ``v_x`` is the derivative of the loss with
respect to ``x`` and has its shape; a function ``f_vjp`` maps the derivatives with respect to the outputs of ``f`` to
those with respect to its inputs. Arrays keep the dtype that they come in with.
"""
