"""``python -m data_tools.published CLONES``: where each date and constant of the recipes is stated, and whether it is.

``rows``          a fact of ours beside what a source says
``repositories``  the released code, at commits
``methods``       the tables of 3DGS and Mini-Splatting
``surfaces``      those of the relatives that train surfels
``relatives``     those of the others
``constants``     constants of modules, beside the recipes
``check``         a clone is read, and a row compared with it

``tests/extensions/test_published.py`` holds the recipes to these tables, so that a row that agrees with its source says
what the program does. What a table calls ours is a choice of this program, which has its reason beside it in the code.
Papers are not fetched: their rows name the place alone.
"""
