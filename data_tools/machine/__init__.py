"""Measure this machine with the package: start, memory, slopes and limits; ``python -m data_tools.machine COMMAND``.

Reading order: :mod:`.start_time` (seconds to the first iteration), :mod:`.process_memory`, :mod:`.peak_memory` and
:mod:`.large_scene` (what training needs, against what was predicted), :mod:`.conversions` (what ``convert`` needs),
:mod:`.slopes` (time against hits), :mod:`.contests` (what is compared takes turns), :mod:`.limits` (single stages, Adam
against a copy), :mod:`.roofline` (blending against straight-line loops), :mod:`.threads` (the gain of more threads).
"""
