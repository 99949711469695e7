"""Golden vectors: what every stage of a renderer takes and gives, as plain arrays, for whoever writes another one.

Reading order: ``arrays`` (the names), ``scenes`` (the inputs), ``stages`` (from inputs to arrays, through any backend),
``flips`` (pixels that rounding decides), ``files`` (a folder of them), ``readme`` (the format in words).
"""
