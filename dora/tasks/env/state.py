"""Saving and restoring what a task remembers beside the simulator: memory, stages, guides, noise, sizes."""

from typing import Any

import torch
from torch import Tensor


def remembered(env: Any) -> dict[str, Any]:
    """What a task remembers of an episode, by name; each has get_state() and set_state(state, rows)."""
    guides = {f"guide.{name}": arm.guide for name, arm in env.arms.items()}
    own = {"memory": env.memory, "machine": env.machine, "perturbations": env.perturbations.buffers}
    return own | guides | env.task.stateful()


def saved_state(env: Any, simulator: dict[str, Any]) -> dict[str, Any]:
    """ManiSkill's state of simulator and controllers with the task's beside it, all tensors (n, ...)."""
    own: dict[str, dict[str, Tensor]] = {name: part.get_state() for name, part in remembered(env).items()}
    own["task"] = {"elapsed": env._elapsed_steps.clone(), "scale": env.scale.clone()}
    return simulator | {name: {k: v.flatten(min(1, v.ndim - 1)) for k, v in part.items()} for name, part in own.items()}


def restore(env: Any, state: dict, rows: Tensor) -> None:
    """Inverse of `saved_state` for the environments `rows` (b,), whose simulator has been restored: controllers and,
    if it holds them, the task's parts."""
    if "controller" in state:
        for k, arm in enumerate(env.arms.values()):
            if arm.agent.commands_wrist:
                own = state["controller"] if len(env.arms) == 1 else state["controller"][f"{arm.agent.uid}-{k}"]
                arm.agent.wrist_controller.restore(own["target"], rows)
    if "task" in state:
        env._elapsed_steps[rows] = state["task"]["elapsed"].reshape(-1).to(env._elapsed_steps.dtype)
        for name, part in remembered(env).items():
            part.set_state(state[name], rows)
        env.task_scene.apply_properties(env.memory, rows)


def resize(env: Any, state: dict, rows: Tensor) -> None:
    """Builds the scene anew if the objects of a state have other sizes than those in the environments `rows`; keeps
    everybody's state."""
    if "task" not in state:
        return
    scale = state["task"]["scale"].reshape(len(rows), -1)
    if torch.equal(env.scale[rows], scale):
        return
    keep = env.get_state_dict()
    sizes = env.scale.clone()
    sizes[rows] = scale
    env.rebuild(sizes)
    keep["task"]["scale"] = sizes
    env.set_state_dict(keep)
