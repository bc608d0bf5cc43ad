"""Guidance part by part: which candidates are chosen, how actions correct, what noise and pushes do."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from invented import invented

import dora.tasks as tasks
from dora.affordance.candidates import GraspCandidates
from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks import cube, jug
from dora.tasks.cube import CubeConfig
from dora.tasks.env.perturbations import Perturbations, uniform
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.guidance.grasp_and_lift import DESCEND, GraspReference, GraspSettings
from dora.tasks.guidance.residual_action import SMOOTHING, ResidualAction, Target
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.task import OBSERVATIONS as OF_HAMMER
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.jug import JugConfig
from dora.tasks.mdp.config import ResidualBounds
from dora.tasks.mdp.guidance_parts import PARTS
from dora.tasks.mdp.randomisation import PRESETS, Randomisation
from dora.tasks.microwave import mdp as microwave
from dora.tasks.microwave.mdp import MicrowaveConfig

CPU = torch.device("cpu")
IDENTITY = torch.tensor([[1.0, 0.0, 0.0, 0.0]])


def along_x(*x: float, score: tuple[float, ...] | None = None) -> GraspCandidates:
    """Candidates at places along x [m]."""
    n = len(x)
    position = torch.zeros(n, 3)
    position[:, 0] = torch.tensor(x)
    hand = torch.zeros(n, 20)
    made = GraspCandidates(
        "thing", position, IDENTITY.repeat(n, 1), torch.tensor([[0.0, 0, -1]]).repeat(n, 1), hand, hand + 1,
        ("Grasp",) * n,
    )  # fmt: skip
    return made if score is None else replace(made, score=torch.tensor(score))


def nearest(candidates: GraspCandidates, reachable: list[bool], wrist_x: float = 0.0) -> list[int]:
    choice, zero = CandidateChoice(candidates, 1, CPU), torch.zeros(1, 3)
    wrist = torch.tensor([[wrist_x, 0.0, 0.0]])
    return choice.nearest(zero, IDENTITY, wrist, IDENTITY, torch.tensor([reachable])).tolist()[0]


def test_the_nearest_reachable_candidates_are_chosen():
    four = along_x(0.1, 0.2, 0.3, 0.4)
    assert nearest(four, [True] * 4) == [0, 1, 2]
    assert nearest(four, [True] * 4, wrist_x=0.38) == [3, 2, 1]
    assert nearest(four, [False, True, False, True]) == [1, 3, 1]  # the first is repeated
    assert nearest(along_x(0.1, 0.2), [True, True], wrist_x=1.0) == [1, 0, 1]


def test_well_ranked_candidates_come_first():
    ranked = along_x(0.1, 0.2, 0.3, 0.4, score=(0.3, 0.9, 0.95, 1.0))
    assert nearest(ranked, [True] * 4) == [1, 2, 3]
    assert nearest(ranked, [True, False, False, False]) == [0, 0, 0]


def test_candidate_errors_are_bounded_and_follow_the_share():
    candidates, preset = along_x(0.1, 0.2, 0.3), PRESETS["hard"]
    n = 500
    choice = CandidateChoice(candidates, n, CPU)
    error = 2 * torch.rand(n, 26, generator=torch.Generator().manual_seed(0)) - 1
    index = torch.arange(3).repeat(n, 1)
    rows, able = torch.arange(n), torch.ones(n, dtype=torch.bool)
    choice.choose(rows, index, able, error, preset)
    off = choice.buffers.position - candidates.position
    assert off.abs().max() <= preset.candidate_position
    assert off.std(0).min() > 0.4 * preset.candidate_position
    torch.testing.assert_close(off[:, 0], off[:, 1], atol=1e-6, rtol=0)  # one error for all of an environment
    choice.error_scale = 0.5
    choice.choose(rows, index, able, error, preset)
    half = choice.buffers.position - candidates.position
    torch.testing.assert_close(half, off / 2, atol=1e-6, rtol=0)


def test_corrections_are_low_passed_bounded_and_in_the_hand_frame():
    bounds = ResidualBounds(position=0.02, rotation=0.1, joint=0.2)
    correction = ResidualAction(1, 26, bounds, CPU)
    quarter = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]])  # hand x is world y
    target = Target(torch.zeros(1, 3), quarter, torch.zeros(1, 20))
    action = torch.zeros(1, 26)
    action[0, 0], action[0, 6:] = 1.0, -1.0
    first = correction.apply(target, action, lambda hand: hand)
    torch.testing.assert_close(first.wrist_p, torch.tensor([[0.0, SMOOTHING * 0.02, 0.0]]), atol=1e-7, rtol=0)
    for _ in range(60):
        last = correction.apply(target, action, lambda hand: hand)
    torch.testing.assert_close(last.wrist_p, torch.tensor([[0.0, 0.02, 0.0]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(last.hand, torch.full((1, 20), -0.2), atol=1e-6, rtol=0)
    correction.set_scale(0.5)
    halved = correction.apply(target, action, lambda hand: hand)
    torch.testing.assert_close(halved.wrist_p, torch.tensor([[0.0, 0.01, 0.0]]), atol=1e-6, rtol=0)
    left = correction.apply(target, action, lambda hand: hand, torch.tensor([0.4]))
    torch.testing.assert_close(left.wrist_p, torch.tensor([[0.0, 0.004, 0.0]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(left.hand, torch.full((1, 20), -0.04), atol=1e-6, rtol=0)
    with pytest.raises(InputError, match="between 0 and 1"):
        correction.set_scale(1.5)


def test_the_hand_stays_higher_until_it_has_turned():
    turn = torch.zeros(3, 3)
    turn[:, 1] = torch.tensor([0.0, 0.5, 1.0])
    goal_p = torch.tensor([[0.1, 0.2, 0.3]]).repeat(3, 1)
    s = invented(
        3, wrist_q=quaternion_from_rotation_vector(turn), goal_p=goal_p, goal_approach=-torch.eye(3)[[2, 2, 2]]
    )
    for hover, rise in ((0.0, [0.0, 0.0, 0.0]), (0.06, [0.0, 0.03, 0.06])):
        reference = GraspReference(3, 0.05, CPU, GraspSettings(hover=hover))
        reference.begin(torch.arange(3), goal_p, s.hand.wrist_q)
        expected = goal_p.clone()
        expected[:, 2] += GraspSettings().standoff + torch.tensor(rise)
        torch.testing.assert_close(reference.target(s).wrist_p, expected)
        reference.phase.index.fill_(DESCEND)
        assert (reference.target(s).wrist_p[:, 2] == expected[0, 2]).all()


def test_noise_is_a_function_of_key_and_step_and_looks_uniform():
    keys = torch.arange(200)
    a = uniform(keys, torch.full((200,), 3), 26)
    assert torch.equal(a, uniform(keys, torch.full((200,), 3), 26))
    assert not torch.equal(a, uniform(keys, torch.full((200,), 4), 26))
    assert torch.equal(uniform(keys[7:8], torch.tensor([3]), 26)[0], a[7])  # whatever the others do
    assert a.min() >= 0
    assert a.max() < 1
    assert abs(a.mean() - 0.5) < 0.02
    assert abs(a.std() - 12**-0.5) < 0.02
    both = torch.stack([a.flatten()[:-1], a.flatten()[1:]])
    assert torch.corrcoef(both)[0, 1].abs() < 0.05
    steps = torch.stack([uniform(keys[:1], torch.tensor([k]), 4)[0] for k in range(500)])
    assert torch.corrcoef(torch.cat([steps[:-1], steps[1:]], 1).T)[:4, 4:].abs().max() < 0.2


def test_what_is_seen_is_noisy_within_the_preset_and_the_truth_is_kept():
    preset, n = PRESETS["standard"], 300
    noise = Perturbations(preset, n, 26, {"arm": 20}, 0.05, CPU)
    noise.begin(torch.arange(n), torch.rand(n, generator=torch.Generator().manual_seed(0)))
    choice = CandidateChoice(along_x(0.1), n, CPU)
    s = invented(n)
    seen = noise.observed(s, {"arm": choice}, torch.zeros(n, dtype=torch.long))
    assert seen.object.p.abs().max() <= preset.observed_position
    assert seen.object.p.std() > 0.4 * preset.observed_position
    assert 0 < seen.hand.q.abs().max() <= preset.observed_joint
    assert torch.equal(s.object.p, torch.zeros(n, 3))
    assert torch.equal(s.hand.q, torch.zeros(n, 20))
    torch.testing.assert_close(seen.goal.p, choice.goals(seen.object.p, seen.object.q)[0][:, 0])
    assert torch.equal(seen.hand.touch, s.hand.touch)
    clear = Perturbations(PRESETS["none"], n, 26, {"arm": 20}, 0.05, CPU)
    assert clear.observed(s, {"arm": choice}, torch.zeros(n, dtype=torch.long)) is s


def test_a_filtered_pose_is_the_running_mean_of_what_was_measured():
    preset, n, share = PRESETS["standard"], 300, 0.2
    keys = torch.rand(n, generator=torch.Generator().manual_seed(0))
    raw, filtered = (Perturbations(preset, n, 26, {"arm": 20}, 0.05, CPU, share) for share in (1.0, share))
    choice, s = {"arm": CandidateChoice(along_x(0.1), n, CPU)}, invented(n)
    assert "arm_count" in filtered.buffers
    assert "arm_count" not in raw.buffers
    measured, spread = [], []
    for one in (raw, filtered):
        one.begin(torch.arange(n), keys)
    for k in range(30):
        step = torch.full((n,), k)
        measured.append(raw.observed(s, choice, step).object.p)
        seen = filtered.observed(s, choice, step)
        assert torch.equal(filtered.observed(s, choice, step).object.p, seen.object.p)  # a read changes nothing
        filtered.remember(seen)
        spread.append(float(seen.object.p.std()))
        if k < 1 / share - 1:
            torch.testing.assert_close(seen.object.p, torch.stack(measured).mean(0))
        torch.testing.assert_close(seen.object.q.norm(dim=-1), torch.ones(n))
        torch.testing.assert_close(seen.goal.p, choice["arm"].goals(seen.object.p, seen.object.q)[0][:, 0])
    expected = (share / (2 - share)) ** 0.5  # of an exponential mean of independent errors
    assert spread[-1] / spread[0] == pytest.approx(expected, rel=0.15)
    moved = invented(n, object_p=torch.full((n, 3), 0.2))
    far = filtered.observed(moved, choice, torch.full((n,), 30)).object.p
    assert torch.equal(far, raw.observed(moved, choice, torch.full((n,), 30)).object.p)
    filtered.begin(torch.arange(n), keys)
    assert torch.equal(filtered.observed(s, choice, torch.zeros(n).long()).object.p, measured[0])


def test_a_restored_episode_goes_on_with_its_estimate():
    task = tasks.make_task("DoraJug-v1", 3, config={"pose_filter": 0.15})
    task.reset(seed=0)
    for _ in range(6):
        task.step(task.scripted_action())
    state, seen = task.get_state_dict(), task.observed.objects["jug"].p
    task.reset(seed=1)
    task.set_state_dict(state)
    torch.testing.assert_close(task.observed.objects["jug"].p, seen, atol=1e-6, rtol=0)
    task.close()


@pytest.mark.parametrize("env_id", ["DoraJug-v1", "DoraHammer-v1", "DoraMicrowave-v1"])
def test_the_place_of_a_candidate_on_its_object_has_no_noise_and_stays_the_same_while_it_is_in_force(env_id: str):
    """Also while the object moves; it is that of the stored candidate, off by at most the preset's error."""
    task = tasks.make_task(env_id, 4, config={"observe_candidate": True})
    task.reset(seed=0)
    entries = {name: e for name, e in task.observation_entries.items() if name.endswith("candidate")}
    assert len(entries) == len(task.task_scene.arms)
    first = {name: entry.value(task.observed) for name, entry in entries.items()}
    error = task.config.randomisation.candidate_position
    for place, arm in zip(first.values(), task.task_scene.arms.values(), strict=True):
        choice = arm.guide.choice
        off = place[:, :3] - choice.candidates.position[choice.buffers.chosen.long()]
        assert 0.1 * error < off.abs().max() < error + 1e-6
        assert off.std(0).min() > 0.1 * error  # other episodes have other errors
    start = {name: pose.p.clone() for name, pose in task.observed.objects.items()}
    for _ in range(15):
        task.step(task.scripted_action())
    for name, pose in task.observed.objects.items():  # it moves, or is measured elsewhere
        assert (pose.p - start[name]).norm(dim=-1).min() > 1e-4
    for name, entry in entries.items():
        torch.testing.assert_close(entry.value(task.observed), first[name], atol=1e-5, rtol=0)
    task.close()


