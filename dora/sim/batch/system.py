"""N `PhysxCpuSystem`s behind the interface of one `PhysxGpuSystem`."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import numpy as np
import sapien
from sapien import physx

from dora.sim.batch.bindings import make_tables
from dora.sim.batch.layout import Layout, check_packing, pose_index, state_index
from dora.sim.batch.packed import PackedSource
from dora.sim.batch.queries import BodyImpulses, BodyPair, ContactImpulses, PairImpulses
from dora.sim.batch.table import Table
from dora.sim.profile import StepProfile

_NO_PROFILE = nullcontext()

class BatchSystem:
    """The physics of N environments, each in its own `PhysxCpuSystem`.

    It has the part of `PhysxGpuSystem`'s interface that ManiSkill uses, with other means: a table is read when it is
    indexed (`Table`), and a value written to it is in the simulator at once, through the same call that ManiSkill
    makes for a single environment on a CPU, in the same order. Hence the results are the same bit for bit, and
    all ``gpu_fetch_*`` and ``gpu_apply_*`` have nothing left to do.

    Steps may be deferred: see `defer`.
    """

    cuda_rigid_body_data: Table
    cuda_rigid_body_force: Table
    cuda_rigid_body_torque: Table
    cuda_articulation_qpos: Table
    cuda_articulation_qvel: Table
    cuda_articulation_qacc: Table
    cuda_articulation_qf: Table
    cuda_articulation_target_qpos: Table
    cuda_articulation_target_qvel: Table
    cuda_articulation_link_incoming_joint_forces: Table

    def __init__(self, scenes: Sequence[sapien.Scene]):
        self._scenes = list(scenes)
        self._systems: list[physx.PhysxCpuSystem] = [scene.physx_system for scene in scenes]
        self._steppers = [system.step for system in self._systems]
        self.poses = PackedSource([scene.pack_poses for scene in self._scenes])
        self.state = PackedSource([system.pack for system in self._systems])
        self._contacts = ContactImpulses([system.get_contacts for system in self._systems])
        self._epoch = 0
        self._steps_made = 0
        self._stale = True
        self._targets_stale = False
        self._pending = 0
        self._deferred = 1
        self.profile: StepProfile | None = None
        self.layout = Layout({}, {})
        self._tables: dict[str, Table] = {}

    @property
    def __class__(self) -> type:
        """`PhysxGpuSystem`, for ManiSkill's structs, which choose their buffers by ``isinstance``."""
        return physx.PhysxGpuSystem

    # ---- stepping ----------------------------------------------------------------------------------------------

    @property
    def timestep(self) -> float:
        """Duration of one physics step [s]."""
        return self._systems[0].timestep

    @timestep.setter
    def timestep(self, seconds: float) -> None:
        for system in self._systems:
            system.timestep = seconds

    def get_timestep(self) -> float:
        """Duration of one physics step [s]."""
        return self.timestep

    def set_timestep(self, seconds: float) -> None:
        """Set the duration of one physics step [s]."""
        self.timestep = seconds

    def defer(self, steps: int) -> None:
        """Allow up to ``steps`` steps to wait until a value is read or written, or until that many have come.

        Then each environment makes all its waiting steps in a row, which is kinder to the processor's caches than
        going round all environments at every step. Results do not depend on it. While steps wait, sapien objects
        must not be used directly; `defer(1)` (the default) makes every step at once.
        """
        self._deferred = steps
        if self._pending >= steps:
            self.flush()

    def step(self) -> None:
        """Advance every environment by one time step."""
        self._pending += 1
        self._epoch += 1
        self._stale = True
        self.poses.invalidate_all()
        self.state.invalidate_all()
        if self._pending >= self._deferred:
            self.flush()

    def flush(self) -> None:
        """Make the steps that still wait."""
        if not self._pending:
            return
        steps, self._pending = range(self._pending), 0
        self._steps_made += len(steps)
        with self._measure("physics"):
            for step in self._steppers:
                for _ in steps:
                    step()

    def refresh(self) -> None:
        """Make waiting steps and read what is out of date; called by every table before a read."""
        if not self._stale:
            return
        self.flush()
        with self._measure("read"):
            resized = self.poses.refresh(), self.state.refresh()
        self._stale = False
        if any(resized):
            self._find_values()

    def refresh_targets(self) -> None:
        """`refresh` for drive targets. Writing targets leaves all other values of the packed state as they were."""
        if self._targets_stale:
            self.state.invalidate_all()
            self._stale, self._targets_stale = True, False
        self.refresh()

    def invalidate(self) -> None:
        """Declare everything read so far out of date, after sapien objects were changed directly."""
        self._changed(range(len(self._systems)))

    def _changed(self, environments: Iterable[int]) -> None:
        self._epoch += 1
        self._stale = True
        self.poses.invalidate(environments)
        self.state.invalidate(environments)

    def _measure(self, part: str) -> AbstractContextManager[None]:
        return _NO_PROFILE if self.profile is None else self.profile.measure(part)

    @contextmanager
    def writing_bodies(self, rows: np.ndarray) -> Iterator[None]:
        self.flush()
        with self._measure("write"):
            yield
        self._changed(self.layout.body_environment[rows].tolist())

    @contextmanager
    def writing_articulations(self, rows: np.ndarray) -> Iterator[None]:
        self.flush()
        with self._measure("write"):
            yield
        self._changed(self.layout.articulation_environment[rows].tolist())

    @contextmanager
    def writing_targets(self, rows: np.ndarray) -> Iterator[None]:
        self.flush()
        with self._measure("write"):
            yield
        self._targets_stale = True

    def epoch(self) -> int:
        """A number that changes whenever anything may have changed in the simulator."""
        return self._epoch

    # ---- tables ------------------------------------------------------------------------------------------------

    def build(self, actors: Mapping[str, Any], articulations: Mapping[str, Any]) -> None:
        """Number the bodies and articulations of a finished scene and make its tables.

        Args:
            actors: ManiSkill actors by name; static ones get no rows.
            articulations: ManiSkill articulations by name.

        Raises:
            RuntimeError: if this version of SAPIEN packs its state in an unknown order.
        """
        self.layout = Layout(actors, articulations)
        self.refresh()
        self._find_values()
        body_poses = self.poses.flat().take(self.pose_index)
        check_packing(self.layout, body_poses, self.state.flat(), self.state_index)
        self._tables = make_tables(self)
        self.__dict__.update(self._tables)

    def _find_values(self) -> None:
        """Locate all values anew: the packed state has another length now, as after a camera was added."""
        self.pose_index = pose_index(self.layout, self._scenes, self.poses)
        self.state_index = state_index(self.layout, self._systems, self.state)
        for table in self._tables.values():
            table.forget_plans()

    def body_rows(self, bodies: Sequence[Any]) -> list[int]:
        """Rows of sapien bodies in ``cuda_rigid_body_data``."""
        return [self.layout.row_of[id(body)] for body in bodies]

    def articulation_rows(self, articulations: Sequence[Any]) -> list[int]:
        """Rows of sapien articulations in the ``cuda_articulation_*`` tables."""
        return [self.layout.articulation_of[id(articulation)] for articulation in articulations]

    # ---- nothing to do -----------------------------------------------------------------------------------------

    def _done_already(self) -> None:
        """Writes are in the simulator when they are made, reads are made when they are asked for."""

    gpu_init = _done_already
    gpu_apply_rigid_dynamic_data = gpu_fetch_rigid_dynamic_data = _done_already
    gpu_apply_rigid_dynamic_force = gpu_apply_rigid_dynamic_torque = _done_already
    gpu_apply_articulation_qpos = gpu_fetch_articulation_qpos = _done_already
    gpu_apply_articulation_qvel = gpu_fetch_articulation_qvel = _done_already
    gpu_apply_articulation_qf = gpu_fetch_articulation_qacc = _done_already
    gpu_apply_articulation_root_pose = gpu_fetch_articulation_link_pose = _done_already
    gpu_apply_articulation_root_velocity = gpu_fetch_articulation_link_velocity = _done_already
    gpu_apply_articulation_target_position = gpu_fetch_articulation_target_qpos = _done_already
    gpu_apply_articulation_target_velocity = gpu_fetch_articulation_target_qvel = _done_already
    gpu_fetch_articulation_link_incoming_joint_forces = _done_already
    gpu_update_articulation_kinematics = _done_already

    def sync_poses_gpu_to_cpu(self) -> None:
        """Make waiting steps, so that sapien objects may be used directly (to render them, for example)."""
        self.flush()

    # ---- contacts ----------------------------------------------------------------------------------------------

    def get_contacts(self) -> list[physx.PhysxContact]:
        """Contacts of all environments in the last step. Do not keep them: the next step frees them."""
        self.flush()
        return [contact for system in self._systems for contact in system.get_contacts()]

    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for the impulses on the first body of each pair by the second."""
        return self._contacts.pairs(body_pairs)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return self._contacts.bodies(bodies)

    def gpu_query_contact_pair_impulses(self, query: PairImpulses) -> None:
        """Bring ``query.cuda_impulses`` up to date; N s, shape (pairs, 3)."""
        self.flush()
        with self._measure("contacts"):
            self._contacts.answer(query, self._steps_made)

    def gpu_query_contact_body_impulses(self, query: BodyImpulses) -> None:
        """Bring ``query.cuda_impulses`` up to date; N s, shape (bodies, 3)."""
        self.gpu_query_contact_pair_impulses(query)

    # ---- other things of the systems ---------------------------------------------------------------------------

    @property
    def systems(self) -> list[physx.PhysxCpuSystem]:
        """The systems of the environments, with no step waiting."""
        self.flush()
        return self._systems

    @property
    def rigid_dynamic_components(self) -> list[physx.PhysxRigidDynamicComponent]:
        """Dynamic and kinematic bodies of all environments."""
        return [body for system in self._systems for body in system.rigid_dynamic_components]

    @property
    def rigid_static_components(self) -> list[physx.PhysxRigidStaticComponent]:
        """Static bodies of all environments."""
        return [body for system in self._systems for body in system.rigid_static_components]

    @property
    def articulation_link_components(self) -> list[physx.PhysxArticulationLinkComponent]:
        """Links of all environments."""
        return [link for system in self._systems for link in system.articulation_link_components]

    def get_scene_offset(self, scene: sapien.Scene) -> np.ndarray:
        """Zero: every environment has its own world. Shape (3,), m."""
        return np.zeros(3, np.float32)
