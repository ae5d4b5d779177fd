"""``python -m taichi_mrf`` is the console program ``taichi-mrf``."""

import sys

from taichi_mrf.cli.start import start

if __name__ == "__main__":
    sys.exit(start())
