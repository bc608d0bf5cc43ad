"""Bindings of the tables of a batch system to SAPIEN's getters and setters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import sapien
from sapien.physx import PhysxArticulation as Articulation

from dora.sim.batch.layout import BODY_COLUMNS, BodyRow
from dora.sim.batch.packed import POSE_FLOATS, GetterSource, Source
from dora.sim.batch.table import BlockWriter, Part, Table

if TYPE_CHECKING:
    from dora.sim.batch.system import BatchSystem

POSE = slice(0, POSE_FLOATS)
"""Columns of a body's row with its pose."""
LINEAR = slice(POSE_FLOATS, POSE_FLOATS + 3)
"""Columns of a body's row with its linear velocity."""
ANGULAR = slice(POSE_FLOATS + 3, BODY_COLUMNS)
"""Columns of a body's row with its angular velocity."""
_AXES = 3
"""Number of components of a vector."""
_SPATIAL_FORCE = 6
"""Number of components of an incoming joint force: force [N] and torque [N m]."""

Located = tuple[Source, np.ndarray]
"""A source of values and indices into its flat array."""
Setter = Callable[[np.ndarray], None]
"""Function that sets one quantity of one body."""


def make_tables(system: BatchSystem) -> dict[str, Table]:
    """All tables of a system by their names in `PhysxGpuSystem`.

    Rows of ``cuda_rigid_body_*`` are bodies, those of all other tables articulations; columns beyond an articulation's
    degrees of freedom read as 0 and ignore writes. Forces [N] and torques [N m] act in the next physics step and
    cannot be read.
    """
    links = (len(system.layout.articulations), system.layout.max_links, _SPATIAL_FORCE)
    return {
        "cuda_rigid_body_data": _body_table(system),
        "cuda_rigid_body_force": _push_table(system, _push),
        "cuda_rigid_body_torque": _push_table(system, _twist),
        "cuda_articulation_qpos": _packed_joint_table(system, "qpos", Articulation.set_qpos),
        "cuda_articulation_qvel": _packed_joint_table(system, "qvel", Articulation.set_qvel),
        "cuda_articulation_qacc": _joint_table(system, Articulation.get_qacc, Articulation.set_qacc),
        "cuda_articulation_qf": _joint_table(system, Articulation.get_qf, Articulation.set_qf),
        "cuda_articulation_target_qpos": _target_table(system, "target_qpos", "set_drive_target"),
        "cuda_articulation_target_qvel": _target_table(system, "target_qvel", "set_drive_velocity_target"),
        "cuda_articulation_link_incoming_joint_forces": Table(
            links,
            _getter_planner(system, Articulation.get_link_incoming_joint_forces, links[1:]),
            _refuse,
            system.stepper.refresh,
        ),
    }


def _refuse(*_: Any) -> Any:
    raise TypeError("this table can be either read or written, not both: see dora.sim.batch.bindings")


# ---- rigid bodies --------------------------------------------------------------------------------


def _body_table(system: BatchSystem) -> Table:
    rows = system.layout.bodies
    blocks = (
        (POSE, [_pose_setter(row) for row in rows]),
        (LINEAR, [_velocity_setter(row, "linear") for row in rows]),
        (ANGULAR, [_velocity_setter(row, "angular") for row in rows]),
    )
    shape = (len(rows), BODY_COLUMNS)
    plan = partial(_plan_bodies, system)
    writer = BlockWriter(BODY_COLUMNS, blocks, lambda elements: table.read(elements), system.writing_bodies)
    table = Table(shape, plan, writer, system.stepper.refresh)
    return table


def _plan_bodies(system: BatchSystem, elements: np.ndarray) -> list[Part]:
    """The parts of a read: poses and velocities of actors from the packed state, velocities of links from getters."""
    is_pose = elements % BODY_COLUMNS < POSE_FLOATS
    is_link = elements // BODY_COLUMNS >= system.layout.actor_rows
    choices = (
        (is_pose, _locate_poses),
        (~is_pose & ~is_link, _locate_actor_velocities),
        (~is_pose & is_link, _locate_link_velocities),
    )
    parts = []
    for chosen, locate in choices:
        if chosen.all():
            return [Part(*locate(system, elements))]
        if chosen.any():
            parts.append(Part(*locate(system, elements[chosen]), where=np.flatnonzero(chosen)))
    return parts


def _locate_poses(system: BatchSystem, elements: np.ndarray) -> Located:
    rows, columns = np.divmod(elements, BODY_COLUMNS)
    return system.stepper.poses, system.pose_index[rows, columns]


def _locate_actor_velocities(system: BatchSystem, elements: np.ndarray) -> Located:
    rows, columns = np.divmod(elements, BODY_COLUMNS)
    return system.stepper.state, system.state_index.velocity[rows, columns - POSE_FLOATS]


