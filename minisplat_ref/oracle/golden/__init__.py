"""Golden vectors: what every stage of a renderer takes and gives, as plain arrays, for whoever writes another one.

Reading order: ``format`` (the arrays by name, and their README), ``running`` (from inputs to arrays through any
backend), ``scenes`` (the inputs, and all arrays by the reference), ``files`` (a folder of them, written and checked).
"""
