"""Scripts for work in the repository, which is where they run: ``python -m data_tools.sfm PHOTOS --out SCENE``.

Most are commands of ``minisplat-ref`` too, for a checkout from which nothing has been installed. ``measure``,
``machine``, ``fuzz``, ``guided_fuzz``, ``kill_points``, ``mutation``, ``survey``, ``notebooks``, ``house`` and
``same_results`` are not: they serve those who keep the figures of ``docs/measured``, the readers, the tests, the
oracle, the notebooks and the tree itself. None of them is installed.
"""
