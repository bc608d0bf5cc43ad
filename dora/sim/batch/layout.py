"""Layout of the tables: the rows of bodies and articulations, and the indices of their values in the packed state."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from sapien import physx

from dora.sim.batch.packed import POSE_FLOATS, POSE_ORDER, RIGID_FLOATS, PackedSource

BODY_COLUMNS = 13
"""Number of columns of a body: position [m], quaternion wxyz, linear [m/s], angular velocity [rad/s]; world frame."""


@dataclass(frozen=True, eq=False)
class BodyRow:
    """One rigid body of one environment: that of an actor or a link of an articulation."""

    environment: int
    entity: sapien.Entity
    body: Any
    is_link: bool


@dataclass(frozen=True, eq=False)
class ArticulationRow:
    """One articulation of one environment."""

    environment: int
    articulation: physx.PhysxArticulation
    joints: tuple[physx.PhysxArticulationJoint, ...]
    dof: int


class Layout:
    """The rows of all bodies and articulations of a scene.

    Bodies of one ManiSkill struct have consecutive rows, first those of actors, then those of links. ``row_of`` and
    ``articulation_of`` give the row of a SAPIEN object by its ``id`` (the structs keep the objects alive).
    """

    def __init__(self, actors: Mapping[str, Any], articulations: Mapping[str, Any]):
        self.bodies: list[BodyRow] = []
        self.articulations: list[ArticulationRow] = []
        for actor in actors.values():
            if actor.px_body_type != "static":
                for env, entity, body in zip(actor._scene_idxs.tolist(), actor._objs, actor._bodies, strict=True):
                    self.bodies.append(BodyRow(env, entity, body, is_link=False))
        self.actor_rows = len(self.bodies)
        for articulation in articulations.values():
            environments = articulation._scene_idxs.tolist()
            for env, px_articulation in zip(environments, articulation._objs, strict=True):
                joints = tuple(px_articulation.active_joints)
                self.articulations.append(ArticulationRow(env, px_articulation, joints, px_articulation.dof))
            for link in articulation.links:
                for env, body in zip(environments, link._objs, strict=True):
                    self.bodies.append(BodyRow(env, body.entity, body, is_link=True))
        self.row_of = {id(row.body): i for i, row in enumerate(self.bodies)}
        self.articulation_of = {id(row.articulation): i for i, row in enumerate(self.articulations)}
        self.body_environment = np.array([row.environment for row in self.bodies], np.int64)
        self.articulation_environment = np.array([row.environment for row in self.articulations], np.int64)
        self.max_dof = max((row.dof for row in self.articulations), default=0)
        self.max_links = max((len(row.articulation.links) for row in self.articulations), default=0)


def pose_index(layout: Layout, scenes: list[sapien.Scene], poses: PackedSource) -> np.ndarray:
    """(bodies, 7) indices into ``poses.flat()`` of each body's position and quaternion."""
    position = [{id(entity): i for i, entity in enumerate(scene.entities)} for scene in scenes]
    starts = poses.starts()
    first = [starts[row.environment] + POSE_FLOATS * position[row.environment][id(row.entity)] for row in layout.bodies]
    return np.array(first, np.int64).reshape(-1, 1) + POSE_ORDER


@dataclass(frozen=True, eq=False)
class StateIndex:
    """Indices into ``state.flat()``; entries without a value refer to the zero at its end.

    ``velocity`` (actor bodies, 6); ``qpos``, ``qvel``, ``target_qpos``, ``target_qvel`` (articulations, max dof).
    """

    velocity: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    target_qpos: np.ndarray
    target_qvel: np.ndarray


def state_index(layout: Layout, systems: list[physx.PhysxCpuSystem], state: PackedSource) -> StateIndex:
    """Indices of the values of all bodies and articulations in the result of `PhysxCpuSystem.pack`."""
    starts, padding = state.starts(), state.padding
    velocity = np.full((layout.actor_rows, 6), padding, np.int64)
    joint = np.full((4, len(layout.articulations), layout.max_dof), padding, np.int64)
    for system, start in zip(systems, starts.tolist(), strict=True):
        offset = start
        for body in system.rigid_dynamic_components:
            row = layout.row_of.get(id(body))
            if row is not None:
                velocity[row] = np.arange(offset + POSE_FLOATS, offset + RIGID_FLOATS)
            offset += RIGID_FLOATS
        for link in system.articulation_link_components:
            if not link.is_root:
                continue
            articulation, offset = link.articulation, offset + RIGID_FLOATS
            dof = articulation.dof
            row = layout.articulation_of.get(id(articulation))
            if row is not None:
                joint[0, row, :dof] = offset + np.arange(dof)
                joint[1, row, :dof] = offset + dof + np.arange(dof)
                joint[2, row, :dof] = offset + 2 * dof + 2 * np.arange(dof)
                joint[3, row, :dof] = joint[2, row, :dof] + 1
            offset += 4 * dof
    return StateIndex(velocity, *joint)


def check_packing(layout: Layout, poses: np.ndarray, state: np.ndarray, index: StateIndex) -> None:
    """Compare packed values with those of the getters.

    Args:
        layout: the rows of the tables.
        poses: (bodies, 7) position [m] and quaternion read from the packed poses.
        state: the packed state, flat.
        index: indices of the values in ``state``.

    Raises:
        RuntimeError: the installed SAPIEN packs its state in an unknown order.
    """
    for row, pose in zip(layout.bodies, poses, strict=True):
        now = row.entity.pose
        _require(np.array_equal(pose, [*now.p, *now.q]), "poses of entities")
    for row, where in zip(layout.bodies, index.velocity, strict=False):
        now = [*row.body.linear_velocity, *row.body.angular_velocity]
        _require(np.array_equal(state[where], now), "velocities of bodies")
    for i, row in enumerate(layout.articulations):
        _require(np.array_equal(state[index.qpos[i, : row.dof]], row.articulation.qpos), "joint positions")
        _require(np.array_equal(state[index.qvel[i, : row.dof]], row.articulation.qvel), "joint velocities")
        targets = [np.ravel(joint.drive_target)[0] for joint in row.joints]
        _require(np.array_equal(state[index.target_qpos[i, : row.dof]], targets), "drive targets")


def _require(equal: bool, what: str) -> None:
    if not equal:
        raise RuntimeError(f"SAPIEN {sapien.__version__} packs the {what} in an unknown order")
