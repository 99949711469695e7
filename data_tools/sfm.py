"""``python -m data_tools.sfm`` is ``minisplat-ref sfm``: make a scene from photographs."""

import sys

from minisplat_ref.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["sfm", *sys.argv[1:]]))
