"""The batched physics system: N `PhysxCpuSystem`s behind the interface of one `PhysxGpuSystem`."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import sapien
from sapien import physx

from dora.sim.batch.bindings import make_tables
from dora.sim.batch.guard import StateGuard
from dora.sim.batch.layout import Layout, check_packing, pose_index, state_index
from dora.sim.batch.queries import BodyImpulses, BodyPair, PairImpulses
from dora.sim.batch.stepping import Stepper, StepProfile
from dora.sim.batch.table import Table


class BatchSystem:
    """The physics of N environments, each in its own `PhysxCpuSystem`.

    It implements the part of `PhysxGpuSystem`'s interface that ManiSkill uses. A table is read when it is indexed
    (`Table`), and a value written to it goes to the simulator directly, by the call that ManiSkill makes for a single
    environment on a CPU, in the same order. The results are therefore the same bit for bit, and all ``gpu_fetch_*``
    and ``gpu_apply_*`` do nothing.

    Within a control step, drive targets and physics steps are deferred: see `Stepper`.
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
        self.guard = StateGuard(scenes, self.stepper)
        self.layout = Layout({}, {})
        self._tables: dict[str, Table] = {}

    @property
    def __class__(self) -> type:
        """`PhysxGpuSystem`, because ManiSkill's structs choose their buffers by ``isinstance``."""
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
        """The profile to which times are added, or None."""
        return self.stepper.profile

    @profile.setter
    def profile(self, profile: StepProfile | None) -> None:
        self.stepper.profile = profile

    def step(self) -> None:
        """Advance every environment by one time step."""
        self.stepper.step()

    def defer(self, steps: int) -> None:
        """Defer up to ``steps`` physics steps, see `Stepper.defer`; ``defer(0)`` executes them."""
        self.stepper.defer(steps)

    def flush(self) -> None:
        """Execute pending writes and steps, so that SAPIEN objects may be used directly."""
        self.stepper.flush()

    def invalidate(self) -> None:
        """Declare all values out of date, after SAPIEN objects were changed directly."""
        self.stepper.changed(range(len(self._systems)))

    # ---- tables ----------------------------------------------------------------------------------

    def build(self, actors: Mapping[str, Any], articulations: Mapping[str, Any]) -> None:
        """Assign rows to the bodies and articulations of a finished scene and make its tables.

        Args:
            actors: ManiSkill actors by name; static ones get no rows.
            articulations: ManiSkill articulations by name.

        Raises:
            RuntimeError: the installed SAPIEN packs its state in an unknown order.
        """
        self.layout = Layout(actors, articulations)
        self.stepper.refresh()
        self._find_values()
        body_poses = self.stepper.poses.flat().take(self.pose_index)
        check_packing(self.layout, body_poses, self.stepper.state.flat(), self.state_index)
        self._tables = make_tables(self)
        self.__dict__.update(self._tables)

    def _find_values(self) -> None:
        """Computes the indices of all values again, after the length of the packed state changed."""
        self.pose_index = pose_index(self.layout, self._scenes, self.stepper.poses)
        self.state_index = state_index(self.layout, self._systems, self.stepper.state)
        self.guard.locate(self.layout, self.pose_index, self.state_index)
        for table in self._tables.values():
            table.forget_plans()

    @contextmanager
    def writing_bodies(self, rows: np.ndarray) -> Iterator[None]:
        """Context for direct changes of the bodies of these rows."""
        with self.stepper.writing(self.layout.body_environment[rows].tolist()):
            yield

    @contextmanager
    def writing_articulations(self, rows: np.ndarray) -> Iterator[None]:
        """Context for direct changes of the articulations of these rows."""
        with self.stepper.writing(self.layout.articulation_environment[rows].tolist()):
            yield

    def body_rows(self, bodies: Sequence[Any]) -> list[int]:
        """Rows of SAPIEN bodies in ``cuda_rigid_body_data``."""
        return [self.layout.row_of[id(body)] for body in bodies]

    def articulation_rows(self, articulations: Sequence[Any]) -> list[int]:
        """Rows of SAPIEN articulations in the ``cuda_articulation_*`` tables."""
        return [self.layout.articulation_of[id(articulation)] for articulation in articulations]

    # ---- nothing to do ---------------------------------------------------------------------------

    def _done_already(self) -> None:
        """Does nothing: writes go to the simulator directly, reads are made on demand."""

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
        """Execute pending steps, so that SAPIEN objects may be used directly, for example to render them."""
        self.flush()

    # ---- contacts --------------------------------------------------------------------------------

    def get_contacts(self) -> list[physx.PhysxContact]:
        """Contacts of all environments in the last step; do not keep them, because the next step frees them."""
        self.flush()
        return [contact for system in self._systems for contact in system.get_contacts()]

    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence[BodyPair]) -> PairImpulses:
        """A query for the impulses on the first body of each pair by the second."""
        return self.stepper.contacts.pairs(body_pairs)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> BodyImpulses:
        """A query for the net impulses on bodies."""
        return self.stepper.contacts.bodies(bodies)

    def gpu_query_contact_pair_impulses(self, query: PairImpulses) -> None:
        """Evaluate a query: ``query.cuda_impulses`` (pairs, 3) [N s]."""
        self.stepper.scan_contacts(self.stepper.contacts)
        self.stepper.contacts.answer(query)

    def gpu_query_contact_body_impulses(self, query: BodyImpulses) -> None:
        """Evaluate a query: ``query.cuda_impulses`` (bodies, 3) [N s]."""
        self.gpu_query_contact_pair_impulses(query)

    # ---- other things of the systems -------------------------------------------------------------

    @property
    def systems(self) -> list[physx.PhysxCpuSystem]:
        """The systems of the environments, after all pending steps."""
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
        """(3,) zero, because every environment has its own world [m]."""
        return np.zeros(3, np.float32)
