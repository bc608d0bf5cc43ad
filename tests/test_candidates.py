"""Candidates keep what is put into them, and files of another object, robot or format are refused."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dora.affordance.candidates import GraspCandidates, concatenate, hand_digest
from dora.affordance.objects.catalogue import AffordanceObject, load_object
from dora.errors import InputError
from dora.robot import RobotDescription

COUNT = 6
CONTACTS = 4
POINTS = 50


@pytest.fixture(scope="module")
def cube() -> AffordanceObject:
    return load_object("cube")


@pytest.fixture(scope="module")
def candidates(robot: RobotDescription, cube: AffordanceObject) -> GraspCandidates:
    g = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g)

    def unit(*shape: int) -> torch.Tensor:
        return torch.nn.functional.normalize(random(*shape), dim=-1)

    return GraspCandidates(
        object="cube", position=random(COUNT, 3), quaternion=unit(COUNT, 4), approach=unit(COUNT, 3),
        pregrasp=random(COUNT, 20), grasp=random(COUNT, 20), grasp_class=("BodyGrasp", "RimGrasp") * (COUNT // 2),
        joints=random(COUNT, 20), contacts=random(COUNT, CONTACTS, 3),
        contact_finger=torch.arange(COUNT * CONTACTS).reshape(COUNT, CONTACTS) % 7,
        contact_map=((random(COUNT, POINTS) < 0.2) * (7 * random(COUNT, POINTS)).int()).byte(),
        energy={"closure": random(COUNT), "distance": random(COUNT)}, penetration=random(COUNT) / 1000,
        self_penetration=random(COUNT) / 1000, valid=torch.arange(COUNT) < 4, score=random(COUNT),
        digest=cube.digest, robot=robot.name, robot_digest=hand_digest(robot), settings='{"seed": 3}',
    )  # fmt: skip


def assert_same(a: GraspCandidates, b: GraspCandidates) -> None:
    assert a.grasp_class == b.grasp_class
    assert (a.object, a.digest, a.robot, a.robot_digest, a.settings) == (
        b.object, b.digest, b.robot, b.robot_digest, b.settings,
    )  # fmt: skip
    ours, theirs = a.tensors(), b.tensors()
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        torch.testing.assert_close(theirs[name], value, rtol=0, atol=0, equal_nan=True)


def test_a_file_gives_back_what_was_saved(candidates: GraspCandidates, cube, robot, tmp_path: Path):
    candidates.save(tmp_path / "a.safetensors")
    assert_same(GraspCandidates.load(tmp_path / "a.safetensors", cube, robot), candidates)
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_fields_left_out_say_so(candidates: GraspCandidates, tmp_path: Path):
    names = ("object", "position", "quaternion", "approach", "pregrasp", "grasp", "grasp_class")
    plain = GraspCandidates(**{name: getattr(candidates, name) for name in names})
    assert torch.equal(plain.joints, plain.grasp)
    assert plain.contacts.shape == (COUNT, 0, 3)
    assert plain.contact_finger.shape == (COUNT, 0)
    assert plain.contact_map.shape == (COUNT, 0)
    assert plain.valid.all()
    assert plain.score.isnan().all()
    assert plain.penetration.isnan().all()
    assert plain.energy == {}
    plain.save(tmp_path / "plain.safetensors")
    assert b"map" not in (tmp_path / "plain.safetensors").read_bytes()  # the file is what it was before there were maps
    assert_same(GraspCandidates.load(tmp_path / "plain.safetensors"), plain)


def test_select_takes_masks_and_indices(candidates: GraspCandidates):
    by_index = candidates.select([5, 0])
    assert by_index.grasp_class == (candidates.grasp_class[5], candidates.grasp_class[0])
    for name, value in candidates.tensors().items():
        assert torch.equal(by_index.tensors()[name], value[[5, 0]])
    rim = candidates.select(candidates.of_class("RimGrasp"))
    assert rim.counts() == {"RimGrasp": COUNT // 2}
    assert torch.equal(rim.position, candidates.position[1::2])
    assert_same(candidates.select(torch.ones(COUNT, dtype=torch.bool)), candidates)
    assert len(candidates.select(slice(2))) == 2
    with pytest.raises(InputError, match="no grasp candidate for 'cube'"):
        candidates.select(torch.zeros(COUNT, dtype=torch.bool))


def test_concatenate_fills_what_a_set_lacks(candidates: GraspCandidates):
    few = replace(
        candidates.select([1, 2]),
        contacts=candidates.contacts[1:3, :2],
        contact_finger=candidates.contact_finger[1:3, :2],
        energy={"closure": torch.zeros(2), "joints": torch.ones(2)},
    )
    joined = concatenate([candidates, few])
    assert joined.grasp_class == candidates.grasp_class + few.grasp_class
    assert torch.equal(joined.position, torch.cat([candidates.position, few.position]))
    assert torch.equal(joined.contacts[COUNT:, :2], few.contacts)
    assert joined.contact_finger[COUNT:, 2:].eq(0).all()
    assert joined.energy["distance"][COUNT:].isnan().all()
    assert joined.energy["joints"][:COUNT].isnan().all()
    assert torch.equal(joined.energy["closure"][COUNT:], torch.zeros(2))
    assert_same(joined.select(slice(COUNT)).with_tensors(candidates.tensors(), candidates.grasp_class), candidates)
    with pytest.raises(InputError, match="different object"):
        concatenate([candidates, replace(candidates, object="jug")])


@pytest.mark.parametrize("name", ["position", "joints", "contacts"])
def test_what_is_not_finite_is_refused(candidates: GraspCandidates, name: str):
    broken = getattr(candidates, name).clone()
    broken.view(-1)[3] = torch.nan
    with pytest.raises(InputError, match=f"{name} holds a value that is not finite"):
        replace(candidates, **{name: broken})


def one_sentence(error: pytest.ExceptionInfo[InputError], words: str) -> None:
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_another_object_or_robot_is_refused(candidates: GraspCandidates, cube, robot, tmp_path: Path):
    path = tmp_path / "a.safetensors"
    cases = [
        (replace(candidates, object="jug"), "holds grasps of 'jug', not of 'cube'"),
        (replace(candidates, digest="0"), "another shape or labelling of 'cube'"),
        (replace(candidates, robot="ur5"), "for the robot 'ur5', not 'diana7_hit'"),
        (replace(candidates, robot_digest="0"), "another version of the hand of 'diana7_hit'"),
    ]
    for other, words in cases:
        other.save(path)
        GraspCandidates.load(path)
        with pytest.raises(InputError) as error:
            GraspCandidates.load(path, cube, robot)
        one_sentence(error, words)


def test_damage_is_noticed(candidates: GraspCandidates, tmp_path: Path):
    path = tmp_path / "a.safetensors"
    with pytest.raises(InputError) as error:
        GraspCandidates.load(path)
    one_sentence(error, "There is no dora-grasps 1 file")
    candidates.save(path)
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[-5] ^= 1
    for content, words in ((whole[:-40], "truncated"), (b"no tensors here", "truncated"), (bytes(flipped), "damaged")):
        path.write_bytes(content)
        with pytest.raises(InputError) as error:
            GraspCandidates.load(path)
        one_sentence(error, words)
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(InputError) as error:
        GraspCandidates.load(path)
    one_sentence(error, "no dora-grasps 1 file")


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("quaternion", 5.0, "norm is not 1"),
        ("approach", 100.0, "norm is not 1"),
        ("grasp", 1e5, "not below 10"),
        ("position", 1e4, "not below 1000"),
        ("penetration", torch.inf, "not from 0 to 1"),
        ("self_penetration", -1.0, "not from 0 to 1"),
        ("score", 1.5, "not from 0 to 1"),
    ],
)
def test_values_that_no_grasp_has_are_refused(
    candidates: GraspCandidates, tmp_path: Path, name: str, value: float, words: str
):
    broken = getattr(candidates, name).clone()
    broken[3] = value * broken[3] if name in ("quaternion", "approach") else value
    path = tmp_path / "a.safetensors"
    replace(candidates, **{name: broken}).save(path)
    with pytest.raises(InputError) as error:
        GraspCandidates.load(path)
    one_sentence(error, words)


def test_the_hand_digest_sees_the_hand_and_not_the_arm(robot: RobotDescription):
    joints = robot.model.joints
    arm, finger = robot.arm.names[2], robot.hand.names[5]

    def moved(name: str) -> RobotDescription:
        changed = replace(joints[name], upper=joints[name].upper + 0.01)
        return replace(robot, model=replace(robot.model, joints=joints | {name: changed}))

    assert hand_digest(moved(arm)) == hand_digest(robot)
    assert hand_digest(moved(finger)) != hand_digest(robot)
    link = robot.fingers["index"].distal
    assert hand_digest(replace(robot, shapes=robot.shapes | {link: ()})) != hand_digest(robot)
    assert hand_digest(replace(robot, shapes=robot.shapes | {robot.model.root: ()})) == hand_digest(robot)
