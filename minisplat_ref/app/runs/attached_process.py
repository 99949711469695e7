"""Run a module in a process that ends with the one that started it: ``-m`` of a worker's children.

A worker that is killed closes the pipe that is the standard input here. The command must not continue then: another
worker takes its task over, and both would write into one folder. It ends at once, like the worker itself, and a
training that continues from its last checkpoint has the bytes of a run in one piece.
"""

import os
import runpy
import sys
import threading

ORPHANED = 1  # exit code that no process reads


def _end_with_parent() -> None:
    """Wait for the end of the standard input, which nothing is written to."""
    while os.read(0, 1):
        pass
    os._exit(ORPHANED)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    module = sys.argv.pop(1)
    sys.argv[0] = module.replace("_", "-")
    runpy.run_module(module, run_name="__main__", alter_sys=True)
