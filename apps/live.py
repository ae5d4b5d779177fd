"""Watch a map grow in the browser: the application behind ``taichi-mrf live``."""

import sys

from taichi_mrf.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["live", *sys.argv[1:]]))
