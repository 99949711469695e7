"""The oracle: everything that a backend is checked against, and the checks.

Each check answers one question, and ``minisplat-ref oracle`` runs it. Read them in this order:

===============  ============================================================================  =============
module           content                                                                       command
===============  ============================================================================  =============
``cases``        what every check reports: named cases that passed or not, as table and JSON
``tolerances``   every tolerance and every margin, with its reason
``thresholds``   pixels at which rounding decides whether a hit counts, or which is in front
``setting``      a small scene on which every branch of every gradient is taken
``stages``       each stage of a backend as a function with its gradient
``public_call``  the same for ``rasterization``, in every mode
``pieces``       the same for the formulas of the reference inside the stages
``differences``  sixth-order differences that refuse to cross a threshold
``gradients``    are the gradients derivatives?                                                ``gradients``
``planted``      would an error be found? Backends that are wrong in one formula, on purpose   ``compare``
``truth``        is float64 enough? The formulas in 50 digits                                  ``truth``
``hard_cases``   scenes that break renderers; every precision against the reference            ``hard-cases``
``golden``       arrays of every stage, for authors of other renderers                         ``export``
``renderer``     another renderer: a name, a precision and arrays for a scene
``comparison``   where does another renderer differ, and does it matter?                       ``compare``
``peers``        other renderers: gsplat in PyTorch and in CUDA, the 3DGS rasteriser           ``compare``
===============  ============================================================================  =============

This package is about correctness only; for speed, and its cost in digits, see :mod:`minisplat_ref.bench`.
"""
