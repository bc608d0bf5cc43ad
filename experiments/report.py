"""Tables and figures of finished runs: see `dora.commands.report`, or --help."""

import sys

if __name__ == "__main__":
    from quiet_start import call  # before what takes seconds to import

    from dora.commands.report import main

    sys.exit(call(main))
