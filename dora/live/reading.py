"""Reads what a page shows from a running environment: what stays, and the state after each control step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from dora.live.state import Forces, Goal, History, Poses, Setup
from dora.sim.substeps import watch_physics
from dora.tasks.env.env import DoraEnv
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.memory import MM
from dora.tasks.mdp.stages import Stage, Stages

REWARD = "reward/"
"""What the names of a reward's terms begin with in the info of a step."""
SMALLEST = 1e-3
"""Contact force below which none is shown [N]."""


def read_setup(env: DoraEnv, env_id: str) -> Setup:
    """What stays the same while an environment lives."""
    starts, alone = env.task.starts(), len(env.arms) == 1
    candidates = env.guide.choice.candidates if alone else None
    return Setup(
        env_id=env_id,
        robots={name: arm.agent.description for name, arm in env.arms.items()},
        handles={name: arm.spec.object for name, arm in env.arms.items()},
        objects=tuple(env.objects),
        fixtures={name: shapes for name, (_, shapes) in env.task.drawn(env.task_scene).items()},
        ladders=tuple(tuple(stage.name for stage in ladder) for ladder in ladders(env.mdp)),
        terms=tuple(env.terms.terms),
        limit=env.mdp.penetration_limit * MM,
        dt=env.config.dt,
        max_steps=env.max_steps,
        camera=env.task.CAMERA,
        numbers=starts.numbers if starts is not None else (),
        candidates=tuple(map(_words, range(len(candidates)), candidates.grasp_class, candidates.score.tolist()))
        if candidates is not None
        else (),
    )


def ladders(mdp: Mdp[Any]) -> list[Sequence[Stage[Any]]]:
    """The stages of a task, in order; of each arm if they have stages of their own."""
    return list(mdp.stages.values()) if isinstance(mdp.stages, Mapping) else [mdp.stages]


def active_stages(machine: Stages) -> tuple[int, ...]:
    """Index of the active stage of each of `ladders` in the first environment."""
    return tuple(int(index[0]) for index in machine.by_arm().values()) or (int(machine.index[0]),)


def _words(index: int, grasp_class: str, score: float) -> str:
    """A word about a candidate."""
    return f"{index}: {grasp_class}" + (f", {100 * score:.0f} %" if np.isfinite(score) else "")


class Reader:
    """Reads the bodies of a built scene; make a new one when it is built anew.

    Args:
        env: of one environment.

    Attributes:
        scene: that is read.
        scales: sizes of the objects relative to their nominal ones.
    """

    def __init__(self, env: DoraEnv):
        self.scene, self._env = env.task_scene, env
        env.task_scene.reader.keep_points()
        links = {(name, link.name): link for name, arm in env.arms.items() for link in arm.agent.robot.links}
        fixtures = {name: body for name, (body, _) in env.task.drawn(env.task_scene).items()}
        self._links, self._objects, self._fixtures = map(_bodies, (links, dict(env.objects), fixtures))
        self.scales = dict(zip(env.objects, env.scale[0].tolist(), strict=True))
        step = env.control_freq if env.task.CONTACT_EVERY_STEP else env.sim_freq
        self._frequency = float(step)
        self._passed: list[Poses] = []
        watch_physics(env.scene, lambda _: self._passed.append(Poses(**self.poses())))

    def poses(self) -> dict[str, dict[Any, Float[np.ndarray, " 7"]]]:
        """World poses of links, objects and fixtures."""
        groups = {"links": self._links, "objects": self._objects, "fixtures": self._fixtures}
        return {name: {key: _pose(body) for key, body in bodies.items()} for name, bodies in groups.items()}

    def passed(self) -> tuple[Poses, ...]:
        """Poses after each physics step since this was last called."""
        passed = tuple(self._passed)
        self._passed.clear()
        return passed

    def goals(self) -> dict[str, Goal]:
        """What the chosen candidates ask for at the true poses of the objects."""
        return {
            arm: Goal(wrist=torch.cat([goal.p[0], goal.q[0]]).numpy(), joints=goal.grasp[0].numpy())
            for arm, goal in self._env.snapshot.goals.items()
        }

    def forces(self) -> Forces:
        """The contacts of the last control step, added up for each pair of groups."""
        reader, pairs, points, forces = self.scene.reader, [], [], []
        contacts = reader.contacts
        if contacts is not None and contacts.point is not None:
            for one, other in reader.pairs:
                first, second = (reader.contact_names.index(name) for name in (one, other))
                force = contacts.impulse[0, first, second].numpy() * self._frequency
                if np.linalg.norm(force) > SMALLEST:
                    pairs.append((one, other))
                    points.append(contacts.point[0, first, second].numpy())
                    forces.append(force)
        return Forces(
            pairs=tuple(pairs),
            points=np.array(points, np.float32).reshape(-1, 3),
            forces=np.array(forces, np.float32).reshape(-1, 3),
        )


