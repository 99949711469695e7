"""Comparison of another renderer with the reference, stage by stage.

Reading order: ``renderers`` (what can be compared, and which renderer a name means), ``measures`` (how far two arrays
are apart; boxes and lists that differ and change nothing), ``doubts`` (which values rounding decides), ``staged`` (the
stages in order, the first that diverges, and the report).
"""
