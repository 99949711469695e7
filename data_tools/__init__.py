"""Scripts for work in the repository, which is where they run: ``python -m data_tools.sfm PHOTOS --out SCENE``.

Each is a command of ``minisplat-ref`` for a checkout that nothing has been installed from, except ``measure``,
``fuzz``, ``kill_points``, ``mutation``, ``survey`` and ``notebooks``, which are of use only for work on the README's
figures, the readers, the tests, the oracle and the notebooks. They are not installed.
"""
