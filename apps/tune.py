"""Find the parameters of a sensor in the browser: the application behind ``taichi-mrf tune``."""

import sys

from taichi_mrf.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["tune", *sys.argv[1:]]))
