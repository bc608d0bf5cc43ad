"""Generate grasps of an object, judge them, and store them: see `dora.commands.grasps`, or --help."""

import sys

from dora.commands.grasps import main

if __name__ == "__main__":
    sys.exit(main())
