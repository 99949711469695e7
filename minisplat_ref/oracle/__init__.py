"""The oracle: what a backend is checked against, and how.

Reading order: ``cases`` (what every check reports); ``setting``, ``stages`` and ``pieces`` (a small scene, each stage
on it as a function with its gradient, and the formulas below the stages); ``differences`` and ``gradients`` (are the
gradients derivatives?); ``truth`` (is float64 enough?); ``planted`` (would an error be found?); ``hard_cases`` (what
breaks renderers); ``golden`` and ``comparison`` (where does another backend differ?); ``bench`` (what does precision
cost?); ``peers`` (renderers of others that run here).
"""
