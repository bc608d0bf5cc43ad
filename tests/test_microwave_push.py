"""A hand that is pushed into the shut door of the microwave at full speed goes neither through it nor deep into it."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import dora.tasks as tasks
from dora.geometry.rotations import quaternion_from_matrix
from dora.tasks.guidance.residual_action import Target
from dora.tasks.microwave.snapshot import LEFT, RIGHT, in_oven

HANDS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], str, float]] = {
    "fingers ahead, straight": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), "open", 0.22),
    "fingers ahead, bent": ((1.0, 0.0, -0.3), (0.0, 0.0, -1.0), "home", 0.22),
    "fist ahead": ((1.0, 0.0, -0.2), (0.0, 0.0, -1.0), "fist", 0.16),
    "palm ahead, fingers up": ((0.1, 0.0, 1.0), (1.0, 0.0, 0.0), "open", 0.14),
    "back of the fist": ((0.6, 0.0, -0.8), (-0.8, 0.0, -0.6), "fist", 0.20),
    "on its side": ((1.0, -0.2, 0.0), (0.0, 1.0, 0.0), "home", 0.20),
}
"""Directions of the fingers and of the palm in the world, posture of the hand, and how far it reaches ahead [m]."""
PUSHES = {"x": (1.0, 0.0, 0.0), "xy": (1.0, 1.0, 0.0), "xz": (1.0, 0.0, -1.0)}
"""Full actions of the wrist's translation."""
CASES = [(hand, push) for hand in HANDS for push in PUSHES]
SETTLE, PUSH = 90, 60
"""Control steps before and during the push."""
OVEN = {"door", "body", "handle"}
"""Names of the bodies of the microwave."""
DEEPEST = 4.0
"""Largest overlap of the hand with them that is allowed [mm]."""
STRONGEST = 250.0
"""Largest force on them while the hand pushes steadily [N]; the drives' own limits would allow 500 to 1,700."""


def orientation(fingers: tuple[float, ...], palm: tuple[float, ...]) -> Tensor:
    """Wrist orientation (4,) with fingers along z and the palm along x of the hand."""
    f = torch.nn.functional.normalize(torch.tensor(fingers), dim=0)
    p = torch.tensor(palm)
    p = torch.nn.functional.normalize(p - f * (p @ f), dim=0)
    return quaternion_from_matrix(torch.stack([p, torch.linalg.cross(f, p), f], 1)[None])[0]


@pytest.mark.slow
def test_a_hand_that_is_pushed_into_the_door_stops_at_it():
    n = len(CASES)
    task = tasks.make_task("DoraMicrowave-v1", n, guidance="none", preset="none")
    task.reset(seed=0)
    right, left = task.arms[RIGHT], task.arms[LEFT]
    hands = [HANDS[hand] for hand, _ in CASES]
    turn = torch.stack([orientation(fingers, palm) for fingers, palm, *_ in hands])
    postures = right.agent.description.postures
    posture = torch.tensor(np.stack([postures[name].hand for *_, name, _ in hands]), dtype=torch.float32)
    push = torch.tensor([PUSHES[name] for _, name in CASES])
    reach = torch.tensor([hand[3] for hand in hands])
    start = torch.stack(
        [
            0.70 - 0.07 - reach - 0.12,
            torch.where(push[:, 1] > 0, -0.05, 0.03),
            torch.where(push[:, 2] < 0, 0.34, 0.24),
        ],
        -1,
    )
    still = torch.zeros(n, left.action_size)
    still[:, 6:] = left.agent.wrist_controller.hand_action(
        torch.tensor(left.posture.hand, dtype=torch.float32).expand(n, -1)
    )
    hand = right.agent.wrist_controller.hand_action(posture)
    deepest, force = torch.zeros(n), torch.zeros(n)
    for k in range(SETTLE + PUSH):
        if k < SETTLE:
            action = right._encoded(Target(start, turn, posture))
        else:
            action = torch.cat([push, torch.zeros(n, 3), hand], -1)
        *_, info = task.step(torch.cat([still, action], -1))
        if k >= SETTLE:
            pairs = [task.task_scene.reader.overlap.deepest_pair(i) or () for i in range(n)]
            at_door = torch.tensor([bool(OVEN & set(pair)) for pair in pairs])
            deepest = torch.maximum(deepest, info["penetration_mm"] * at_door)
        if k >= SETTLE + PUSH - 10:
            contacts, names = task.task_scene.reader.contacts, task.task_scene.reader.contact_names
            assert contacts is not None
            rows = [names.index(name) for name in names if name.startswith(RIGHT)]
            pressed = contacts.impulse[:, rows, names.index("world")].sum(1).norm(dim=-1) * task.sim_freq
            force = torch.maximum(force, pressed)
    end: Any = task.snapshot
    door, beyond = end.door, in_oven(end, end.wrists[:, 1])[:, 0]
    for (name, way), deep, newtons in zip(CASES, deepest.tolist(), force.tolist(), strict=True):
        print(f"{name}, {way}: {deep:.1f} mm, {newtons:.0f} N")
    assert deepest.max() <= DEEPEST
    assert force.max() <= STRONGEST
    assert (beyond[door < 0.1] < 0).all()
    task.close()
