"""``python -m data_tools.foreign_files``: see :mod:`data_tools.foreign_files.kinds`."""

from data_tools.foreign_files.kinds import main

if __name__ == "__main__":
    main()
