"""Who exists: initialisation and density control, as pure functions from a population to a new one.

A module reads like its section of the paper and knows nothing of the optimiser. What it changes it returns as an
:class:`minisplat_ref.strategy.ops.Edit`, from which the training loop brings moments and statistics into step.
"""
