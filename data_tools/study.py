"""``python -m data_tools.study`` is ``minisplat-ref study``: measure what a choice in a method does."""

import sys

from minisplat_ref.cli import main

if __name__ == "__main__":
    sys.exit(main(["study", *sys.argv[1:]]))
