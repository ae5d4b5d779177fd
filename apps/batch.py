"""Map a sequence and write the results to a folder: the application behind ``taichi-mrf map``."""

import sys

from taichi_mrf.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["map", *sys.argv[1:]]))
