"""``python -m data_tools.downscale`` is ``minisplat-ref downscale``: write smaller copies of a scene's photographs."""

import sys

from minisplat_ref.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["downscale", *sys.argv[1:]]))