def test_no_action_of_an_episode_takes_effect_in_the_next():
    late = Perturbations(Randomisation(delay=1), 2, 1, {"arm": 20}, 0.05, CPU)
    late.delayed(torch.full((2, 1), 0.7), torch.zeros(2, dtype=torch.long))
    late.begin(torch.tensor([1]), torch.tensor([0.5]))
    done = late.delayed(torch.full((2, 1), 0.2), torch.tensor([1, 1]))  # a first step without an action came before
    assert done[:, 0].tolist() == pytest.approx([0.7, 0.0])


def test_delayed_actions_take_effect_later_and_the_first_at_once():
    late = Perturbations(Randomisation(delay=2), 1, 1, {"arm": 20}, 0.05, CPU)
    done = [late.delayed(torch.tensor([[float(k)]]), torch.tensor([k])).item() for k in range(6)]
    assert done == [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]


def test_pushes_come_at_their_rate_with_their_impulse_in_all_directions():
    preset, n, steps = PRESETS["hard"], 100, 200
    pushes = Perturbations(preset, n, 26, {"arm": 20}, 0.05, CPU)
    pushes.begin(torch.arange(n), torch.rand(n, generator=torch.Generator().manual_seed(1)))
    all_steps = torch.stack([pushes.pushes(torch.full((n,), k))[:, 0] for k in range(steps)]).flatten(0, 1)
    hit = all_steps.norm(dim=-1) > 0
    assert hit.sum() / (n * steps / 20) == pytest.approx(preset.push_rate, rel=0.2)
    torch.testing.assert_close(all_steps[hit].norm(dim=-1), torch.full((int(hit.sum()),), preset.push))
    assert all_steps[hit].mean(0).norm() < 0.2 * preset.push


