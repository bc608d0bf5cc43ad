"""Measure how fast the parts of Dora are: see `dora.commands.bench`, or --help."""

import sys

from dora.commands.bench import main

if __name__ == "__main__":
    sys.exit(main())
