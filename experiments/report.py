"""Tables and figures of finished runs: see `dora.commands.report`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["report", *sys.argv[1:]]))
