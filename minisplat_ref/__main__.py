"""``python -m minisplat_ref``: the command line."""

import sys

from minisplat_ref.app.cli import main

sys.exit(main())
