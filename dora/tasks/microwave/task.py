"""DoraMicrowave-v1: what is built, how episodes start, and what leads the two arms."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor, Link, Pose
from torch import Tensor

from dora.affordance.bundled_sets import ROBOT, best_candidates
from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.objects.articulation import Mount, load_mount
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.rotations import quaternion_from_yaw
from dora.robot import RobotDescription
from dora.robot.shapes import Shape
from dora.sim.actors import build_box
from dora.sim.cameras import CameraSpec
from dora.sim.hinged import HingedObject, drawn_mount
from dora.sim.shapes import DrawnShape
from dora.tasks.env.arm import Arm, ArmSpec
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import STANDING_DRAWS, standing
from dora.tasks.env.table import TableTop
from dora.tasks.env.task import HAND_CAMERA, Task
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.waypoints import WaypointReference
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.snapshot import Snapshot, extended
from dora.tasks.microwave.mdp import OBSERVATIONS, MicrowaveConfig, at_rest, failed, paper_terms, stages, terms
from dora.tasks.microwave.reach import OvenReach, opening_way, oven_reach, placing_way
from dora.tasks.microwave.reference import opening, placing
from dora.tasks.microwave.snapshot import CAVITY, LEFT, RIGHT, MicrowaveSnapshot

OVEN_DRAWS = 6
"""Random numbers of a microwave: x, y, yaw, damping, friction, latch."""
BLUE = (0.20, 0.42, 0.75, 1.0)
"""Colour of the cube: red, green, blue and opacity [1]."""
CLASSES = {LEFT: "HandleGrasp", RIGHT: "BodyGrasp"}
"""The grasp classes of the candidates of each arm."""

RECOMMENDED: dict[str, Any] = {
    "total_steps": 400_000, "stop_success": 0.97, "num_envs": 64, "eval_every": 100_000, "eval_episodes": 100,
    "eval_envs": 50, "learner": {"rollout": 16, "log_std": -1.2, "prior": 0.02},
}  # fmt: skip
"""Settings of every learner of this task."""
LARGE_BATCHES: dict[str, Any] = {"learner": {**RECOMMENDED["learner"], "rollout": 64}}
"""What MAPPO has in their place: with a rollout of 16 it gains a third less (docs/tasks/microwave.md)."""


@register_task("DoraMicrowave-v1")
class MicrowaveTask(Task):
    """Open a microwave by its handle with the left arm, and put a cube inside with the right one.

    **Randomisations:** the cube's position within +-6 cm and its yaw, wherever the right arm can carry out at least one
    stored candidate; place (+-4 cm) and yaw (+-10 degrees) of the microwave, damping, friction and latch of its door;
    size, mass and friction of the cube, friction of the handle, candidate error and observation noise by preset.

    **Stages**, side by side. Left: reach_handle (thumb and one fingertip within 3 cm of the handle), grasp_handle
    (thumb and one more finger touch it for 0.15 s), open (60 degrees). Right: reach_cube and grasp_cube (the same with
    the cube), carry (8 cm above its start and before the cavity), put_in (the whole cube is behind the front plane),
    leave (the cube rests inside, the right hand does not touch it, both wrists and the right fingertips are out, and
    the door is open, for 0.25 s).

    **Success:** all stages done, and no overlap above 5 mm in the whole episode, of hands, arms, door, body or cube.

    **Failure:** the cube falls off the table or is knocked away.
    """

    CONFIG = MicrowaveConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {
        LEFT: ArmSpec("microwave", "above", (0.0, 0.35, 0.0), robot="diana7_hit_left"),
        RIGHT: ArmSpec("cube", "above", (0.0, -0.35, 0.0)),
    }
    DRAWS = STANDING_DRAWS + OVEN_DRAWS
    MAX_STEPS = 320
    ONE_SIZE: ClassVar[frozenset[str]] = frozenset({"microwave"})
    TABLE: ClassVar[TableTop] = TableTop((0.45, 0.0), (0.80, 0.75, 0.02))
    CAMERA = ((-0.45, 0.05, 1.15), (0.60, -0.03, 0.12))
    CAMERAS: ClassVar[Mapping[str, CameraSpec]] = {
        "hand_camera": HAND_CAMERA,
        "front_camera": CameraSpec(eye=(-0.25, -0.75, 0.85), target=(0.6, -0.05, 0.2), fov=1.0),
    }
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "happo": RECOMMENDED, "mappo": RECOMMENDED | LARGE_BATCHES, "ppo": RECOMMENDED,
    }  # fmt: skip

    oven: HingedObject

    def make_mdp(self, scene: TaskScene) -> Mdp[MicrowaveSnapshot]:
        c: MicrowaveConfig = self.config
        judged = stages(c), terms(c), paper_terms(c), c.penetration_limit, OBSERVATIONS, failed
        return Mdp(*judged, "the cube has left the table or the reach of the arm")

    def held(self, s: MicrowaveSnapshot, arm: str) -> Bool[Tensor, " n"]:
        """What the grasp was for has been done: the door is open, or the cube lies inside, whatever held them."""
        c: MicrowaveConfig = self.config
        return s.door >= c.open if arm == LEFT else at_rest(s, c)

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        c: MicrowaveConfig = self.config
        task = "DoraMicrowave-v1" if arm == RIGHT else None
        return best_candidates(self.ARMS[arm].object, CLASSES[arm], c.fewest, c.most_candidates, region, task)

    def adapted(self, candidates: GraspCandidates, arm: str, robot: RobotDescription) -> GraspCandidates:
        """The left hand is the mirror image of the right one, for which the bundled candidates were found."""
        of_the_other_hand = candidates.robot in ("", ROBOT) and robot.name != ROBOT
        return mirrored(candidates, robot) if arm == LEFT and of_the_other_hand else candidates

    def make_reference(self, scene: TaskScene, arm: str) -> Reference:
        """The left arm opens the door and holds it, the right one waits for that with the cube."""
        c: MicrowaveConfig = self.config
        if arm == LEFT:
            hinge = torch.tensor(oven_mount().hinge_link.position, device=scene.device)
            way, closing_time = opening(c.opening, hinge), c.opening.closing_time
        else:
            way, closing_time = placing(c.placing, CAVITY[2][0]), c.placing.closing_time
        return WaypointReference(way, scene.num_envs, c.dt, scene.device, closing_time)

    def start_grid(self, arm: str) -> Grid | None:
        return Grid(self.config.centre, (self.config.spread,) * 2) if arm == RIGHT else None

    def build(self, scene: TaskScene, name: str, scale: Float[np.ndarray, " n"]) -> Actor | Link:
        """The microwave around its handle, and the cube."""
        obj = load_object(name)
        self._reach: dict[tuple[str, int], tuple[GraspCandidates, OvenReach]] = {}
        if name == "cube":
            return build_box(scene.scene, obj, scale, BLUE, sapien.Pose([*self.config.centre, obj.support]))
        self.oven = HingedObject(scene.scene, obj, oven_mount())
        bar = next(p.shape for p in obj.pieces if p.label == obj.target)
        assert isinstance(bar, Shape)
        self._bar = torch.tensor(np.asarray(bar.segment), dtype=torch.float32, device=scene.device)
        self._bar_radius = float(bar.size[0])
        return self.oven.link

    def world(self, scene: TaskScene) -> Sequence[Actor | Link]:
        return [scene.table, *(link for link in self.oven.links.values() if link is not self.oven.link)]

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        """The microwave is shut and stands somewhere near its place; the cube stands somewhere in its area."""
        c: MicrowaveConfig = self.config
        r, hinge = c.randomisation, oven_mount().hinge
        cube, oven = u.split([STANDING_DRAWS, OVEN_DRAWS], -1)
        oven = 2 * oven - 1
        position = torch.tensor(c.oven, device=scene.device).repeat(len(rows), 1)
        position[:, :2] += r.oven_position * oven[:, :2]
        resistance = torch.tensor([hinge.damping, hinge.friction, hinge.latch], device=scene.device)
        damping, friction, latch = (resistance * (1 + r.hinge * oven[:, 3:])).unbind(-1)
        quaternion = quaternion_from_yaw(r.oven_rotation * oven[:, 2])
        self.oven.begin(rows, position, quaternion, damping, friction, latch)
        grid, right = self.start_grid(RIGHT), scene.arms[RIGHT]
        assert grid is not None
        way = self._followed(right, position, quaternion, right.start_candidates)

        def reachable(p: Tensor, q: Tensor) -> Tensor:
            return self.startable(right, p, q) & way.repeat_interleave(len(p) // len(way), 0)

        scene.objects["cube"].set_pose(
            Pose.create_from_pq(*standing(cube, scene.halves["cube"][rows, 2], grid, reachable))
        )

    def reachable(
        self, arm: Arm, rows: Int[Tensor, " b"], object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> Bool[Tensor, "b c"]:
        """f_reach: the candidates whose way along the door, or into the cavity, the arm can follow, and with which it
        can grasp the cube where it stands."""
        body = self.oven.links[oven_mount().links[0].name].pose
        way = self._followed(arm, body.p[rows], body.q[rows], arm.guide.choice.candidates)
        return way & self.graspable(arm, object_p, object_q)

    def _followed(self, arm: Arm, p: Tensor, q: Tensor, candidates: GraspCandidates) -> Bool[Tensor, "b c"]:
        """The candidates whose way the arm can follow with microwaves at these world poses."""
        c: MicrowaveConfig = self.config
        key = arm.name, id(candidates)
        if key not in self._reach:
            mount, r, place = oven_mount(), c.randomisation, c.placing
            hinge, handle = (
                (torch.tensor(link.position), torch.tensor(link.quaternion))
                for link in (mount.hinge_link, mount.object_link)
            )
            height = CAVITY[2][0] + float(load_object("cube").mesh.extents[2]) / 2 + place.raised
            if arm.name == LEFT:
                way = opening_way(hinge, handle, c.opening.standoff, c.opening.target)
            else:
                way = placing_way(place.front, place.depth, height)
            found = oven_reach(arm, candidates, way, c.oven, r.oven_position, r.oven_rotation)
            self._reach[key] = candidates, found  # kept, so that no other set gets the same id
        return self._reach[key][1].mask(p, q)

    def masses(self, name: str, nominal: Float[Tensor, " b"], u: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        return nominal if name == "microwave" else super().masses(name, nominal, u)

    def drawn(self, scene: TaskScene) -> Mapping[str, tuple[Actor | Link, tuple[DrawnShape, ...]]]:
        """The table and the links of the microwave."""
        shapes = drawn_mount(load_object("microwave"), oven_mount())
        return {**super().drawn(scene), **{name: (link, shapes[name]) for name, link in self.oven.links.items()}}

    def extended(self, s: Snapshot) -> MicrowaveSnapshot:
        """The snapshot with the microwave and its door."""
        body = self.oven.links[oven_mount().links[0].name].pose
        shut = torch.tensor(oven_mount().object_link.quaternion, device=body.q.device)
        return extended(
            s, MicrowaveSnapshot, oven_p=body.p, oven_q=body.q, door=self.oven.angle, door_speed=self.oven.speed,
            wrists=torch.stack([hand.wrist_p for hand in s.hands.values()], 1),
            tips_of_placer=s.hands[RIGHT].tip_p, cube_p=s.objects["cube"].p,
            bar=self._bar, bar_radius=self._bar_radius, shut_q=shut,
        )  # fmt: skip

    def stateful(self) -> dict[str, Any]:
        return {"oven": self.oven}


@cache
def oven_mount() -> Mount:
    """What the handle is mounted on."""
    return load_mount(load_object("microwave"))


def mirrored(candidates: GraspCandidates, robot: RobotDescription) -> GraspCandidates:
    """The candidates of a hand as those of its mirror image, for an object that is its own mirror image about the plane
    y = 0 of its frame: positions (x, -y, z), quaternions (w, -x, y, -z), the joints unchanged.

    Args:
        candidates: of a hand.
        robot: the mirror image of its robot.
    """
    flip = torch.tensor([1.0, -1.0, 1.0])
    turn = torch.tensor([1.0, -1.0, 1.0, -1.0])
    return replace(
        candidates,
        position=candidates.position * flip,
        quaternion=candidates.quaternion * turn,
        approach=candidates.approach * flip,
        contacts=candidates.contacts * flip,
        robot=robot.name,
        robot_digest=hand_digest(robot),
    )
