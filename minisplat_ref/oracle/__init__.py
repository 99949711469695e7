"""The oracle: what a backend is checked against, and how.

Reading order: ``cases`` (what every check reports), ``stages`` (each stage as a function with its gradient),
``differences`` and ``gradients`` (are the gradients derivatives?), ``truth`` (is float64 enough?), ``planted`` (would
an error be found?), ``hard_cases`` (what breaks renderers), ``golden`` and ``comparison`` (where does another backend
differ?), ``bench`` (what does precision cost?).
"""
