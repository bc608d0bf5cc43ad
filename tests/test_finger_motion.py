"""Motions of the fingers that turn the hammer in the hand: their file, the reference that makes them, their search."""

import shutil
from math import pi
from pathlib import Path
from typing import Any

import pytest
import tomli_w
import torch
from invented import extension

from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.reading import read_toml
from dora.robot import load_robot
from dora.tasks.hammer.ballistics import Strike
from dora.tasks.hammer.finger_motion import TURNING_FILE, FingerMotion, load_motion
from dora.tasks.hammer.reference import SETTLE, CatchReference, CatchSettings
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.hammer.task import HammerConfig
from dora.tools.in_task import turning as search

CONFIG = HammerConfig(reorient="in_hand")


def extension_state(way: torch.Tensor) -> HammerSnapshot:
    """Two hammers at rest, with the way in which each is to be turned."""
    names = ("nail_depth", "nail_driven", "drift_p", "drift_r", "turned")
    points = {name: torch.zeros(2, 3) for name in ("face", "butt", "neck", "nail_p")}
    return extension(HammerSnapshot, 2, **dict.fromkeys(names, torch.zeros(2)), **points, way=way)


def test_a_motion_is_piecewise_linear_and_stays_where_it_ends():
    way = torch.tensor([[1.0, 0.0], [3.0, -2.0]])
    motion = FingerMotion(2.0, way, -way)
    spent = torch.tensor([-0.1, 0.0, 0.5, 1.0, 1.5, 2.0, 9.0])
    expected = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [2.0, -1.0], [3.0, -2.0], [3.0, -2.0]])
    torch.testing.assert_close(motion.offsets(spent, torch.ones(7)), expected)
    torch.testing.assert_close(motion.offsets(spent, -torch.ones(7)), -expected)


def test_the_motion_that_is_shipped_moves_every_joint_within_reason():
    robot = load_robot("diana7_hit")
    motion = load_motion("hammer", robot)
    assert motion.positive.shape == motion.negative.shape
    assert motion.positive.shape[1] == len(robot.hand.names)
    for way in (motion.positive, motion.negative):
        assert 0.1 < way.abs().max() < pi
    # the distal joints follow the medial ones
    for coupling in robot.couplings:
        a, b = coupling.follower, coupling.leader
        torch.testing.assert_close(motion.positive[:, a], motion.positive[:, b])


def held_reference(motion: FingerMotion | None) -> CatchReference:
    """A reference of two environments at the end of `settle`."""
    strike = Strike(torch.tensor(CONFIG.nail.top), torch.zeros(2, 3), CONFIG.swing_radius)
    reference = CatchReference(2, strike, CONFIG.nail.driven, 0.025, "cpu", CatchSettings(), motion)
    reference.begin(torch.arange(2), torch.zeros(2, 3), torch.tensor([1.0, 0, 0, 0]).repeat(2, 1))
    reference.phase.index.fill_(SETTLE)
    reference.buffers.update(spent=torch.full((2,), 10.0))
    return reference


