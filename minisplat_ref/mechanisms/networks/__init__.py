"""Small networks and encodings of their input, with gradients written by hand, in NumPy and as kernels.

=====================  ==================  ====================================================================
:mod:`.mlp`            `.mlp_kernels`      fully connected layers with (leaky) ReLUs between them
:mod:`.fourier`        `.fourier_kernels`  sines and cosines of octaves
:mod:`.hash_grid`      `.hash_kernels`     features at the vertices of grids, in tables that hash the vertices
:mod:`.directions`                         directions from which a camera sees points
:mod:`.contraction`                        space in a ball, for encodings that need a bounded input
=====================  ==================  ====================================================================

:func:`.networks.networks_for` returns the NumPy functions or the kernels, whichever suits a backend: both have the same
names, arguments and results. In the kernels every sum has a fixed order, so results do not depend on the number of
threads.

A relative brings the sizes, and keeps weights and tables as shared parameters of its representation
(:func:`.mlp.to_shared`), so that Adam trains them, by name, and a run saves them. Its renderer computes Gaussians of
3DGS from a population and these, and propagates the gradient back.
"""
