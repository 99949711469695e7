"""gsplat's call in NumPy: code and tests that were written against ``gsplat.rasterization`` run on NumPy arrays.

:mod:`.call` is ``rasterization`` and its gradient, :mod:`.arguments` the meaning of its arguments, some of which are
refused. The same calls for discs and for lenses are beside their renderers,
:mod:`minisplat_ref.mechanisms.surfels.gsplat_call` and :mod:`minisplat_ref.mechanisms.cameras.gsplat_call`: the core
imports nothing of the family.
"""
