"""Record demonstrations or episodes of a policy as a dataset: see `dora.commands.demos`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["demos", *sys.argv[1:]]))
