"""What each entry of the observation holds, worked out anew from an invented state."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from invented import ACTION, ARM, FINGERS, HAND, NEAR, TIP_RADIUS, invented
from invented_microwave import OVEN, YAW, in_world, turned
from invented_microwave import invented as two_arms
from scipy.spatial.transform import Rotation
from torch import Tensor

from dora.affordance.objects.catalogue import load_object
from dora.tasks.cube import OBSERVATIONS as CUBE
from dora.tasks.hammer.observations import OBSERVATIONS as HAMMER
from dora.tasks.hammer.snapshot import HANDLE_RADIUS, HammerSnapshot
from dora.tasks.jug import OBSERVATIONS as JUG
from dora.tasks.mdp.observations import ARM_ENTRIES, CANDIDATE_ENTRIES, FASTEST_SPIN
from dora.tasks.mdp.snapshot import Snapshot, extended
from dora.tasks.microwave.mdp import OBSERVATIONS as OF_MICROWAVE
from dora.tasks.microwave.snapshot import LEFT, RIGHT

N, PHASES = 3, 4


def turns(*shape: int) -> Tensor:
    """Random unit quaternions, wxyz."""
    return torch.nn.functional.normalize(torch.randn(*shape, 4), dim=-1)


def state() -> Snapshot:
    """Random numbers in every field that is observed."""
    torch.manual_seed(0)
    return invented(
        N, arm_q=torch.randn(N, ARM), hand_q=torch.randn(N, HAND), hand_v=torch.randn(N, HAND),
        hand_target=torch.randn(N, HAND), wrist_p=torch.randn(N, 3), wrist_q=turns(N), wrist_v=torch.randn(N, 3),
        wrist_w=torch.randn(N, 3), tip_p=torch.randn(N, FINGERS, 3), tip_q=turns(N, FINGERS),
        touch=torch.rand(N, FINGERS + 1) > 0.5, object_p=torch.randn(N, 3), object_q=turns(N),
        object_v=torch.randn(N, 3), object_w=30 * torch.randn(N, 3), start_p=torch.randn(N, 3),
        goal_p=torch.randn(N, 3), goal_q=turns(N), goal_grasp=torch.randn(N, HAND), nearest_p=torch.randn(N, NEAR, 3),
        nearest_q=turns(N, NEAR), phase=torch.rand(N, PHASES), residual=torch.randn(N, ACTION),
        max_penetration=torch.tensor([0.0, 0.0023, 0.011]), stage=torch.tensor([0, 1, 4]),
        time=torch.tensor([0.0, 0.25, 1.0]),
    )  # fmt: skip


def rotation(q: Tensor) -> Rotation:
    """A rotation (wxyz)."""
    return Rotation.from_quat(q.double().numpy(), scalar_first=True)


def in_hand(s: Snapshot, vectors: Tensor) -> np.ndarray:
    """Vectors (n, 3) of the world in the axes of the wrist."""
    return rotation(s.hand.wrist_q).inv().apply(vectors.double().numpy())


def columns(r: Rotation) -> np.ndarray:
    """First two columns of matrices, row by row."""
    return r.as_matrix()[:, :, :2].reshape(N, 6)


def errors(s: Snapshot, p: Tensor, q: Tensor) -> np.ndarray:
    """From the wrist to another pose, in the wrist's axes: position, rotation vector."""
    wrist = rotation(s.hand.wrist_q)
    return np.concatenate([in_hand(s, p - s.hand.wrist_p), (wrist.inv() * rotation(q)).as_rotvec()], -1)


EXPECTED: dict[str, Callable[[Snapshot], object]] = {
    "hand_q": lambda s: s.hand.q,
    "hand_v": lambda s: s.hand.v,
    "hand_lead": lambda s: s.hand.target - s.hand.q,
    "arm_q": lambda s: s.hand.arm_q,
    "tips": lambda s: np.concatenate([in_hand(s, s.hand.tip_p[:, k] - s.hand.wrist_p) for k in range(FINGERS)], -1),
    "tip_axes": lambda s: np.concatenate([rotation(s.hand.tip_q[:, k]).apply([0, 0, 1]) for k in range(FINGERS)], -1),
    "wrist_p": lambda s: s.hand.wrist_p,
    "wrist_R": lambda s: columns(rotation(s.hand.wrist_q)),
    "wrist_v": lambda s: s.hand.wrist_v,
    "wrist_w": lambda s: s.hand.wrist_w,
    "object_p": lambda s: in_hand(s, s.object.p - s.hand.wrist_p),
    "object_R": lambda s: columns(rotation(s.hand.wrist_q).inv() * rotation(s.object.q)),
    "object_v": lambda s: in_hand(s, s.object.v),
    "object_w": lambda s: np.clip(in_hand(s, s.object.w), -FASTEST_SPIN, FASTEST_SPIN),
    "object_rise": lambda s: (s.object.p - s.object.start_p)[:, 2:],
    "touch": lambda s: s.hand.touch.double(),
    "max_penetration": lambda s: [[0.0], [2.3], [11.0]],
    "stage": lambda s: [[0.0], [1.0], [4.0]],
    "time": lambda s: [[0.0], [0.25], [1.0]],
    "goal": lambda s: errors(s, s.goal.p, s.goal.q),
    "goal_hand": lambda s: s.goal.grasp - s.hand.q,
    "nearest": lambda s: np.concatenate(
        [errors(s, s.goal.nearest_p[:, k], s.goal.nearest_q[:, k]) for k in range(1, NEAR)], -1
    ),
    "phase": lambda s: s.goal.phase,
    "residual": lambda s: s.goal.residual,
    "candidate": lambda s: np.concatenate([
        rotation(s.object.q).inv().apply((s.goal.p - s.object.p).double().numpy()),
        columns(rotation(s.object.q).inv() * rotation(s.goal.q)),
    ], -1),
}  # fmt: skip
"""Values (n, k) by name of the entry."""


