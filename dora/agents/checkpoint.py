"""Checkpoints: safetensors files with everything a run needs to go on, and what they belong to."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dora.agents.agent_columns import Agents, checked_agents, plain_agents
from dora.agents.config import RunConfig, config_from_dict, stored_digests
from dora.agents.counters import checked_counters
from dora.agents.limits import check
from dora.configs import plain
from dora.errors import InputError, shown
from dora.files import read_safetensors, write_safetensors
from dora.reading import parse_json

FORMAT = "dora-checkpoint"
"""Format of a checkpoint file."""
VERSION = 2
"""Version of that format; `read_checkpoint` says what the digests of version 1 do not cover."""
LARGEST_SIZE = 65_536
"""Largest number of components of an observation or action that a checkpoint may have."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds.

    config: settings of the run that wrote it.
    sizes: numbers of observation and action components.
    tensors: flat names and values.
    progress: counters of the run (environment steps, seconds, best evaluation ...).
    config_digest: digest of the settings as it was written.
    agents: columns of the agents that the learner tells apart, by name; none where one sees and commands everything.
    """

    config: RunConfig
    sizes: tuple[int, int]
    tensors: dict[str, Tensor]
    progress: dict[str, Any] = field(default_factory=dict)
    config_digest: str = ""
    agents: Agents = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write atomically.

        Raises:
            InputError: if the disk is full; an older file survives.
        """
        header = {
            "format": FORMAT,
            "version": str(VERSION),
            "config": json.dumps(plain(self.config)),
            "config_digest": self.config.digest(),
            "sizes": json.dumps(self.sizes),
            "progress": json.dumps(self.progress),
        } | ({"agents": json.dumps(plain_agents(self.agents))} if self.agents else {})
        write_safetensors(path, self.tensors, header)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint written by `Checkpoint.write`.

    The digest of the file covers every byte of it. In files of version 1 it covers the tensors alone; of the header the
    settings are covered by `config_digest`, but `total_steps` and the counters in `progress` by nothing.

    Raises:
        InputError: if it is missing, truncated, damaged or something else.
    """
    versions = [str(version) for version in range(1, VERSION + 1)]
    tensors, header = read_safetensors(path, "checkpoint", {"format": (FORMAT,), "version": versions})
    names = ("config", "sizes", "progress")
    settings, sizes, progress = (parse_json(header.get(name, "null"), f"{name} of {path}") for name in names)
    counts = sizes if isinstance(sizes, list) else []
    if len(counts) != 2 or not all(type(count) is int and 0 < count <= LARGEST_SIZE for count in counts):
        raise InputError(f"{path} has the sizes {shown(sizes)}, not two whole numbers above 0: use another checkpoint.")
    if not isinstance(progress, dict):
        raise InputError(f"{path} has no counters of its run: use another checkpoint.")
    checked_counters(progress, path)
    config = config_from_dict(settings, f"the settings in {path}")
    if header.get("config_digest") not in stored_digests(settings):
        raise InputError(f"{path} has settings that were changed (their digest differs): use another checkpoint.")
    try:
        check(config, stored=True)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    agents = checked_agents(
        parse_json(header.get("agents", "{}"), f"agents of {path}"),
        (sizes[0], sizes[1]),
        f"the list of agents in {path}",
    )
    return Checkpoint(config, (sizes[0], sizes[1]), tensors, progress, header["config_digest"], agents)


@contextlib.contextmanager
def whole(path: Path) -> Iterator[None]:
    """Says in one sentence that a checkpoint is incomplete, where what is done with it fails."""
    try:
        yield
    except (LookupError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path} cannot be resumed ({reason}): it is incomplete or of another version.") from error


def check_belongs(
    checkpoint: Checkpoint,
    path: Path,
    config: RunConfig,
    sizes: tuple[int, int],
    agents: Agents | None = None,
    *,
    exactly: bool,
) -> None:
    """Refuse a checkpoint of something else.

    Args:
        checkpoint: what was read.
        path: of it, for messages.
        config: settings of the run in hand.
        sizes: numbers of observation and action components of its task.
        agents: that its learner tells apart.
        exactly: also every setting has to agree (for resuming), not only what the networks depend on.

    Raises:
        InputError: naming the first difference.
    """
    theirs, ours = checkpoint.config, config
    differences = [
        (name, getattr(theirs, name), getattr(ours, name))
        for name in ("env", "agent", "guidance")
        if getattr(theirs, name) != getattr(ours, name)
    ]
    names = ("observation size", "action size")
    differences += [(n, a, b) for n, a, b in zip(names, checkpoint.sizes, sizes, strict=True) if a != b]
    known, wanted = plain_agents(checkpoint.agents), plain_agents(agents or {})
    if not differences and list(known) != list(wanted):
        differences = [("agents", ", ".join(known) or "none", ", ".join(wanted) or "none")]
    differences += [
        (f"columns of {n}", shown(known[n]), shown(wanted[n])) for n in known if known[n] != wanted.get(n, known[n])
    ]
    if exactly and not differences and theirs.digest() != ours.digest():
        differences = [("config digest", theirs.digest(), ours.digest())]
    if differences:
        name, their_value, our_value = differences[0]
        raise InputError(
            f"{path} belongs to another run ({name} {their_value}, not {our_value}): "
            "choose the checkpoint that fits, or the settings that it was made with."
        )


def pack_modules(modules: dict[str, nn.Module]) -> dict[str, Tensor]:
    """Parameters and buffers as `<module>/<name>`."""
    return {f"{key}/{n}": v for key, module in modules.items() for n, v in module.state_dict().items()}


def bytes_of(modules: dict[str, nn.Module], optimisers: dict[str, torch.optim.Optimizer]) -> int:
    """Size of a checkpoint of networks whose parameters have two moments each, as Adam keeps them [bytes]."""
    stored = list(pack_modules(modules).values())
    moments = [p for one in optimisers.values() for group in one.param_groups for p in group["params"]] * 2
    return sum(tensor.numel() * tensor.element_size() for tensor in stored + moments)


def check_finite(tensors: dict[str, Tensor], path: Path) -> None:
    """Refuse tensors of a checkpoint that are not finite.

    Raises:
        InputError: naming the first.
    """
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise InputError(f"{path} holds NaN or infinity in {name}: use an earlier checkpoint, or train again.")


def unpack_modules(modules: dict[str, nn.Module], tensors: dict[str, Tensor], path: Path) -> None:
    """Load what `pack_modules` made.

    Raises:
        InputError: if names or shapes differ, or something is not finite.
    """
    for key, module in modules.items():
        prefix = f"{key}/"
        state = {n.removeprefix(prefix): v for n, v in tensors.items() if n.startswith(prefix)}
        check_finite({f"{prefix}{n}": v for n, v in state.items()}, path)
        try:
            module.load_state_dict(state)
        except RuntimeError as error:
            raise InputError(
                f"{path} does not fit the network `{key}`: choose a checkpoint made with the same settings."
            ) from error


def pack_optimisers(optimisers: dict[str, torch.optim.Optimizer]) -> dict[str, Tensor]:
    """State of optimisers as `<optimiser>/<parameter>/<name>`, and their learning rates."""
    tensors: dict[str, Tensor] = {}
    for key, optimiser in optimisers.items():
        state = optimiser.state_dict()
        for index, values in state["state"].items():
            tensors |= {f"{key}/{index}/{name}": torch.as_tensor(value) for name, value in values.items()}
        rates = [group["lr"] for group in state["param_groups"]]
        tensors[f"{key}/learning_rate"] = torch.tensor(rates, dtype=torch.float64)
    return tensors


def unpack_optimisers(optimisers: dict[str, torch.optim.Optimizer], tensors: dict[str, Tensor]) -> None:
    """Load what `pack_optimisers` made."""
    for key, optimiser in optimisers.items():
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            owner, _, rest = name.partition("/")
            if owner == key and rest != "learning_rate":
                index, _, entry = rest.partition("/")
                state.setdefault(int(index), {})[entry] = value.clone()
        groups = optimiser.state_dict()["param_groups"]
        for group, rate in zip(groups, tensors[f"{key}/learning_rate"].tolist(), strict=True):
            group["lr"] = rate
        optimiser.load_state_dict({"state": state, "param_groups": groups})


def pack_rng() -> dict[str, Tensor]:
    """States of torch's and NumPy's global generators."""
    _, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002
    return {
        "rng/torch": torch.get_rng_state(),
        "rng/numpy_keys": torch.from_numpy(np.asarray(keys).astype(np.int64)),
        "rng/numpy_rest": torch.tensor([position, has_gauss, gauss], dtype=torch.float64),
    }


def unpack_rng(tensors: dict[str, Tensor]) -> None:
    """Restore what `pack_rng` made."""
    torch.set_rng_state(tensors["rng/torch"])
    position, has_gauss, gauss = tensors["rng/numpy_rest"].tolist()
    keys = tensors["rng/numpy_keys"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", keys, int(position), int(has_gauss), gauss))  # noqa: NPY002