def _locate_link_velocities(system: BatchSystem, elements: np.ndarray) -> Located:
    rows, columns = np.divmod(elements, BODY_COLUMNS)
    kind, axis = np.divmod(columns - POSE_FLOATS, _AXES)
    vectors, vector_of = np.unique(rows * 2 + kind, return_inverse=True)
    bodies = system.layout.bodies
    getters = [
        bodies[vector // 2].body.get_angular_velocity if vector % 2 else bodies[vector // 2].body.get_linear_velocity
        for vector in vectors.tolist()
    ]
    return GetterSource(getters, system.stepper.epoch), vector_of.reshape(elements.shape) * _AXES + axis


def _pose_setter(row: BodyRow) -> Setter:
    """Setter of a pose; that of a link, as in ManiSkill, moves the articulation if the link is its root."""
    return partial(_set_pose, row.body.set_entity_pose if row.is_link else row.entity.set_pose)


def _set_pose(setter: Callable[[sapien.Pose], None], pose: Any) -> None:
    setter(sapien.Pose(pose[:_AXES], pose[_AXES:]))


def _velocity_setter(row: BodyRow, kind: str) -> Setter | None:
    """Setter of a velocity; None for kinematic bodies and for links other than roots, which have no such state."""
    if not row.is_link:
        return None if row.body.kinematic else getattr(row.body, f"set_{kind}_velocity")
    return getattr(row.body.articulation, f"set_root_{kind}_velocity") if row.body.is_root else None


def _push_table(system: BatchSystem, push: Callable[[Any, np.ndarray], None]) -> Table:
    bodies = system.layout.bodies
    block = (slice(0, _AXES), [partial(push, row.body) for row in bodies])
    writer = BlockWriter(_AXES, (block,), _refuse, system.writing_bodies)
    return Table((len(bodies), _AXES), _refuse, writer, system.stepper.refresh)


def _push(body: Any, force: np.ndarray) -> None:
    body.add_force_at_point(force, (body.entity_pose * body.cmass_local_pose).p)


def _twist(body: Any, torque: np.ndarray) -> None:
    body.add_force_torque(np.zeros(_AXES, np.float32), torque)


# ---- articulations -------------------------------------------------------------------------------


def _joint_writer(system: BatchSystem, setter: Callable, read: Callable[[np.ndarray], np.ndarray]) -> BlockWriter:
    layout = system.layout
    setters = [partial(_set_joints, setter, row.articulation, row.dof) for row in layout.articulations]
    return BlockWriter(layout.max_dof, ((slice(0, layout.max_dof), setters),), read, system.writing_articulations)


def _set_joints(setter: Callable, articulation: Articulation, dof: int, values: np.ndarray) -> None:
    setter(articulation, values[:dof])


def _packed_joint_table(system: BatchSystem, quantity: str, setter: Callable) -> Table:
    shape = (len(system.layout.articulations), system.layout.max_dof)
    writer = _joint_writer(system, setter, lambda elements: table.read(elements))
    table = Table(shape, _state_planner(system, quantity), writer, system.stepper.refresh)
    return table


def _joint_table(system: BatchSystem, getter: Callable, setter: Callable) -> Table:
    shape = (len(system.layout.articulations), system.layout.max_dof)
    writer = _joint_writer(system, setter, lambda elements: table.read(elements))
    table = Table(shape, _getter_planner(system, getter, shape[1:]), writer, system.stepper.refresh)
    return table


def _target_table(system: BatchSystem, quantity: str, setter: str) -> Table:
    layout = system.layout
    setters: list[Callable[[float], None]] = []
    for row in layout.articulations:
        setters += [getattr(joint, setter) for joint in row.joints]
        setters += [_ignore] * (layout.max_dof - row.dof)

    def write(elements: np.ndarray, values: np.ndarray) -> None:
        numbers = elements.ravel()
        environments = layout.articulation_environment[numbers // layout.max_dof]
        stepper.set_targets(setters, numbers, values.ravel(), environments)

    stepper = system.stepper
    shape = (len(layout.articulations), layout.max_dof)
    return Table(shape, _state_planner(system, quantity), write, stepper.refresh_targets)


def _ignore(_: float) -> None:
    """Setter of a column that an articulation with fewer joints does not have."""


def _state_planner(system: BatchSystem, quantity: str) -> Callable[[np.ndarray], Sequence[Part]]:
    def plan(elements: np.ndarray) -> list[Part]:
        return [Part(system.stepper.state, getattr(system.state_index, quantity).ravel()[elements])]

    return plan


def _getter_planner(
    system: BatchSystem, getter: Callable[[Articulation], np.ndarray], row_shape: tuple[int, ...]
) -> Callable[[np.ndarray], Sequence[Part]]:
    """Planner for a quantity with one getter per articulation, whose result may be shorter than a row."""
    rows = system.layout.articulations
    lengths = [getter(row.articulation).size for row in rows]
    width = int(np.prod(row_shape))
    index = np.full((len(rows), width), sum(lengths), np.int64)
    for row, (length, start) in enumerate(zip(lengths, np.cumsum([0, *lengths]).tolist(), strict=False)):
        index[row, :length] = np.arange(start, start + length)
    source = GetterSource([partial(getter, row.articulation) for row in rows], system.stepper.epoch)
    return lambda elements: [Part(source, index.ravel()[elements])]
