"""``python -m data_tools.measure``: the measurements of whole training runs in docs/measured."""

from minisplat_ref.experiments.measure import main

if __name__ == "__main__":
    main()
