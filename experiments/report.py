"""Tables and figures of finished runs: see `dora.commands.report`, or --help."""

import sys

from dora.commands.report import main

if __name__ == "__main__":
    sys.exit(main())
