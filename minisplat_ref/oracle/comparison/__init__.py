"""Comparison of another renderer with the reference, stage by stage.

Reading order: ``renderers`` (the renderers that can be compared, and their names), ``measures`` (the difference of two
arrays; boxes and lists that differ without effect on the image), ``doubts`` (values that depend on rounding),
``staged`` (the stages in order, the first that diverges, and the report).
"""
