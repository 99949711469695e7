"""Golden vectors: inputs and outputs of every stage of a renderer, as plain arrays, for authors of other renderers.

Reading order: ``format`` (the arrays by name, and their README), ``running`` (from inputs to arrays through any
backend), ``scenes`` (the inputs, and all arrays by the reference), ``files`` (a folder of them, written and checked).
"""
