"""The bodies of the commands: what `experiments/*.py` call. Stands above everything."""
