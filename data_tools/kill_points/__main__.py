"""``python -m data_tools.kill_points``: see :mod:`data_tools.kill_points.survival`."""

from data_tools.kill_points.survival import main

if __name__ == "__main__":
    main()
