"""Measure how fast the parts of Dora are: see `dora.commands.bench`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["bench", *sys.argv[1:]]))
