"""Checkpoints: safetensors files with everything a run needs to go on, and what they belong to."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dora.agents.config import RunConfig, config_from_dict
from dora.configs import plain
from dora.errors import InputError
from dora.files import read_safetensors, write_safetensors

FORMAT = "dora-checkpoint"
"""Format of a checkpoint file."""
VERSION = 1
"""Version of that format."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds.

    config: settings of the run that wrote it.
    sizes: numbers of observation and action components.
    tensors: flat names and values.
    progress: counters of the run (environment steps, seconds, best evaluation ...).
    config_digest: digest of the settings as it was written.
    """

    config: RunConfig
    sizes: tuple[int, int]
    tensors: dict[str, Tensor]
    progress: dict[str, Any] = field(default_factory=dict)
    config_digest: str = ""

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
        }
        write_safetensors(path, self.tensors, header)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint written by `Checkpoint.write`.

    Raises:
        InputError: if it is missing, truncated, damaged or something else.
    """
    tensors, metadata = read_safetensors(path, "checkpoint", {"format": FORMAT, "version": str(VERSION)})
    observation, action = json.loads(metadata["sizes"])
    return Checkpoint(
        config_from_dict(json.loads(metadata["config"])),
        (observation, action),
        tensors,
        json.loads(metadata["progress"]),
        metadata["config_digest"],
    )


def check_belongs(
    checkpoint: Checkpoint, path: Path, config: RunConfig, sizes: tuple[int, int], *, exactly: bool
) -> None:
    """Refuse a checkpoint of something else.

    Args:
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


def unpack_modules(modules: dict[str, nn.Module], tensors: dict[str, Tensor], path: Path) -> None:
    """Load what `pack_modules` made.

    Raises:
        InputError: if names or shapes differ.
    """
    for key, module in modules.items():
        prefix = f"{key}/"
        state = {n.removeprefix(prefix): v for n, v in tensors.items() if n.startswith(prefix)}
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
