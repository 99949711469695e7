"""Fuzzing: every reader is given files that were right and have been damaged, and must refuse them in one line.

Reading order: ``mutations`` (how a file is damaged), ``readers`` (what is damaged, and what reads it), ``judging``
(what a reader must not do), ``run`` (many files, in a process of their own that may crash or hang).
"""