def test_a_push_moves_the_object_by_impulse_over_mass():
    task = tasks.make_task("DoraCube-v1", 2, preset="none")
    task.reset(seed=0)
    start = task.snapshot.object.p.clone()
    task.task_scene.push(torch.tensor([[[0.06, 0.0, 0.0]], [[0.0, 0.0, 0.0]]]))
    task.step(torch.zeros(2, task.action_size))
    moved = task.snapshot.object.p - start
    assert moved[0, 0] > 0.005
    assert moved[1].norm() < 1e-3
    task.close()


@pytest.mark.parametrize("missing", PARTS)
def test_each_part_of_guidance_can_be_left_out(missing: str):
    whole = tasks.make_task("DoraCube-v1", 2)
    task = tasks.make_task("DoraCube-v1", 2, guidance_parts=tuple(p for p in PARTS if p != missing))
    gone = set(whole.observation_entries) - set(task.observation_entries)
    expected = {
        "observation": {"goal", "goal_hand", "nearest", "surface"},
        "prior": {"phase", "residual"},
    }
    assert gone == expected.get(missing, set())
    lost = set(whole.terms.terms) - set(task.terms.terms)
    assert lost == ({"affordance", "candidate"} if missing == "reward" else set())
    assert task.arm.takes_residual == (missing != "prior")
    assert ("unreachable" in task.logged) == (missing != "filter")
    a, b = whole.reset(seed=3), task.reset(seed=3)
    torch.testing.assert_close(whole.snapshot.object.p, task.snapshot.object.p, atol=0, rtol=0)
    assert len(a[0]) == len(b[0])
    whole.close()
    task.close()


