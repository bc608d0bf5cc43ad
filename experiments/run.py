"""Train or evaluate a learner on a Dora task: see `dora.commands.run`, or --help."""

import sys

if __name__ == "__main__":
    from quiet_start import call  # before what takes seconds to import

    from dora.commands.run import main

    sys.exit(call(main))