def _bodies(members: dict[Any, Any]) -> dict[Any, Any]:
    """SAPIEN's entity of the only environment of each actor or link."""
    return {key: member._bodies[0].entity for key, member in members.items()}


def _pose(entity: Any) -> Float[np.ndarray, " 7"]:
    pose = entity.pose
    return np.concatenate([pose.p, pose.q])


class EpisodeLog:
    """Rewards and overlap of an episode, step by step; what it has given away does not change any more.

    Args:
        setup: of the environment.
    """

    def __init__(self, setup: Setup):
        self._setup, self._count = setup, 0
        self._table = np.zeros((setup.max_steps + 1, 3 + len(setup.terms)), np.float32)

    def add(self, time: float, info: dict[str, Any]) -> None:
        """Takes down the info of a step, at a time of the episode [s]."""
        if self._count == len(self._table):  # a recording may be longer than an episode
            self._table = np.concatenate([self._table, np.zeros_like(self._table)])
        terms = [float(info.get(f"{REWARD}{name}", torch.zeros(1))[0]) for name in self._setup.terms]
        overlaps = [float(info[name][0]) for name in ("penetration_mm", "penetration_max_mm")]
        self._table[self._count] = [time, *overlaps, *terms]
        self._count += 1

    @property
    def history(self) -> History:
        """All steps so far."""
        rows = self._table[: self._count]
        return History(time=rows[:, 0], terms=rows[:, 3:], overlap=rows[:, 1:3])


def verdict(setup: Setup, stages: Sequence[int], failure: str, info: dict[str, Any], over: bool) -> str:
    """How an episode stands, or how it ended and why.

    Args:
        setup: of the environment.
        stages: the active one of each of its ladders.
        failure: what has happened in an episode that cannot be mended, in words.
        info: of the last step.
        over: the episode has ended.
    """
    flags = {name: bool(info[name][0]) for name in ("success", "raw_success", "fail", "unreachable")}
    max_penetration = float(info["penetration_max_mm"][0])
    overlap = f"an overlap of {max_penetration:.1f} mm, above the limit of {setup.limit:g} mm"
    if flags["unreachable"]:
        return "failed: no candidate can be reached from this start"
    if flags["fail"]:
        return f"failed: {failure}"
    if flags["success"]:
        return f"success: all stages done, largest overlap {max_penetration:.1f} mm"
    if max_penetration > setup.limit:
        return f"{'failed' if over else 'cannot succeed any more'}: {overlap}"
    if over:
        return f"failed: the time was over in the stage {' and '.join(_unfinished(setup, stages))}"
    return "under way"


def _unfinished(setup: Setup, stages: Sequence[int]) -> list[str]:
    """Active stages of the ladders that are not done, or the last ones where all were done before the others."""
    under_way = [repr(ladder[k]) for ladder, k in zip(setup.ladders, stages, strict=True) if k < len(ladder)]
    return under_way or [repr(ladder[-1]) for ladder in setup.ladders]
