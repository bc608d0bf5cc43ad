"""Show an object, its regions and its grasps on a web page: see `dora.commands.view`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["view", *sys.argv[1:]]))
