"""Train or evaluate a learner on a Dora task: see `dora.commands.run`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["run", *sys.argv[1:]]))