@pytest.mark.parametrize(
    "options", [{"guidance_parts": ("magic",)}, {"guidance": "none", "guidance_parts": ("prior",)}]
)
def test_bad_parts_are_refused(options: dict):
    with pytest.raises(InputError, match="part"):
        tasks.make_task("DoraCube-v1", 1, **options)


@pytest.mark.parametrize("parts", [None, ("observation", "reward", "prior")])
def test_a_start_without_a_reachable_candidate_fails_and_earns_nothing(parts: tuple[str, ...] | None):
    task = tasks.make_task("DoraCube-v1", 3, guidance_parts=parts)
    able = torch.tensor([[True], [False], [True]])
    count = len(task.guide.choice.candidates)
    task.task.reachable = lambda arm, rows, p, q: able[rows].expand(-1, count)
    task.reset(seed=0)
    _, reward, terminated, _, info = task.step(torch.zeros(3, task.action_size))
    filtered = parts is None
    assert info["unreachable"].tolist() == [False, filtered, False]
    assert terminated.tolist() == [False, filtered, False]
    assert (reward == 0).tolist() == [False, filtered, False]
    assert (reward[[0, 2]] > 0).all()
    task.close()


def test_annealed_shares_survive_a_reset():
    task = tasks.make_task("DoraCube-v1", 2)
    task.reset(seed=0)
    task.anneal(bounds=0.25, error=0.5)
    task.reset(seed=1)
    assert (task.guide.residual.scale, task.guide.choice.error_scale) == (0.25, 0.5)
    with pytest.raises(InputError):
        task.anneal(error=2.0)
    task.close()


