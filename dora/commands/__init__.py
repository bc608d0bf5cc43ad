"""The bodies of the commands: what `dora NAME` does. Stands above everything."""