def test_every_entry_is_expected():
    assert list(EXPECTED) == [*ARM_ENTRIES, *CANDIDATE_ENTRIES]


def test_what_a_robot_measures_or_knows_of_itself_stays_beside_pictures():
    """The rest, such as the pose of the object, is what a camera is there for."""
    sensed = "hand_q hand_v hand_lead arm_q tips tip_axes wrist_p wrist_R wrist_v wrist_w touch time phase residual"
    assert [name for name, entry in ARM_ENTRIES.items() if entry.sensed] == sensed.split()


@pytest.mark.parametrize("name", EXPECTED)
def test_an_entry_holds_what_it_says(name: str):
    s = state()
    value = {**ARM_ENTRIES, **CANDIDATE_ENTRIES}[name].value(s)
    np.testing.assert_allclose(value, EXPECTED[name](s), rtol=1e-5, atol=1e-5)  # pyright: ignore[reportArgumentType, reportCallIssue]


# ------------------------------------------------------------------------- of each task


def hammer() -> HammerSnapshot:
    """A random state with a hammer and a nail; the hammer slides 4 cm in the hand, 50 cm, or turns far."""
    drift = {"drift_p": torch.tensor([0.04, 0.5, 0.0]), "drift_r": torch.tensor([0.3, 0.0, 7.0])}
    nail = {"nail_p": torch.randn(N, 3), "nail_depth": torch.tensor([0.0, 0.02, 0.05])}
    ends = {name: torch.randn(N, 3) for name in ("face", "butt", "neck")}
    turn = {"turned": torch.tensor([0.0, 0.7, -0.1]), "way": torch.tensor([1.0, -1.0, 1.0])}
    driven = torch.tensor([0.0, 0.01, 0.03])
    return extended(state(), HammerSnapshot, nail_driven=driven, **nail, **drift, **ends, **turn)


def from_handle(s: HammerSnapshot) -> np.ndarray:
    """Distance of fingertips from the segment between butt and neck, less both radii, by dense points on it."""
    share = np.linspace(0, 1, 20001)[:, None]
    out = np.zeros((N, FINGERS))
    for k in range(N):
        line = (1 - share) * s.butt[k].numpy() + share * s.neck[k].numpy()
        line = rotation(s.object.q[k]).apply(line) + s.object.p[k].numpy()
        out[k] = np.linalg.norm(s.hand.tip_p[k].numpy()[:, None] - line, axis=-1).min(1)
    return out - TIP_RADIUS - HANDLE_RADIUS


OF_THE_HAMMER: dict[str, Callable[[HammerSnapshot], object]] = {
    "length": lambda s: s.object.half[:, 2:],
    "nail": lambda s: in_hand(s, s.nail_p - s.hand.wrist_p),
    "nail_depth": lambda s: [[0.0, 0.0], [2.0, 1.0], [5.0, 3.0]],
    "drift": lambda s: [[0.4, 0.3], [1.0, 0.0], [0.0, 1.0]],
    "handle": from_handle,
    "face": lambda s: s.nail_p - s.object.p - torch.as_tensor(rotation(s.object.q).apply(s.face.numpy())),
    "axes": lambda s: np.concatenate([rotation(s.object.q).apply(axis) for axis in ([1, 0, 0], [0, 0, 1])], -1),
    "nail_axis": lambda s: in_hand(s, torch.tensor([[0.0, 0.0, -1.0]] * N)),
}
"""Values (n, k) by name of the entry."""


def test_every_entry_of_the_hammer_is_expected():
    assert list(OF_THE_HAMMER) == list(HAMMER)


@pytest.mark.parametrize("name", OF_THE_HAMMER)
def test_an_entry_of_the_hammer_holds_what_it_says(name: str):
    s = hammer()
    np.testing.assert_allclose(HAMMER[name].value(s), OF_THE_HAMMER[name](s), rtol=1e-5, atol=1e-4)  # pyright: ignore[reportArgumentType, reportCallIssue]


