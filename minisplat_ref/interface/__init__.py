"""The user interface that all wings share: arguments, progress, tables and images, without any formula.

================== ==================================================================
:mod:`.arguments`  the types of arguments, their errors and their help
:mod:`.progress`   bars in a terminal, lines in a log
:mod:`.reporting`  tables in Markdown, and the machine that measured
:mod:`.showing`    scenes and photographs as pictures in a notebook
:mod:`.palette`    colours of plots
================== ==================================================================
"""
