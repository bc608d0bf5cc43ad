"""Measure how fast the parts of Dora are: see `dora.commands.bench`, or --help."""

import sys

if __name__ == "__main__":
    from quiet_start import call  # before what takes seconds to import

    from dora.commands.bench import main

    sys.exit(call(main))
