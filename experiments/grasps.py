"""Generate grasps of an object, judge them, and store them: see `dora.commands.grasps`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["grasps", *sys.argv[1:]]))
