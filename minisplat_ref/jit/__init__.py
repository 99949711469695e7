"""Machinery without formulas: how functions are compiled and kept, and what eight numbers at once can do."""

from minisplat_ref.jit import lanes_arithmetic, lanes_memory  # noqa: F401  (they give lanes their compiled meaning)
