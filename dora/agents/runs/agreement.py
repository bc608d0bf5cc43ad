"""Whether an evaluation has the episodes of the stored run whose policy it evaluates."""

import dataclasses
import os
from pathlib import Path

from dora.agents.config import RunConfig
from dora.agents.runs.stored_results import read_episodes, read_result
from dora.errors import InputError

COMPARED = ("success", "return", "penetration_mm")
"""Columns that have to be the same for an episode to be."""
BEST = Path("checkpoints", "best.safetensors")
"""Checkpoint that the figures of a run folder are of; in a stored result it lies beside the figures."""


def agreement(checkpoint: Path, evaluated: Path, config: RunConfig, first_seed: int) -> str | None:
    """One sentence on how many of the first episodes are those of the run that the checkpoint is of.

    Args:
        checkpoint: its file, in a run folder or beside the figures of a stored result.
        evaluated: `eval.csv` of the evaluation.
        config: its settings.
        first_seed: seed of its first episode.

    Returns:
        The sentence, which says so where the figures are damaged; None if there are none, or they are of other starts
        or settings.
    """
    try:
        return _agreement(checkpoint, evaluated, config, first_seed)
    except InputError as error:
        return f"Not compared with the run of its policy: {error}"


def _agreement(checkpoint: Path, evaluated: Path, config: RunConfig, first_seed: int) -> str | None:
    best = Path(checkpoint.parent.name, checkpoint.name) == BEST
    folder = checkpoint.parent.parent if best else checkpoint.parent
    if not all(os.path.isfile(folder / name) for name in ("result.json", "eval.csv")):
        return None
    result = read_result(folder / "result.json")
    if result is None or result.get("first_seed") != first_seed:
        return None
    if dataclasses.replace(config, final_episodes=result.get("eval_episodes")).digest() != result.get("config_digest"):
        return None
    stored, own = read_episodes(folder / "eval.csv"), read_episodes(evaluated)
    names = [name for name in COMPARED if name in stored and name in own]
    episodes = [list(zip(*(table[name] for name in names), strict=True)) for table in (stored, own)]
    count = min(map(len, episodes))
    same = sum(a == b for a, b in zip(*episodes, strict=False))
    text = f"{same} of {count} episodes are those of {folder}, to the last digit"
    if same == count:
        return f"{text}."
    alike = sum(a == b for a, b in zip(stored["success"], own["success"], strict=False))
    return f"{text}, {alike} end alike: this version, or this processor, rounds differently."
