"""The hand of any robot folder as batched tensors: forward kinematics, capsules, spheres and contact points.

Bodies are the wrist link (body 0, with all links fixed to it) and, finger by finger, the child link of every
moving joint. All fingers are evaluated at once as chains of equal length; shorter ones are padded with
fixed joints. The parameters are the actuated joints; coupled joints follow by `Coupling`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.hand.capsules import BURIED, MOST_CAPSULES, Capsule, capsules_of, palmar_points
from dora.errors import InputError
from dora.robot import RobotDescription
from dora.robot.kinematics import rodrigues
from dora.robot.urdf import UrdfJoint

PALM = 1
"""Contact class of the palm; 0 is no contact, and finger i of the robot is i + 2."""
POINTS_PER_LINK = 24
"""Number of contact points on each finger link."""
POINTS_ON_PALM = 40
"""Number of contact points on the palm."""
LEAST = 1e-6
"""Length of a link [m], or of a mean direction [1], below which it has no direction."""
MOST_FINGERS = 5
"""Fingers that have a contact class."""
MOST_SPHERES, MOST_AREA = 20_000, 1.0
"""Largest number of spheres on the capsules of a hand, and area of their surfaces together [m^2]."""


class Points:
    """p points fixed to bodies, stored as one matrix for the wrist and one per finger for batched placement.

    Args:
        body: (p,) index of the body of each point, ascending.
        local: (p, 3) position in the frame of that body [m].
        fingers: number of fingers.
        depth: number of joints per finger, padding included.
    """

    def __init__(self, body: Int[Tensor, " p"], local: Float[Tensor, "p 3"], fingers: int, depth: int) -> None:
        self.body, self.local = body, local
        homogeneous = torch.cat((local, torch.ones_like(local[:, :1])), 1)
        fixed = int((body == 0).sum())
        finger, level = (body[fixed:] - 1) // depth, (body[fixed:] - 1) % depth
        counts = torch.bincount(finger, minlength=fingers)
        column = torch.arange(len(finger), device=body.device) - (counts.cumsum(0) - counts)[finger]
        self.on_wrist = homogeneous[:fixed].T.contiguous()
        blocks = local.new_zeros(fingers, depth, 4, int(counts.max()))
        blocks[finger, level, :, column] = homogeneous[fixed:]
        self.on_fingers = blocks.flatten(1, 2)
        """(fingers, 4 depth, n) homogeneous coordinates, n the largest number of points on a finger."""
        place = finger * blocks.shape[-1] + column
        self.columns = None if len(place) == fingers * blocks.shape[-1] else place
        """(p,) indices of the columns in use if fingers have different numbers of points, else None."""


@dataclass(frozen=True, eq=False)
class PalmFrame:
    """Axes of the open hand as unit vectors (3,) in the wrist frame, and `center` (3,), a point on the palm [m].

    `normal` points out of the palm, `along` from the palm to the fingers, `across` = along x normal.
    """

    normal: np.ndarray
    along: np.ndarray
    across: np.ndarray
    center: np.ndarray


class HandModel:
    """Kinematics and geometry of the hand below `robot.wrist_link`.

    Args:
        robot: any robot with fingers.
        dtype: floating type of every tensor.
        device: torch device of every tensor.

    Attributes:
        links: name of the link of every body; padding bodies repeat the last link of their finger.
        part: (bodies,) contact class of every body: `PALM`, or 2 + index of the finger.
        lower, upper: (actuated,) limits that also keep coupled joints within theirs [rad].
        capsules: all collision shapes; `pairs` (q, 2) are indices of those that may collide with each other.
        spheres, sphere_radius: s spheres on the capsules' axes, for penetration, and their radii (s,) [m].
        contacts, contact_normal: p points and outward normals (p, 3) on palmar sides, in body frames.
        palm_frame: axes and centre of the palm in the wrist frame.

    Raises:
        InputError: the robot has no finger or more than `MOST_FINGERS`, a finger has a joint that is not revolute or no
            collision shape, the shapes are too many or too large, or the palm faces nowhere.
    """

    def __init__(
        self, robot: RobotDescription, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        if not robot.fingers:
            raise InputError(f"robot {robot.name!r} has no finger; grasps need [fingers.*] in robot.toml.")
        if len(robot.fingers) > MOST_FINGERS:
            raise InputError(
                f"robot {robot.name!r} has {len(robot.fingers)} fingers; there are contact classes for {MOST_FINGERS}: "
                "describe no more in robot.toml."
            )
        self.robot, self.dtype, self.device = robot, dtype, torch.device(device)
        root = len(robot.model.chain(robot.wrist_link))
        chains = [robot.model.chain(finger.tip)[root:] for finger in robot.fingers.values()]
        self.fingers = len(chains)
        self.depth = max(sum(joint.moves for joint in chain) for chain in chains)
        self._build_joints(chains)
        self._build_bodies(chains)
        self._build_shapes()
        self._build_contacts(chains)

    def _tensor(self, values: object) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=self.dtype, device=self.device)

    def _index(self, values: object) -> Tensor:
        return torch.as_tensor(np.array(values), dtype=torch.long, device=self.device)

    def _points(self, body: Sequence[int] | np.ndarray, local: np.ndarray) -> Points:
        return Points(self._index(body), self._tensor(local), self.fingers, self.depth)

    def _build_joints(self, chains: list[tuple[UrdfJoint, ...]]) -> None:
        """Constants of the padded chains: Rodrigues terms, axes, and the map from actuated to all angles."""
        shape = (self.fingers, self.depth)
        terms = np.zeros((3, *shape, 4, 4))
        terms[0] = np.eye(4)
        axes, gain, offset = np.zeros((*shape, 3)), np.zeros((*shape, len(self.robot.hand_actuated))), np.zeros(shape)
        unit = self.robot.expand_hand(np.eye(len(self.robot.hand_actuated)))
        zero = self.robot.expand_hand(np.zeros(len(self.robot.hand_actuated)))
        lower, upper = np.full(shape, -np.inf), np.full(shape, np.inf)
        index = np.zeros(shape, dtype=int)
        for finger, chain in enumerate(chains):
            fixed, level = np.eye(4), 0
            for joint in chain:
                fixed = fixed @ joint.origin
                if not joint.moves:
                    continue
                if joint.kind != "revolute":
                    raise InputError(f"joint {joint.name!r} is {joint.kind}; grasps need revolute finger joints.")
                place, name = (finger, level), self.robot.hand.names.index(joint.name)
                terms[(slice(None), *place)] = [fixed @ term for term in rodrigues(joint.axis)]
                axes[place] = joint.axis / np.linalg.norm(joint.axis)
                index[place] = name
                gain[place], offset[place] = unit[:, name] - zero[name], zero[name]
                lower[place], upper[place] = self.robot.hand.lower[name], self.robot.hand.upper[name]
                fixed, level = np.eye(4), level + 1
        self.constant, self.cosine, self.sine = (self._tensor(term) for term in terms)
        self.axes = self._tensor(axes).flatten(0, 1)
        self.joint_gain, self.joint_offset = self._tensor(gain).flatten(0, 1), self._tensor(offset).flatten()
        self.joint_lower, self.joint_upper = self._tensor(lower).flatten(), self._tensor(upper).flatten()
        self.joint_index = self._index(index).flatten()
        """(joints,) index in the order of `RobotDescription.hand`; 0 for padding, whose joints do not move."""
        low, high = _actuated_limits(gain, offset, lower, upper)
        self.lower, self.upper = self._tensor(low), self._tensor(high)

    def _build_bodies(self, chains: list[tuple[UrdfJoint, ...]]) -> None:
        links = [self.robot.wrist_link]
        for chain in chains:
            names = [joint.child for joint in chain if joint.moves]
            links += names + [names[-1]] * (self.depth - len(names))
        self.links = tuple(links)
        finger = np.repeat(np.arange(self.fingers), self.depth)
        level = np.tile(np.arange(self.depth), self.fingers)
        self.part = self._index([PALM, *(finger + PALM + 1)])
        above = (finger[:, None] == finger) & (level[:, None] >= level)
        self._above = self._tensor(np.concatenate([np.zeros((1, len(finger))), above]))
        """(bodies, joints) 1 where the joint moves the body, else 0."""

    def _build_shapes(self) -> None:
        capsules: list[Capsule] = []
        for link, (body, pose) in _places(self.robot, self.links).items():
            for shape in self.robot.shapes.get(link, ()):
                capsules += capsules_of(shape, body, link, pose)
                if len(capsules) > MOST_CAPSULES or sum(capsule.area for capsule in capsules) > MOST_AREA:
                    raise InputError(
                        f"the collision shapes of the hand of {self.robot.name!r} up to {link!r} become more than "
                        f"{MOST_CAPSULES} capsules or {MOST_AREA:g} m^2: make them fewer, thicker or smaller."
                    )
        covered = {(capsule.body - 1) // self.depth for capsule in capsules}
        for index, name in enumerate(self.robot.fingers):
            if index not in covered:
                raise InputError(
                    f"the finger {name!r} of {self.robot.name!r} has no collision shape; add one to its URDF."
                )
        self.capsules: tuple[Capsule, ...] = tuple(sorted(capsules, key=lambda capsule: capsule.body))
        ends = np.concatenate([(c.start, c.end) for c in self.capsules])
        self.ends = self._points([c.body for c in self.capsules for _ in range(2)], ends)
        self.radius = self._tensor([capsule.radius for capsule in self.capsules])
        self.pairs = self._index(_colliding(self.robot, self.capsules)).reshape(-1, 2)
        self.spheres, self.sphere_radius = self.sphere_set()

    def sphere_set(self, **density: float) -> tuple[Points, Float[Tensor, " s"]]:
        """Spheres that cover the capsules, and their radii (s,) [m]; `density` as for `Capsule.spheres`."""
        if sum(capsule.sphere_count(**density) for capsule in self.capsules) > MOST_SPHERES:
            raise InputError(
                f"the collision shapes of the hand of {self.robot.name!r} need more than {MOST_SPHERES} spheres: make "
                "them fewer, thicker or shorter."
            )
        centers = [capsule.spheres(**density) for capsule in self.capsules]
        counts = [len(points) for points in centers]
        body = np.repeat([capsule.body for capsule in self.capsules], counts)
        radius = np.repeat([capsule.radius for capsule in self.capsules], counts)
        return self._points(body, np.concatenate(centers)), self._tensor(radius)

    def _build_contacts(self, chains: list[tuple[UrdfJoint, ...]]) -> None:
        zero = self.forward(
            torch.eye(4, dtype=self.dtype, device=self.device)[None], torch.zeros_like(self.lower)[None]
        )[0]
        poses = zero.double().cpu().numpy()
        palmar, along = _directions(self.robot, chains, poses, self.depth)
        first = min(1, self.fingers - 1)
        bases = poses[1 :: self.depth, :3, 3]
        normal = self._unit(palmar[first:, 0].mean(0))
        finger = along[first:, 0].mean(0)
        finger = self._unit(finger - normal * (finger @ normal))
        last = [sum(joint.moves for joint in chain) - 1 for chain in chains]
        bodies, points, normals = [], [], []
        for body in range(len(self.links)):
            shapes = [capsule for capsule in self.capsules if capsule.body == body]
            if not shapes:
                continue
            turn = poses[body, :3, :3].T
            place = divmod(body - 1, self.depth)
            tip = turn @ along[place] if body and place[1] == last[place[0]] else None
            facing = turn @ palmar[place] if body else normal
            found = palmar_points(shapes, facing, POINTS_PER_LINK if body else POINTS_ON_PALM, tip)
            free = _outside_others(self.capsules, poses, body, found[0])
            found = found[0][free], found[1][free]
            if not free.any():
                continue
            bodies.append(np.full(len(found[0]), body))
            points.append(found[0])
            normals.append(found[1])
        if not points:
            raise InputError(f"the hand of {self.robot.name!r} has no collision shape that faces its palmar side.")
        self.contacts = self._points(np.concatenate(bodies), np.concatenate(points))
        self.contact_normal = self._tensor(np.concatenate(normals))
        self.contact_part = self.part[self.contacts.body]
        surface = float(np.median(points[0] @ normal))
        center = bases[first:].mean(0)
        center += normal * (surface - center @ normal)
        self.palm_frame = PalmFrame(normal, finger, np.cross(finger, normal), center)

    def _unit(self, direction: np.ndarray) -> np.ndarray:
        """A direction (3,) of the palm with norm 1."""
        norm = float(np.linalg.norm(direction))
        if norm < LEAST:
            raise InputError(
                f"the palm of {self.robot.name!r} faces nowhere: the first joint of each finger has to turn further to "
                "one side, which is the palmar one, or to lie at the place of one that does."
            )
        return direction / norm

    def forward(self, wrist: Float[Tensor, "c 4 4"], actuated: Float[Tensor, "c a"]) -> Float[Tensor, "c b 4 4"]:
        """Forward kinematics: poses of all bodies in the frame of `wrist` [m] at the actuated joints [rad]."""
        angle = self.all_joints(actuated).unflatten(-1, (self.fingers, self.depth))[..., None, None]
        local = torch.addcmul(self.constant, self.cosine, angle.cos()).addcmul_(self.sine, angle.sin())
        pose = wrist[:, None]
        found = []
        for level in range(self.depth):
            pose = pose @ local[:, :, level]
            found.append(pose)
        return torch.cat((wrist[:, None], torch.stack(found, 2).flatten(1, 2)), 1)

    def all_joints(self, actuated: Float[Tensor, "c a"]) -> Float[Tensor, "c j"]:
        """Angles of all j joints, finger by finger from the palm outwards, 0 for padding [rad]."""
        return torch.addmm(self.joint_offset, actuated, self.joint_gain.T)

    def place(self, poses: Float[Tensor, "c b 4 4"], points: Points) -> Float[Tensor, "c p 3"]:
        """Positions of points fixed to bodies, in the frame of `poses` [m]."""
        count = len(poses)
        rows = poses[:, 1:, :3].unflatten(1, (self.fingers, self.depth)).permute(1, 0, 3, 2, 4)
        found = torch.bmm(rows.reshape(self.fingers, 3 * count, -1), points.on_fingers)
        found = found.view(self.fingers, count, 3, -1).permute(1, 0, 3, 2).flatten(1, 2)
        if points.columns is not None:
            found = found[:, points.columns]
        return torch.cat(((poses[:, 0, :3] @ points.on_wrist).mT, found), 1)

    def pull_back(
        self, poses: Float[Tensor, "c b 4 4"], wrench: Float[Tensor, "c b 6"]
    ) -> tuple[Float[Tensor, "c 6"], Float[Tensor, "c a"]]:
        """Generalised forces of wrenches on the bodies by the principle of virtual work, J^T w.

        Args:
            poses: (c, b, 4, 4) poses of the bodies, as from `forward`.
            wrench: (c, b, 6) force [N] and moment [N m] about the origin of the frame of `poses`, per body. With
                dE/dp as force on every point p the results are the gradient of E.

        Returns:
            Force [N] on the wrist and moment [N m] about its origin (c, 6), in the frame of `poses`, and torques
            (c, a) of the actuated joints [N m].
        """
        total = wrench.sum(1)
        moment = total[:, 3:] - torch.linalg.cross(poses[:, 0, :3, 3], total[:, :3])
        beyond = (wrench.mT.reshape(-1, wrench.shape[1]) @ self._above).view(len(wrench), 6, -1).mT
        frames = poses[:, 1:]
        axis = (frames[..., :3, :3] @ self.axes[..., None]).squeeze(-1)
        lever = beyond[..., 3:] - torch.linalg.cross(frames[..., :3, 3], beyond[..., :3])
        return torch.cat((total[:, :3], moment), 1), (axis * lever).sum(-1) @ self.joint_gain


def _actuated_limits(
    gain: np.ndarray, offset: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Widest ranges (a,) of the actuated joints q that keep every joint gain q + offset within its limits [rad]."""
    low, high = np.full(gain.shape[-1], -np.inf), np.full(gain.shape[-1], np.inf)
    for place in zip(*np.nonzero(gain), strict=True):
        bounds = [(bound[place[:2]] - offset[place[:2]]) / gain[place] for bound in (lower, upper)]
        low[place[2]] = max(low[place[2]], min(bounds))
        high[place[2]] = min(high[place[2]], max(bounds))
    return low, high


