"""Scripts for work in the repository, which is where they run: ``python -m data_tools.sfm PHOTOS --out SCENE``.

``claims`` measures what papers claim. Some scripts are commands of ``minisplat-ref`` too, for a checkout from which
nothing has been installed. The others serve those who keep the figures of ``docs/measured`` (``measure``, ``machine``),
the readers (``fuzz``, ``guided_fuzz``, ``kill_points``), the tests (``mutation``, ``survey``), the notebooks and docs
(``notebooks``, ``reading_order``, ``site``), and the tree itself (``house``, ``same_results``, ``same_speed``,
``commit_subject``). None of them is installed.
"""
