"""Comparison of another renderer with the reference, stage by stage.

Reading order: ``renderers`` (whoever can be compared), ``measure`` (how far two arrays are apart), ``harmless`` (boxes
and lists that differ and change nothing), ``staged`` (the stages in order, and the first that diverges), ``report``.
``own``, ``dumps``, ``gsplat_cuda`` and ``inria_cuda`` are the renderers, ``choose`` finds one by its name.
"""