def test_the_reference_bends_the_fingers_while_it_turns_and_leaves_them_so():
    motion = FingerMotion(0.5, torch.tensor([[0.2] * 20, [0.6] * 20]), torch.tensor([[-0.1] * 20, [-0.3] * 20]))
    reference = held_reference(motion)
    s = extension_state(way=torch.tensor([1.0, -1.0]))
    closed, seen, wrists, freedom = s.goal.grasp, [], [], []
    for _ in range(30):  # .75 s: the motion, the rest after it, and into `align`
        reference.advance(s)
        target = reference.target(s)
        seen.append((target.hand - closed)[:, 0])
        wrists.append(target.wrist_p)
        freedom.append(reference.freedom())
    offsets = torch.stack(seen)
    torch.testing.assert_close(offsets[0], torch.zeros(2))  # the phase has just begun
    torch.testing.assert_close(offsets[10], torch.tensor([0.2, -0.1]), atol=1e-5, rtol=0)
    torch.testing.assert_close(offsets[15], torch.tensor([0.4, -0.2]), atol=1e-5, rtol=0)
    torch.testing.assert_close(offsets[20:], torch.tensor([0.6, -0.3]).expand(10, 2), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.stack(wrists[:20]), torch.zeros(20, 2, 3))  # the wrist stays
    assert reference.freedom().tolist() == pytest.approx([CatchSettings().held_freedom] * 2)
    assert torch.equal(torch.stack(freedom[:20]), torch.ones(20, 2))  # all of the residual while the fingers turn
    reference.begin(torch.tensor([0]), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
    assert reference.buffers.offset[:, 0].tolist() == pytest.approx([0.0, -0.3])


def test_a_reference_without_a_motion_leaves_the_fingers_closed():
    reference = held_reference(None)
    s = extension_state(way=torch.zeros(2))
    for _ in range(30):
        reference.advance(s)
        torch.testing.assert_close(reference.target(s).hand, s.goal.grasp)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"format": "dora-turning 9"}, "the format is 'dora-turning 9'"),
        ({"seconds": 0.0}, "seconds is 0.0"),
        ({"seconds": "long"}, "seconds must be float"),
        ({"positive": []}, "positive needs 1 to 100 rows"),
        ({"negative": [[0.0, 0.1]]}, "negative needs 1 to 100 rows"),
        ({"positive": [[float("nan")] * 20]}, "positive has an offset that is not a number"),
        ({"joints": ["a"] * 20}, "has motions of the hand of diana7_hit, not of diana7_hit_left"),
        ({"more": 1}, "has no field 'more'"),
    ],
)
def test_a_file_of_motions_that_cannot_be_used_is_refused(tmp_path: Path, change: dict[str, Any], told: str):
    source = load_object("hammer").folder
    assert source is not None
    folder = tmp_path / "hammer"
    shutil.copytree(source, folder)
    robot = load_robot("diana7_hit_left" if "joints" in change else "diana7_hit")
    content = read_toml(source / TURNING_FILE, "file") | change
    (folder / TURNING_FILE).write_text(tomli_w.dumps(content))
    with pytest.raises(InputError, match=told):
        load_motion(folder, robot)


def test_without_a_file_of_motions_a_sentence_says_so(tmp_path: Path):
    source = load_object("hammer").folder
    assert source is not None
    shutil.copytree(source, tmp_path / "hammer", ignore=shutil.ignore_patterns(TURNING_FILE))
    with pytest.raises(InputError, match=TURNING_FILE):
        load_motion(tmp_path / "hammer", load_robot("diana7_hit"))


# ------------------------------------------------------------------------- search


def test_a_search_moves_to_what_turns_further():
    """A population in which the turn is the first offset itself."""
    torch.manual_seed(0)
    state = search.Search(torch.zeros(2, 4, 15), torch.full((2, 4, 15), 0.5))
    way = torch.tensor([-1.0, 1.0]).repeat(60)
    random = torch.Generator().manual_seed(0)
    for _ in range(8):
        motions, number = state.draw(way, 2, random)
        own = number < search.OF_THE_MEAN
        assert torch.equal(motions[own], state.mean[(way[own] > 0).long()])
        assert (torch.bincount(number[way > 0]) == 2).all()
        turn = motions[:, 0, 0] * way
        state.learn(motions, number, search.Turned(turn, turn, torch.ones(120, dtype=torch.bool), way))
    assert state.mean[1, 0, 0] > 0.5
    assert state.mean[0, 0, 0] < -0.5
    assert (state.spread >= search.LEAST_SPREAD - 1e-6).all()


def test_the_search_moves_thumb_and_fingers_along_five_synergies():
    robot = load_robot("diana7_hit")
    along = search.synergies(robot)
    names = [[n for n, x in zip(robot.hand.names, row, strict=True) if x] for row in along]
    fingers = ("Index", "Middle", "Ring", "Little")
    assert names[:3] == [["Right_Thumb_0"], ["Right_Thumb_1"], ["Right_Thumb_2", "Right_Thumb_3"]]
    assert names[3] == [f"Right_{finger}_1" for finger in fingers]
    assert names[4] == [f"Right_{finger}_{k}" for finger in fingers for k in (2, 3)]


@pytest.mark.parametrize("name", ["generations", "population", "tries"])
def test_a_search_that_is_too_small_is_refused(name: str):
    with pytest.raises(InputError, match=f"--{name} is 0; it has to be at least"):
        search.search(search.Args(**{name: 0}))


def test_each_motion_of_a_population_is_its_own():
    motions = torch.rand(3, 4, 20)
    population = search.Population(search.SECONDS, motions[0], motions[0], motions)
    spent = torch.full((3,), search.SECONDS / 4)
    torch.testing.assert_close(population.offsets(spent, torch.tensor([1.0, -1.0, 1.0])), motions[:, 0])
