"""The steps that make up a grasp search, one by one; what they are made with, and the overlaps that are measured."""

from dataclasses import replace
from typing import Any

import pytest
import torch
import trimesh
from numba import njit
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import CHANNELS, SignedDistanceField
from dora.affordance.search.cache import field_of, forget, hand_of, initial_of, map_of
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.descent import Descent, Rows, Schedule
from dora.affordance.search.energies import RAMPED, Evaluation, GraspEnergy
from dora.affordance.search.initial_poses import InitialPoses, Spread
from dora.affordance.search.native.compiling import inlined, native
from dora.affordance.search.penetration import Penetration, self_penetration
from dora.affordance.search.search import LAST_STEP, POLISH_STEP, Search, Settings, fading
from dora.robot import load_robot

ROBOT, CUBE, JUG = load_robot("diana7_hit"), load_object("cube"), load_object("jug")
COUNT = 12


@pytest.fixture(scope="module")
def search() -> Search:
    hand = HandModel(ROBOT)
    energy = CompiledEnergy(hand, SignedDistanceField(CUBE.solid))
    return Search(energy, InitialPoses(CUBE, hand, None, Spread()), Settings())


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def recorded(descent: str, search: Search, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, Schedule]]:
    """Rows and schedule of each descent from now on."""
    original, seen = getattr(search, descent), []

    def record(rows: Rows, schedule: Schedule) -> None:
        seen.append((len(rows), schedule))
        original(rows, schedule)

    monkeypatch.setattr(search, descent, record)
    return seen


def test_steps_fade_from_all_to_almost_nothing():
    assert fading(0.0) == pytest.approx(1)
    assert fading(0.5) == pytest.approx((1 + LAST_STEP) / 2)
    assert fading(1.0) == pytest.approx(LAST_STEP)


def test_weights_of_overlaps_grow_in_the_last_part(search: Search, monkeypatch: pytest.MonkeyPatch):
    seen = recorded("descent", search, monkeypatch)
    search.run(COUNT, seeded(), lambda done: None)
    settings, steps = search.settings, search.settings.iterations
    assert [schedule.before for _, schedule in seen] == sorted({schedule.before for _, schedule in seen})
    assert seen[0][0] == settings.field_size * COUNT
    ramps = [ramp for _, schedule in seen for ramp in schedule.ramp]
    begin = round(settings.ramp_start * steps)
    assert ramps[: begin + 1] == [1.0] * (begin + 1)
    slope = (settings.ramp - 1) / (steps - begin)
    assert ramps[begin:] == pytest.approx([1 + slope * step for step in range(len(ramps) - begin)])
    sizes = [size for _, schedule in seen for size in schedule.size]
    assert sizes == pytest.approx([fading(step / steps) for step in range(len(sizes))])


def test_the_better_half_goes_on(search: Search, monkeypatch: pytest.MonkeyPatch):
    """Those whose energy is lowest when the field is halved."""
    monkeypatch.setattr(search, "settings", replace(search.settings, iterations=2, resample=5))
    before, after = [], []

    def descend(rows: Rows, schedule: Schedule) -> None:
        rows.total = torch.arange(len(rows)).float().roll(5) if not before else rows.total
        (after if before else before).append(rows)

    monkeypatch.setattr(search, "descent", descend)
    search.run(COUNT, seeded(), lambda done: None)
    best = before[0].total.argsort()[:COUNT]
    assert torch.equal(after[0].wrist, before[0].wrist[best])
    assert len(after[0]) == COUNT


def test_a_row_leaves_when_its_energy_rests_and_nothing_overlaps(search: Search, monkeypatch: pytest.MonkeyPatch):
    """Of four rows one rests, one rests but overlaps, one moves, and one does both."""
    monkeypatch.setattr(search, "settings", replace(search.settings, iterations=20, settle=0.0, field_size=1.0))
    seen = []

    def descend(rows: Rows, schedule: Schedule) -> None:
        seen.append(len(rows))
        number = rows.mean[:, 0]
        moving = 2 ** torch.tensor(float(len(seen)))
        rows.total = torch.where(number % 2 == 0, torch.ones_like(number), moving)
        rows.overlap = torch.where(number < 2, 0.0, 1e-3)

    def start(count: int, generator: torch.Generator) -> Rows:
        rows = Search.start(search, count, generator)
        rows.mean[:, 0] = torch.arange(count)
        return rows

    monkeypatch.setattr(search, "descent", descend)
    monkeypatch.setattr(search, "start", start)
    monkeypatch.setattr(search, "_resample", lambda *_: None)
    found = search.run(4, seeded(), lambda done: None)
    assert seen[0] == 4
    assert seen[-1] == 3
    assert sorted(found.mean[:, 0].tolist()) == [0, 1, 2, 3]
    assert found.mean[0, 0] == 0


