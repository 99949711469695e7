"""``python -m data_tools.fuzz``: see :mod:`data_tools.fuzz.run`."""

from data_tools.fuzz.run import main

if __name__ == "__main__":
    main()
