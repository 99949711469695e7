"""Fuzzing: give every reader damaged files, which it must refuse in one line: ``python -m data_tools.fuzz``.

Reading order: :mod:`.mutations` (how a file is damaged), :mod:`.readers` (what is damaged, and what reads it),
:mod:`.judging` (what a reader must not do), :mod:`.run` (many files, in a separate process that may crash or hang).
"""
