"""Measure how fast the parts of Dora are: python experiments/bench.py env --env PickCube-v1 --json"""

import json
import sys
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from dora.errors import InputError
from dora.sim import benchmark


@dataclass
class Env:
    """Environment steps per second with random actions, against gymnasium's AsyncVectorEnv of single environments."""

    env: str = "PickCube-v1"
    """Task: any ManiSkill id."""
    num_envs: int = 64
    """Environments in each process."""
    workers: int = field(default_factory=benchmark.all_cores)
    """Processes (default: one per core)."""
    seconds: float = 10.0
    """Length of each measurement [s]."""
    json: bool = False
    """Print one JSON object on the last line instead of a table."""

    def run(self) -> dict:
        """Measure; the result as JSON-ready values."""
        return benchmark.measure(self.env, self.num_envs, self.workers, self.seconds).as_dict()


Command = Annotated[Env, tyro.conf.subcommand("env")]


def main(command: tyro.conf.OmitSubcommandPrefixes[Command]) -> None:
    """Run a benchmark and print its result."""
    result = command.run()
    if command.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:32} {value}")


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
