"""The grasp search: reproducible, better than its start, conditioned on a region, on objects of any origin."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.hand.postures import pregrasp, squeeze
from dora.affordance.maps.contact_semantic_map import pressed_contacts, wrist_matrix
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.importing import import_object
from dora.affordance.objects.signed_distance import ExactDistance, SignedDistanceField
from dora.affordance.search.cache import field_of, forget, hand_of
from dora.affordance.search.compiled import CompiledDescent, CompiledEnergy
from dora.affordance.search.descent import Descent, Schedule
from dora.affordance.search.energies import GraspEnergy, Weights
from dora.affordance.search.initial_poses import InitialPoses, Spread
from dora.affordance.search.optimise import opened, optimise, table_of
from dora.affordance.search.quasi_static_closing import close_hand
from dora.affordance.search.search import Search, Settings
from dora.errors import InputError

COUNT = 12
SHORT = Settings(iterations=60, starts=3)


@pytest.fixture(scope="module")
def cube(robot):
    return optimise(load_object("cube"), robot, COUNT, seed=0, settings=SHORT)


def test_equal_seeds_give_equal_candidates(robot, cube):
    again = optimise(load_object("cube"), robot, COUNT, seed=0, settings=SHORT)
    for name, value in cube.tensors().items():
        assert torch.equal(value, again.tensors()[name]) or value.isnan().all(), name
    other = optimise(load_object("cube"), robot, COUNT, seed=1, settings=SHORT)
    assert not torch.equal(other.position, cube.position)


def test_candidates_are_complete(robot, cube):
    assert len(cube) == COUNT
    assert torch.allclose(cube.quaternion.norm(dim=-1), torch.ones(COUNT), atol=1e-4)
    assert torch.allclose(cube.approach.norm(dim=-1), torch.ones(COUNT), atol=1e-4)
    lower, upper = torch.tensor(robot.hand.lower), torch.tensor(robot.hand.upper)
    for joints in (cube.joints, cube.pregrasp, cube.grasp):
        assert ((joints >= lower - 1e-6) & (joints <= upper + 1e-6)).all()
    assert torch.equal(cube.valid, cube.penetration <= STANDARD.penetration)
    assert set(cube.grasp_class) <= {"BodyGrasp", "NoContact"}


def test_contacts_are_those_of_the_hand_closed_by_the_model(robot, cube):
    """Other contacts than at the candidate's posture, and the parts of the hand that press in the model."""
    hand, obj = HandModel(robot), load_object("cube")
    field = SignedDistanceField(obj.solid)
    wrist = wrist_matrix(cube.position, cube.quaternion)
    postures = pregrasp(robot, cube.joints), squeeze(robot, cube.joints)
    held = close_hand(CompiledEnergy(hand, field), wrist, *postures, obj.mass)
    points, finger = pressed_contacts(hand, field, hand.forward(held.wrist, robot.reduce_hand(held.joints)))
    assert (field.distance(cube.contacts[cube.contact_finger > 0]).abs() < 1e-3).all()
    same = 0
    for row in range(COUNT):
        ours, again = cube.contacts[row][cube.contact_finger[row] > 0], points[row][finger[row] > 0]
        same += ours.shape == again.shape and torch.allclose(ours, again, atol=1e-3)
    assert same >= 0.75 * COUNT  # the model is steep where contacts begin, and poses were rounded


def test_search_lowers_the_energy_and_the_penetration(robot):
    cube = load_object("cube")
    start = optimise(cube, robot, COUNT, seed=0, settings=Settings(iterations=1, starts=1, field_size=1.0, seat=0.0))
    end = optimise(cube, robot, COUNT, seed=0, settings=Settings(iterations=120))
    for term in ("closure", "distance"):
        assert end.energy[term].median() < start.energy[term].median()
    assert end.penetration.median() < 1e-3 < start.penetration.median()


def test_hand_stays_above_the_table(robot, cube):
    hand = HandModel(robot)
    up = torch.tensor(table_of(load_object("cube")).normal)
    poses = hand.forward(wrist_matrix(cube.position, cube.quaternion), robot.reduce_hand(cube.joints))
    lowest = (hand.place(poses, hand.spheres) @ up - hand.sphere_radius).amin(1) + load_object("cube").support
    assert (lowest > -2e-3).float().mean() > 0.7


def test_penetration_is_that_of_the_mesh(robot, cube):
    hand = HandModel(robot)
    spheres, radius = hand.sphere_set(sagitta=5e-5)
    poses = hand.forward(wrist_matrix(cube.position, cube.quaternion), robot.reduce_hand(cube.joints))
    exact = ExactDistance(load_object("cube").solid)(hand.place(poses, spheres).flatten(0, 1).double().numpy())
    depth = (radius.numpy() - exact.reshape(COUNT, -1)).max(1).clip(min=0)
    np.testing.assert_allclose(cube.penetration.numpy(), depth, atol=1.5e-4)


def test_region_is_held(robot):
    found = optimise(load_object("jug"), robot, COUNT, seed=0, region="handle", settings=SHORT)
    assert found.grasp_class.count("HandleGrasp") >= 0.75 * COUNT
    with pytest.raises(InputError, match="no region"):
        optimise(load_object("jug"), robot, COUNT, seed=0, region="lid")


