"""Watch a task live on a web page: see `dora.commands.play`, or --help."""

import sys

if __name__ == "__main__":
    sys.argv[0] = "dora"  # nothing is registered before it is known what to do
    from dora.__main__ import start

    sys.exit(start(["play", *sys.argv[1:]]))
