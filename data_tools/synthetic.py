"""``python -m data_tools.synthetic`` is ``minisplat-ref synthetic``: ray-trace a scene with exact depth and normals."""

import sys

from minisplat_ref.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["synthetic", *sys.argv[1:]]))