@pytest.mark.parametrize(("field_size", "iterations"), [(1.0, 10), (2.0, 10), (2.0, 7), (1.3, 1)])
def test_progress_reaches_its_end_unless_rows_settle(robot, field_size: float, iterations: int):
    seen = []
    optimise(
        load_object("cube"),
        robot,
        4,
        seed=0,
        settings=Settings(
            iterations=iterations, starts=1, field_size=field_size, settle=1.0, oversampling=1.0, batch=3
        ),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen[-1][0] == seen[-1][1]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_fingers_open_only_as_far_as_there_is_room(robot):
    hand = HandModel(robot)
    energy = GraspEnergy(hand, SignedDistanceField(trimesh.creation.box((0.06, 0.06, 0.06))))
    joints = torch.tensor(robot.postures["home"].hand).float()[None]
    far = torch.eye(4)[None].clone()
    far[0, 0, 3] = 1.0
    assert torch.allclose(opened(energy, far, joints), pregrasp(robot, joints))
    behind = torch.eye(4)[None].clone()
    behind[0, :3, 3] = torch.tensor([0.03, 0.0, -0.2])
    narrow = opened(energy, behind, joints)
    assert ((narrow - joints).abs() <= (pregrasp(robot, joints) - joints).abs() + 1e-6).all()


def test_settled_rows_leave_and_none_is_lost(robot):
    hand = HandModel(robot)
    cube = load_object("cube")
    settings = Settings(iterations=80, settle=0.1, field_size=1.0)
    energy = CompiledEnergy(hand, SignedDistanceField(cube.solid))
    search = Search(energy, InitialPoses(cube, hand, None, Spread()), settings)
    done = []
    rows = search.run(COUNT, torch.Generator().manual_seed(0), done.append)
    assert len(rows) == COUNT
    assert sum(done) < COUNT * settings.iterations


@pytest.mark.parametrize("kind", [GraspEnergy, CompiledEnergy])
def test_only_the_better_rows_stay(robot, kind):
    hand = HandModel(robot)
    cube = load_object("cube")
    settings = Settings(iterations=4, starts=1, field_size=3.0)
    search = Search(kind(hand, SignedDistanceField(cube.solid)), InitialPoses(cube, hand, None, Spread()), settings)
    done = []
    assert len(search.run(COUNT, torch.Generator().manual_seed(0), done.append)) == COUNT
    assert sum(done) == 2 * 3 * COUNT + 2 * COUNT


def test_compiled_descent_takes_the_steps_of_the_definition(robot):
    hand = HandModel(robot)
    cube = load_object("cube")
    energy = CompiledEnergy(hand, SignedDistanceField(cube.solid), table=table_of(cube))
    search = Search(energy, InitialPoses(cube, hand, None, Spread()), Settings())
    start = search.start(COUNT, torch.Generator().manual_seed(0))
    schedule = Schedule(3, [1.0, 2.0, 3.0], [1.0, 0.8, 0.6])
    ends = []
    for kind in (Descent, CompiledDescent):
        rows = start.select(torch.arange(COUNT))
        rows.mean += 0.1
        rows.square += 10.0
        kind(energy, search.descent.largest)(rows, schedule)
        ends.append(rows)
    for name in ("wrist", "joints", "mean", "square", "total", "overlap"):
        torch.testing.assert_close(getattr(ends[1], name), getattr(ends[0], name), rtol=2e-3, atol=2e-5, msg=name)
    assert not torch.equal(ends[1].wrist, start.wrist)


def test_terms_without_weight_do_not_act_in_a_descent(robot):
    hand = HandModel(robot)
    cube = load_object("cube")
    energy = CompiledEnergy(hand, SignedDistanceField(cube.solid), Weights(closure=0.0, closing=0.0))
    rows = Search(energy, InitialPoses(cube, hand, None, Spread()), Settings()).start(
        COUNT, torch.Generator().manual_seed(0)
    )
    found = energy(rows.wrist, rows.joints, rows.contacts)
    assert (found.terms["closure"] > 0).any()
    CompiledDescent(energy, torch.zeros(6 + rows.joints.shape[1]))(rows, Schedule(0, [1.0], [1.0]))
    torch.testing.assert_close(rows.total, found.total)
    torch.testing.assert_close(rows.mean, 0.1 * torch.cat((found.wrist, found.joints), 1), rtol=1e-4, atol=1e-3)


def test_candidates_hardly_penetrate(robot):
    found = optimise(load_object("cube"), robot, 32, seed=1, region="body")
    assert found.penetration.quantile(0.9) < 1e-3
    assert found.valid.all()


def test_a_second_call_prepares_nothing_anew(robot):
    cube = load_object("cube")
    assert field_of(cube, None, "cpu") is field_of(cube, None, "cpu")
    assert field_of(cube, "body", "cpu") is not field_of(cube, None, "cpu")
    assert field_of(replace(cube), None, "cpu") is not field_of(cube, None, "cpu")
    kept = hand_of(robot, "cpu")
    forget()
    assert hand_of(robot, "cpu") is not kept


def test_an_imported_mesh_goes_through(robot, tmp_path):
    path = tmp_path / "bowl.stl"
    trimesh.creation.capsule(height=0.06, radius=0.022).export(path)
    found = optimise(import_object(path), robot, 4, seed=0, settings=Settings(iterations=20, starts=1))
    assert len(found) == 4


@pytest.mark.parametrize("wrong", ["iterations", "contacts", "resample", "starts", "batch"])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(InputError, match=wrong):
        replace(Settings(), **{wrong: 0})


def test_no_candidate_is_refused(robot):
    with pytest.raises(InputError, match="at least 1"):
        optimise(load_object("cube"), robot, 0, seed=0)