def _places(robot: RobotDescription, links: tuple[str, ...]) -> dict[str, tuple[int, np.ndarray]]:
    """Index of the body of every link of the hand, and the link's pose (4, 4) in that body [m]."""
    above = {joint.child: joint for joint in robot.model.joints.values()}
    places = {}
    for link in robot.model.links:
        pose, name = np.eye(4), link
        while name not in links and name in above and not above[name].moves:
            pose, name = above[name].origin @ pose, above[name].parent
        if name in links:
            places[link] = links.index(name), pose
    return places


def _colliding(robot: RobotDescription, capsules: tuple[Capsule, ...]) -> list[tuple[int, int]]:
    """Pairs of indices of capsules whose links may collide by the robot's description."""
    return [
        (i, j)
        for i, a in enumerate(capsules)
        for j, b in enumerate(capsules[:i])
        if a.body != b.body and (min(a.link, b.link), max(a.link, b.link)) not in robot.ignored_pairs
    ]


def _outside_others(capsules: tuple[Capsule, ...], poses: np.ndarray, body: int, points: np.ndarray) -> np.ndarray:
    """Mask (n,) of the points (n, 3) of a body that are outside all other bodies at the poses (bodies, 4, 4)."""
    free = np.ones(len(points), dtype=bool)
    for other in capsules:
        if other.body != body:
            pose = np.linalg.inv(poses[other.body]) @ poses[body]
            free &= other.distance(points @ pose[:3, :3].T + pose[:3, 3]) > BURIED
    return free


