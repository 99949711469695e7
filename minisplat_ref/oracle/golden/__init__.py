"""Golden vectors: what every stage of a renderer takes and gives, as plain arrays, for whoever writes another one.

Reading order: ``format`` (the arrays by name, and their README), ``scenes`` (the inputs, and from inputs to arrays
through any backend), ``files`` (a folder of them, written and checked).
"""
