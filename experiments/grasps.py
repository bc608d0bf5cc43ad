"""Generate grasps of an object, judge them, and store them: see `dora.commands.grasps`, or --help."""

import sys

if __name__ == "__main__":
    from quiet_start import call  # before what takes seconds to import

    from dora.commands.grasps import main

    sys.exit(call(main))
