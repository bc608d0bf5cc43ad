"""N `PhysxCpuSystem`s behind the interface of one `PhysxGpuSystem`."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
from sapien import physx

from dora.sim.batch.bindings import make_tables
from dora.sim.batch.layout import Layout, check_packing, pose_index, state_index
from dora.sim.batch.profile import StepProfile
from dora.sim.batch.queries import BodyImpulses, BodyPair, PairImpulses
from dora.sim.batch.stepping import Stepper
from dora.sim.batch.table import Table


class BatchSystem:
    """The physics of N environments, each in its own `PhysxCpuSystem`.

    It has the part of `PhysxGpuSystem`'s interface that ManiSkill uses, with other means: a table is read
    when it is indexed (`Table`), and a value written to it is in the simulator at once, through the same
    call that ManiSkill makes for a single environment on a CPU, in the same order. Hence the results are
    the same bit for bit, and all ``gpu_fetch_*`` and ``gpu_apply_*`` have nothing left to do.

    Within a control step, drive targets and physics steps wait for each other: see `Stepper`.
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
        self._systems: list[Any] = [scene.physx_system for scene in scenes]
        self.stepper = Stepper(scenes)
        self.stepper.resized = self._find_values
        self.layout = Layout({}, {})
        self._tables: dict[str, Table] = {}

    @property
    def __class__(self) -> type:
        """`PhysxGpuSystem`, for ManiSkill's structs, which choose their buffers by ``isinstance``."""
        return physx.PhysxGpuSystem

    # ---- stepping --------------------------------------------------------------------------------

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

    @property
    def profile(self) -> StepProfile | None:
        """Where times are added up, or None to measure nothing."""
        return self.stepper.profile

    @profile.setter
    def profile(self, profile: StepProfile | None) -> None:
        self.stepper.profile = profile

    def step(self) -> None:
        """Advance every environment by one time step."""
        self.stepper.step()

    def defer(self, steps: int) -> None:
        """Let up to ``steps`` steps wait, see `Stepper.defer`; ``defer(0)`` makes up for them."""
        self.stepper.defer(steps)

    def flush(self) -> None:
        """Do what waits, so that sapien objects may be used directly."""
        self.stepper.flush()

    def invalidate(self) -> None:
        """Declare everything read so far out of date, after sapien objects were changed directly."""
        self.stepper.changed(range(len(self._systems)))

    # ---- tables ----------------------------------------------------------------------------------

    def build(self, actors: Mapping[str, Any], articulations: Mapping[str, Any]) -> None:
        """Number the bodies and articulations of a finished scene and make its tables.

        Args:
            actors: ManiSkill actors by name; static ones get no rows.
            articulations: ManiSkill articulations by name.

        Raises:
            RuntimeError: if this version of SAPIEN packs its state in an unknown order.
        """
        self.layout = Layout(actors, articulations)
        self.stepper.refresh()
        self._find_values()
        body_poses = self.stepper.poses.flat().take(self.pose_index)
        check_packing(self.layout, body_poses, self.stepper.state.flat(), self.state_index)
        self._tables = make_tables(self)
        self.__dict__.update(self._tables)

    def _find_values(self) -> None:
        """Locate all values anew: the packed state has another length now, as after a camera was added."""
        self.pose_index = pose_index(self.layout, self._scenes, self.stepper.poses)
        self.state_index = state_index(self.layout, self._systems, self.stepper.state)
        for table in self._tables.values():
            table.forget_plans()

    @contextmanager
    def writing_bodies(self, rows: np.ndarray) -> Iterator[None]:
        """Around a direct change of bodies with these rows."""
        with self.stepper.writing(self.layout.body_environment[rows].tolist()):
            yield

    @contextmanager
    def writing_articulations(self, rows: np.ndarray) -> Iterator[None]:
        """Around a direct change of articulations with these rows."""
        with self.stepper.writing(self.layout.articulation_environment[rows].tolist()):
            yield

    def body_rows(self, bodies: Sequence[Any]) -> list[int]:
        """Rows of sapien bodies in ``cuda_rigid_body_data``."""
        return [self.layout.row_of[id(body)] for body in bodies]

    def articulation_rows(self, articulations: Sequence[Any]) -> list[int]:
        """Rows of sapien articulations in the ``cuda_articulation_*`` tables."""
        return [self.layout.articulation_of[id(articulation)] for articulation in articulations]

    # ---- nothing to do ---------------------------------------------------------------------------

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

    # ---- contacts --------------------------------------------------------------------------------

    def get_contacts(self) -> list[physx.PhysxContact]:
        """Contacts of all environments in the last step. Do not keep them: the next step frees them."""
        self.flush()
        return [contact for system in self._systems for contact in system.get_contacts()]

    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for the impulses on the first body of each pair by the second."""
        return self.stepper.contacts.pairs(body_pairs)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return self.stepper.contacts.bodies(bodies)

    def gpu_query_contact_pair_impulses(self, query: PairImpulses) -> None:
        """Bring ``query.cuda_impulses`` up to date; N s, shape (pairs, 3)."""
        self.stepper.scan_contacts(self.stepper.contacts)
        self.stepper.contacts.answer(query)

    def gpu_query_contact_body_impulses(self, query: BodyImpulses) -> None:
        """Bring ``query.cuda_impulses`` up to date; N s, shape (bodies, 3)."""
        self.gpu_query_contact_pair_impulses(query)

    # ---- other things of the systems -------------------------------------------------------------

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
