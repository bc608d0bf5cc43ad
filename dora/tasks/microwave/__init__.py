"""DoraMicrowave-v1: one arm opens a microwave by its handle, the other puts a cube inside."""

from dora.tasks.microwave.task import MicrowaveTask as MicrowaveTask