def test_a_row_starts_as_the_best_of_its_draws(search: Search):
    rows, settings = search.start(COUNT, seeded()), search.settings
    wrist, joints = search.initial.draw(COUNT * settings.starts, generator := seeded())
    contacts = search.draw_contacts(COUNT * settings.starts, generator)
    total = search.energy(wrist, joints, contacts).total.view(settings.starts, COUNT)
    torch.testing.assert_close(rows.total, total.amin(0))
    torch.testing.assert_close(search.energy(rows.wrist, rows.joints, rows.contacts).total, total.amin(0))


def test_contacts_are_on_palm_and_thumb_and_every_finger(search: Search):
    parts = search.energy.hand.contact_part[search.draw_contacts(200, seeded())]
    assert (parts[:, 0] == 1).all()
    assert (parts[:, 1] == 2).all()
    assert torch.equal(parts[:, 2:6].sort(1).values, torch.tensor([3, 4, 5, 6]).expand(200, -1))
    assert set(parts[:, 6:].unique().tolist()) == {2, 3, 4, 5, 6}
    drawn = search.draw_contacts(4000, seeded()).unique()
    assert len(drawn) == len(search.energy.hand.contacts.body)


def test_new_contacts_stay_where_they_lower_the_energy(search: Search):
    rows = search.start(64, seeded())
    old, before = rows.contacts.clone(), search.energy(rows.wrist, rows.joints, rows.contacts, 3.0).total
    search._resample(rows, 3.0, seeded(1))
    after = search.energy(rows.wrist, rows.joints, rows.contacts, 3.0).total
    changed = (rows.contacts != old).any(1)
    assert 0 < changed.sum() < 64
    assert (after[changed] < before[changed]).all()
    share = (rows.contacts != old)[changed].float().mean()
    assert 0.3 < share < 0.6  # half of the points, of which some are drawn as they were


def test_polishing_takes_smaller_steps_with_full_weights(search: Search, monkeypatch: pytest.MonkeyPatch):
    seen = recorded("polishing", search, monkeypatch)
    rows = search.start(COUNT, seeded())
    rows.joints += 0.5
    found = search.polish(rows, 10)
    ((count, schedule),) = seen
    assert (count, schedule.before) == (COUNT, 0)
    assert schedule.ramp == [search.settings.ramp] * 10
    assert schedule.size == pytest.approx([POLISH_STEP * fading(step / 10) for step in range(10)])
    hand = search.energy.hand
    assert ((found.joints >= hand.lower) & (found.joints <= hand.upper)).all()


def test_a_search_ends_within_the_limits_of_the_joints(search: Search):
    """Even if descent leads out of them."""
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch:
        patch.setattr(search, "descent", lambda rows, schedule: rows.joints.add_(10))
        found = search.run(COUNT, seeded(), lambda done: None)
    assert torch.equal(found.joints, search.energy.hand.upper.expand_as(found.joints))


def test_the_nearest_contacts_are_the_palm_and_the_nearest_links(search: Search):
    rows, hand = search.start(COUNT, seeded()), search.energy.hand
    found = search.nearest_contacts(rows)
    gap = search.energy.field.distance(hand.place(hand.forward(rows.wrist, rows.joints), hand.contacts)).abs()
    for row, chosen in enumerate(found):
        bodies = hand.contacts.body[chosen]
        assert bodies[0] == 0
        assert len(bodies.unique()) == search.settings.contacts
        nearest = {int(body): float(gap[row, hand.contacts.body == body].min()) for body in hand.contacts.body.unique()}
        assert gap[row, chosen].tolist() == pytest.approx([nearest[int(body)] for body in bodies])
        left_out = [value for body, value in nearest.items() if body not in bodies.tolist()]
        assert max(gap[row, chosen[1:]]) <= min(left_out)


class Slope(GraspEnergy):
    """An energy with gradient 1 along every coordinate, in which each overlap is 1 m."""

    def __init__(self) -> None:
        pass

    def __call__(self, wrist: Tensor, joints: Tensor, contacts: Tensor, ramp: float = 1.0) -> Evaluation:
        count = len(joints)
        terms = {name: torch.ones(count) for name in RAMPED}
        return Evaluation(torch.full((count,), ramp), terms, torch.ones(count, 6), torch.ones_like(joints))


