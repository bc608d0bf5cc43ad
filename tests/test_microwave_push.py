"""A hand that is pushed into the shut door of the microwave at full speed goes neither through it nor deep into it."""

from typing import Any

import numpy as np
import pytest
import torch
from solids import PairWatch
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
"""Full actions of the right wrist's translation; those of the left one are their mirror images."""
CASES = [(hand, push) for hand in HANDS for push in PUSHES]
SETTLE, PUSH = 90, 60
"""Control steps before and during the push."""
OVEN = ("door", "body", "handle")
"""Names of the bodies of the microwave."""
MAX_PENETRATION = 4.0
"""Largest overlap of the robot with each of them that is allowed [mm]."""
STEADY, PEAK = {RIGHT: 330.0, LEFT: 680.0}, 1200.0
"""Largest mean force of all links on them at the end of a push by each hand, and force in any physics step [N]."""
STEADY_STEPS = 10
"""Control steps at the end over which that mean is taken."""


def orientation(fingers: tuple[float, ...], palm: tuple[float, ...], mirror: Tensor) -> Tensor:
    """Wrist orientation (4,) with fingers along z and the palm along x of the hand, for directions times `mirror`."""
    f = torch.nn.functional.normalize(torch.tensor(fingers) * mirror, dim=0)
    p = torch.tensor(palm) * mirror
    p = torch.nn.functional.normalize(p - f * (p @ f), dim=0)
    return quaternion_from_matrix(torch.stack([p, torch.linalg.cross(f, p), f], 1)[None])[0]


@pytest.mark.slow
@pytest.mark.parametrize("side", [RIGHT, LEFT])
def test_a_hand_that_is_pushed_into_the_door_stops_at_it(side: str):
    n, mirror = len(CASES), torch.tensor([1.0, 1.0 if side == RIGHT else -1.0, 1.0])
    task = tasks.make_task("DoraMicrowave-v1", n, guidance="none", preset="none")
    task.reset(seed=0)
    pushing, other = task.arms[side], task.arms[LEFT if side == RIGHT else RIGHT]
    hands = [HANDS[hand] for hand, _ in CASES]
    turn = torch.stack([orientation(fingers, palm, mirror) for fingers, palm, *_ in hands])
    postures = pushing.agent.description.postures
    posture = torch.tensor(np.stack([postures[name].hand for *_, name, _ in hands]), dtype=torch.float32)
    push = torch.tensor([PUSHES[name] for _, name in CASES])
    start = before_the_door(push, torch.tensor([hand[3] for hand in hands])) * mirror
    still = torch.zeros(n, other.action_size)
    still[:, 6:] = other.agent.wrist_controller.hand_action(
        torch.tensor(other.posture.hand, dtype=torch.float32).expand(n, -1)
    )
    hand = pushing.agent.wrist_controller.hand_action(posture)
    groups = {"robot": list(pushing.agent.robot.links), **{name: [task.task.oven.links[name]] for name in OVEN}}
    watch = PairWatch(task.scene, groups, [("robot", name) for name in OVEN], geometry=False)
    for k in range(SETTLE + PUSH):
        if k < SETTLE:
            action = pushing._encoded(Target(start, turn, posture))
        else:
            action = torch.cat([push * mirror, torch.zeros(n, 3), hand], -1)
        task.step(torch.cat([still, action] if side == RIGHT else [action, still], -1))
        if k == SETTLE - 1:
            watch.clear()
        elif k == SETTLE + PUSH - STEADY_STEPS - 1:
            watch.impulse[:] = 0.0
    peak, steady = watch.force, np.linalg.norm(watch.impulse, axis=-1) / (STEADY_STEPS * task.config.dt)
    report(side, 1000 * watch.reported, peak, steady)
    end: Any = task.snapshot
    wrist = end.wrists[:, list(task.arms).index(side)]
    assert (1000 * watch.reported).max() <= MAX_PENETRATION
    assert steady.max() <= STEADY[side]
    assert peak.max() <= PEAK
    assert (in_oven(end, wrist)[end.door < 0.1, 0] < 0).all()
    task.close()


def before_the_door(push: Tensor, reach: Tensor) -> Tensor:
    """Where the right wrist begins to push (n, 3) [m], for pushes (n, 3) and how far hands reach ahead (n,) [m]."""
    y = torch.where(push[:, 1] > 0, -0.05, 0.03)
    z = torch.where(push[:, 2] < 0, 0.34, 0.24)
    return torch.stack([0.70 - 0.07 - reach - 0.12, y, z], -1)


def report(side: str, overlap: np.ndarray, peak: np.ndarray, steady: np.ndarray) -> None:
    """Prints overlap (cases, bodies) [mm] and forces (cases,) [N]."""
    for (name, way), depths, most, kept in zip(CASES, overlap, peak, steady, strict=True):
        bodies = ", ".join(f"{body} {depth:.1f} mm" for body, depth in zip(OVEN, depths, strict=True))
        print(f"{side}, {name}, {way}: {bodies}; {most:.0f} N, then {kept:.0f} N")
    print(f"{side}: up to {overlap.max():.1f} mm, median {np.median(overlap.max(1)):.1f} mm")
    for what, values in (("peak", peak), ("steady", steady)):
        print(f"{side}: {what} force {values.min():.0f} to {values.max():.0f} N, median {np.median(values):.0f} N")