def test_the_cube_is_observed_by_its_size_and_the_distance_of_its_surface():
    tips = torch.tensor([[[0.13, 0.0, 0.0], [0.0, 0.0, 0.04], [0.0, 0.0, 0.0], [0.0, -0.03, 0.0], [0.06, 0.07, 0.0]]])
    s = invented(1, tip_p=tips)
    torch.testing.assert_close(CUBE["half"].value(s), torch.tensor([[0.03]]))
    torch.testing.assert_close(CUBE["surface"].value(s), torch.tensor([[0.1, 0.01, -0.03, 0.0, 0.05]]) - TIP_RADIUS)


@pytest.mark.parametrize("seed", range(4))
def test_the_jug_is_observed_by_its_size_and_the_distances_of_its_regions(seed: int):
    """A larger jug and a hand with fingertips around its handle."""
    torch.manual_seed(seed)
    jug, scale = load_object("jug"), 1.2
    centre = scale * torch.as_tensor(jug.centroid(jug.target), dtype=torch.float32)
    tips = 0.15 * turns(1, FINGERS)[..., :3] + centre
    half = scale * torch.as_tensor(jug.mesh.extents / 2, dtype=torch.float32)[None]
    s = invented(1, tip_p=tips, object_half=half)
    torch.testing.assert_close(JUG["scale"].value(s), torch.tensor([[scale]]))
    torch.testing.assert_close(JUG["handle_p"].value(s), centre[None])
    nearest = [trimesh.proximity.closest_point(part, tips[0].numpy() / scale)[1] * scale for part in (
        jug.mesh, jug.mesh.submesh([jug.face_labels == jug.labels.index(jug.target)], append=True),
    )]  # fmt: skip
    np.testing.assert_allclose(JUG["surface"].value(s)[0], nearest[0] - TIP_RADIUS, atol=2e-3)
    np.testing.assert_allclose(JUG["handle"].value(s)[0], nearest[1] - TIP_RADIUS, atol=2e-3)
    assert JUG["class"].value(s).tolist() == [[0.0, 0.0, 0.0]]


# ------------------------------------------------------------------------- two arms


def test_each_arm_observes_what_it_is_to_hold_and_the_other_wrist():
    """Fingertips are 5 cm from the axis of the handle, whose radius is 8 mm, and 10 cm beside a face of the cube."""
    wrists = {LEFT: torch.tensor([[0.1, 0.2, 0.3]] * 2), RIGHT: torch.tensor([[0.4, 0.0, 0.5]] * 2)}
    tips = {LEFT: torch.tensor([0.03, 0.05, 0.0]), RIGHT: torch.tensor([0.0, 0.13, 0.0])}
    left, right = ({"wrist_p": wrists[arm], "tip_p": tips[arm].repeat(2, FINGERS, 1)} for arm in (LEFT, RIGHT))
    s = two_arms(left, right)
    expected = {LEFT: 0.05 - 0.008 - TIP_RADIUS, RIGHT: 0.10 - TIP_RADIUS}
    for arm, other in ((LEFT, RIGHT), (RIGHT, LEFT)):
        seen = s.of(arm)
        distance = OF_MICROWAVE["surface"].value(seen)
        torch.testing.assert_close(distance, torch.full((2, FINGERS), expected[arm]))
        torch.testing.assert_close(OF_MICROWAVE["other"].value(seen), wrists[other] - wrists[arm])


def test_each_arm_observes_the_microwave_from_its_hand():
    """The hand is turned by a right angle about the vertical, the microwave by `YAW`."""
    turn, p = turned(np.pi / 2), torch.tensor([[0.1, 0.2, 0.3]] * 2)
    hand = {"wrist_p": p, "wrist_q": turn}
    door, speed = torch.tensor([0.0, 1.2]), torch.tensor([0.0, -0.5])
    s = two_arms(hand, hand, cube={"p": in_world(0.1, -0.02, 0.04)}, door=door, door_speed=speed).of(RIGHT)
    quarter = rotation(turn).inv()
    np.testing.assert_allclose(OF_MICROWAVE["oven"].value(s), quarter.apply(np.array(OVEN) - p.numpy()), atol=1e-6)
    ahead = [[np.cos(YAW), np.sin(YAW), 0.0]] * 2
    np.testing.assert_allclose(OF_MICROWAVE["into"].value(s), quarter.apply(ahead), atol=1e-6)
    np.testing.assert_allclose(OF_MICROWAVE["in_oven"].value(s), [[0.1, -0.02, 0.04]] * 2, atol=1e-6)
    np.testing.assert_allclose(OF_MICROWAVE["door"].value(s), [[0.0, 0.0], [1.2, -0.5]])
    np.testing.assert_allclose(OF_MICROWAVE["half"].value(s), [[0.03]] * 2)
