"""Initialisation and density control, as pure functions from a population to a new one.

A module reads like its section of the paper and is independent of the optimiser. It returns its changes as an
:class:`minisplat_ref.strategy.ops.Edit`, with which the training loop updates moments and statistics to match.
"""
