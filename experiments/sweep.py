"""All runs of the paper's tables by one command that can be interrupted: see `dora.commands.sweep`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["sweep", *sys.argv[1:]]))
