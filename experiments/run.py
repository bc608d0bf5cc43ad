"""Train or evaluate a learner on a Dora task: see `dora.commands.run`, or --help."""

import sys

from dora.commands.run import main

if __name__ == "__main__":
    sys.exit(main())
