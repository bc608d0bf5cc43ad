"""Agents of a task: which columns of the observation each of them sees, and which columns of the action it commands."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import nn

from dora.errors import InputError, shown

MOST_AGENTS = 64
"""Largest number of agents of a task [1]."""


@dataclass(frozen=True)
class AgentColumns:
    """The part of one agent.

    observation: columns of the observation that it sees; several agents may see the same.
    action: columns of the action that it commands, in the order of its own action; no other agent commands them.
    """

    observation: tuple[int, ...]
    action: tuple[int, ...]


Agents = Mapping[str, AgentColumns]
"""The agents by name, in order; without any, one agent sees and commands everything."""


def plain_agents(agents: Agents) -> dict[str, list[list[int]]]:
    """The agents as plain data, for JSON: by name, the columns of the observation and those of the action."""
    return {name: [list(columns.observation), list(columns.action)] for name, columns in agents.items()}


def checked_agents(content: Any, sizes: tuple[int, int], source: str) -> dict[str, AgentColumns]:
    """The agents that plain data or a task's `agent_columns` name.

    Args:
        content: by name, a pair of the columns of the observation and those of the action.
        sizes: numbers of observation and action components.
        source: names the content in messages.

    Raises:
        InputError: a name or a column is none, or the actions of all agents are not each column of the action once.
    """
    if not isinstance(content, Mapping) or len(content) > MOST_AGENTS:
        raise InputError(f"{source} has to be a mapping of at most {MOST_AGENTS} names to columns: correct it.")
    agents = {_checked_name(name, source): _checked_part(name, part, sizes, source) for name, part in content.items()}
    counts = Counter(column for columns in agents.values() for column in columns.action)
    wrong = [column for column in range(sizes[1]) if counts[column] != 1]
    if agents and wrong:
        raise InputError(
            f"{source} gives column {wrong[0]} of the action to {counts[wrong[0]]} agents: each column needs one."
        )
    return agents


def _checked_name(name: Any, source: str) -> str:
    """A name that networks can be stored under."""
    if not isinstance(name, str) or not name.isidentifier() or hasattr(nn.ModuleDict(), name):
        raise InputError(f"{source} has an agent called {shown(name)}: choose a plain word, such as left.")
    return name


def _checked_part(name: str, part: Any, sizes: tuple[int, int], source: str) -> AgentColumns:
    if not isinstance(part, list | tuple) or len(part) != 2:
        raise InputError(f"{source} needs two lists of columns for {name}: of the observation and of the action.")
    found = []
    for what, columns, size in zip(("observation", "action"), part, sizes, strict=True):
        numbers = list(columns) if isinstance(columns, list | tuple | range) else []
        fits = all(type(column) is int and 0 <= column < size for column in numbers)
        if not numbers or not fits or len(set(numbers)) < len(numbers):
            raise InputError(
                f"{source} needs different whole numbers from 0 to {size - 1} as columns of the {what} of {name}, not "
                f"{shown(columns)}."
            )
        found.append(tuple(numbers))
    return AgentColumns(*found)