def test_adam_goes_down_by_its_largest_steps():
    """With a constant gradient every step of Adam is the largest one, whatever was before."""
    largest, turned = torch.linspace(0.01, 0.08, 8), torch.eye(4).repeat(2, 1, 1)
    turned[:, :3, :3] = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rows = Rows.begin(turned.clone(), torch.zeros(2, 2), torch.zeros(2, 1).long(), torch.zeros(2))
    Descent(Slope(), largest)(rows, Schedule(0, [1.0, 4.0], [1.0, 0.5]))
    torch.testing.assert_close(rows.joints, -1.5 * largest[6:].expand(2, -1), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(rows.wrist[:, :3, 3], -1.5 * largest[:3].expand(2, -1), rtol=1e-4, atol=1e-6)
    turn = rows.wrist[0, :3, :3] @ turned[0, :3, :3].T  # in the object frame, small angles
    vector = torch.stack((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2
    torch.testing.assert_close(vector, -1.5 * largest[3:6], rtol=2e-2, atol=1e-3)
    assert rows.total.tolist() == [4.0, 4.0]
    assert rows.overlap.tolist() == [3.0, 3.0]


def test_rows_can_be_taken_apart_and_joined(search: Search):
    rows = search.start(COUNT, seeded())
    again = Rows.join([rows.select(torch.arange(4)), rows.select(torch.arange(COUNT) >= 4)])
    for name, value in vars(rows).items():
        assert torch.equal(getattr(again, name), value), name


def test_what_is_kept_belongs_to_the_region(search: Search):
    handle, free = field_of(JUG, "handle", "cpu"), field_of(JUG, None, "cpu")
    assert handle.table.shape[1] == CHANNELS + 1
    assert free.table.shape[1] == CHANNELS
    spread = Spread(gap=(0.1, 0.2))
    starts = initial_of(JUG, ROBOT, "handle", spread, "cpu")
    assert starts.spread == spread
    assert starts.hand is hand_of(ROBOT, "cpu")
    surface = JUG.region("handle")
    distance = trimesh.proximity.closest_point(surface, starts.points.double().numpy())[1]
    assert distance.max() < 1e-4
    assert initial_of(JUG, ROBOT, "handle", Spread(), "cpu") is not starts
    assert map_of(JUG, "cpu").names == JUG.labels


def test_everything_is_forgotten():
    def kept() -> tuple[object, ...]:
        spread = Spread()
        return (
            hand_of(ROBOT, "cpu"), field_of(CUBE, None, "cpu"), initial_of(CUBE, ROBOT, None, spread, "cpu"),
            map_of(CUBE, "cpu"),
        )  # fmt: skip

    first, second = kept(), kept()
    assert all(a is b for a, b in zip(first, second, strict=True))
    forget()
    assert not any(a is b for a, b in zip(first, kept(), strict=True))


def test_the_depth_of_a_hand_in_a_ball_is_known():
    """A ball around a point on the axis of a capsule overlaps by the sum of the radii; far away it does not."""
    hand, radius = HandModel(ROBOT), 0.01
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    measure = Penetration(hand, SignedDistanceField(ball))
    wrist = torch.eye(4).repeat(3, 1, 1)
    joints = torch.zeros(3, len(hand.lower))
    ends = hand.place(hand.forward(wrist, joints), hand.ends)[0]
    tip = (hand.ends.body == hand.ends.body.max()).nonzero()[-1, 0]
    outward = torch.nn.functional.normalize(ends[tip] - ends[tip - 1], dim=0)
    reach = float(hand.radius[tip // 2]) + radius
    for row, depth in enumerate((0.003, 0.001, -0.001)):  # of the fingertip in the ball
        wrist[row, :3, 3] = -(ends[tip] + (reach - depth) * outward)
    found = measure(hand.forward(wrist, joints))
    assert found.tolist() == pytest.approx([0.003, 0.001, 0.0], abs=2e-4)
    assert found[2] == 0


def test_the_overlap_of_the_hand_with_itself_is_that_of_the_worst_pair():
    hand = HandModel(ROBOT)
    energy = GraspEnergy(hand, SignedDistanceField(CUBE.solid))
    joints = torch.zeros(2, len(hand.lower))
    joints[1] = torch.where(hand.lower < 0, 0.0, hand.upper)
    joints[1, :3] = hand.upper[:3]
    poses = hand.forward(torch.eye(4).repeat(2, 1, 1), joints)
    total = energy.self_penetration(poses)[0]
    found = self_penetration(energy, poses)
    assert found[0] == total[0] == 0
    assert 0 < found[1] < total[1]
    ends = hand.place(poses, hand.ends)[1]
    share = torch.linspace(0, 1, 101)[:, None]
    axes = [ends[2 * c] + share * (ends[2 * c + 1] - ends[2 * c]) for c in range(len(hand.radius))]
    overlaps = [
        float(hand.radius[a] + hand.radius[b] - torch.cdist(axes[a], axes[b]).min()) for a, b in hand.pairs.tolist()
    ]
    assert float(found[1]) == pytest.approx(max(overlaps), abs=2e-4)


def test_functions_are_compiled_where_nothing_can_be_kept():
    """Neither beside the code nor in the user's folder; here because the code is in no file."""
    code: dict[str, Any] = {}
    exec("def double(x): return 2 * x", code)
    with pytest.raises(RuntimeError, match="no locator available"):
        njit(cache=True)(code["double"])
    assert (native(code["double"])(3), inlined(code["double"])(4)) == (6, 8)
