"""Machinery without formulas: compiling and caching functions, and operations on eight numbers at once."""

from minisplat_ref.jit import lanes_arithmetic, lanes_memory  # noqa: F401  (they give lanes their compiled meaning)
