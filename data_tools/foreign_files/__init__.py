"""Files as other programs and people leave them, built small, and what the command line makes of each.

A case builds its files in an empty folder and asserts the right result: the value itself, or a refusal in one line that
names file, cause and way out. ``python -m data_tools.foreign_files`` prints how many of each kind are right; the tests
run the same cases.
"""