def _directions(
    robot: RobotDescription, chains: list[tuple[UrdfJoint, ...]], poses: np.ndarray, depth: int
) -> tuple[np.ndarray, np.ndarray]:
    """Palmar and lengthwise unit directions (fingers, depth, 3) of the finger links in the wrist frame.

    Lengthwise is from a joint to the next one (or to the tip). Palmar is the direction in which the link moves when
    its joint turns towards the limit that is farther from zero. A joint at the place of the next has its directions.
    """
    palmar, along = np.zeros((2, len(chains), depth, 3))
    for finger, chain in enumerate(chains):
        moving = [joint for joint in chain if joint.moves]
        origins = [poses[1 + finger * depth + level] for level in range(len(moving))]
        last = robot.model.frame(moving[-1].child, chain[-1].child)
        ends = [*origins[1:], origins[-1] @ last]
        for level in reversed(range(len(moving))):
            joint, start = moving[level], origins[level]
            line = ends[level][:3, 3] - start[:3, 3]
            if np.linalg.norm(line) < LEAST:
                if level + 1 == len(moving):
                    raise InputError(
                        f"the tip {chain[-1].child!r} lies on the last joint of its finger; move its frame."
                    )
                palmar[finger, level], along[finger, level] = palmar[finger, level + 1], along[finger, level + 1]
                continue
            close = np.cross(start[:3, :3] @ joint.axis * np.sign(joint.upper + joint.lower), line)
            along[finger, level] = line / np.linalg.norm(line)
            palmar[finger, level] = close / max(float(np.linalg.norm(close)), 1e-9)
    return palmar, along
