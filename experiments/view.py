"""Show an object, its regions and its grasps on a web page: see `dora.commands.view`, or --help."""

import sys

if __name__ == "__main__":
    from quiet_start import call  # before what takes seconds to import

    from dora.commands.view import main

    sys.exit(call(main))
