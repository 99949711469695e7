"""Comparison of another renderer with the reference, stage by stage.

Reading order: ``renderers`` (what can be compared, and which renderer a name means), ``measures`` (how much two arrays
differ; boxes and lists that differ without effect on the image), ``doubts`` (values that depend on rounding),
``staged`` (the stages in order, the first that diverges, and the report).
"""