def test_the_hand_closes_to_the_grasp_and_no_further():
    """Also in the time for which it is held closed before it is raised."""
    settings, up = GraspSettings(), torch.tensor([[0.0, 0.0, -1.0]])
    reference = GraspReference(1, 0.05, CPU, settings)
    s = invented(1, goal_grasp=torch.ones(1, 20), goal_approach=up)
    reference.begin(torch.arange(1), s.hand.wrist_p, s.hand.wrist_q)
    closed = []
    for _ in range(60):
        target = reference.target(s)
        reference.aim(target)
        s = invented(1, goal_grasp=torch.ones(1, 20), goal_approach=up, wrist_p=target.wrist_p, wrist_q=target.wrist_q)
        reference.advance(s)
        closed.append(float(target.hand.max()))
    assert closed[0] == 0
    assert max(closed) == 1


@pytest.mark.parametrize("mdp", [cube, jug, hammer, microwave])
def test_what_knows_regions_exists_with_guidance_only(mdp: Any):
    """So that guidance without its reward, or without its observations, leaves it out as well."""
    config = {cube: CubeConfig, jug: JugConfig, hammer: HammerConfig, microwave: MicrowaveConfig}[mdp]()
    observations = OF_HAMMER if mdp is hammer else mdp.OBSERVATIONS
    every = [*mdp.terms(config).terms.values(), *mdp.paper_terms(config).terms.values(), *observations.values()]
    assert sum(one.region for one in every) >= 2
    assert all(one.guided for one in every if one.region)
