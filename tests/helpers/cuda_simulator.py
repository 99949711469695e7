"""Run a helper in Numba's simulator, which has to be chosen before Numba is imported: in a process of its own."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

HELPERS = Path(__file__).parent


def run_in_simulator(helper, path):
    """What ``python HELPER PATH`` leaves in the file PATH."""
    places = os.pathsep.join([str(HELPERS), str(HELPERS.parent.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": places}
    subprocess.run([sys.executable, HELPERS / helper, path], env=environment, check=True)
    return pickle.loads(path.read_bytes())
