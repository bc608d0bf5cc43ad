"""Show an object, its regions and its grasps on a web page: see `dora.commands.view`, or --help."""

import sys

from dora.commands.view import main

if __name__ == "__main__":
    sys.exit(main())
