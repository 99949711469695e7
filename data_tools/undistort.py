"""``python -m data_tools.undistort`` is ``minisplat-ref undistort``: copy a scene without lens distortion."""

import sys

from minisplat_ref.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["undistort", *sys.argv[1:]]))
