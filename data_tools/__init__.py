"""Scripts for work in the repository, which is where they run: ``python -m data_tools.sfm PHOTOS --out SCENE``.

Each is a command of ``minisplat-ref`` for a checkout that nothing has been installed from, except ``measure``,
``fuzz``, ``kill_points``, ``mutation`` and ``survey``, which are of use to those alone who keep the figures of docs/measured,
the readers, the tests and the oracle. They are not installed.
"""
