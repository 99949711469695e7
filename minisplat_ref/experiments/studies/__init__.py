"""Studies: what a choice in a method does to a scene, measured. ``minisplat-ref study STUDY --help``.

One module per study, each with ``add_parser`` (arguments and help) and ``run`` (trains, measures, writes). A new study
is such a module, named in ``__main__.STUDIES``. What they share is in ``front``.
"""
