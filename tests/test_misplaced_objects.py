"""Objects that are not where they are measured: the error of a candidate as one of its object's pose."""

import dataclasses

import pytest
import torch
from invented import invented
from test_env_values import STEP
from test_guidance import CPU, along_x
from test_guidance_values import IDENTITY, turned
from test_oracle import SETTLED

from dora import tasks
from dora.agents.runs.recommended import recommended
from dora.configs import plain
from dora.geometry.poses import compose, relative
from dora.geometry.rotations import rotation_angle
from dora.tasks.env.options import task_config
from dora.tasks.env.perturbations import Perturbations
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.guidance.residual_action import Target
from dora.tasks.jug import JugConfig
from dora.tasks.mdp.quantities import lifted
from dora.tasks.mdp.randomisation import Randomisation
from dora.tools import oracle

UNNOISY = {"randomisation": {"observed_position": 0.0, "observed_rotation": 0.0, "observed_joint": 0.0}}
"""Poses are measured without noise, so that the error which stays is all there is."""
HANDS = {"arm": 20}
"""One arm, whose hand has twenty joints."""


def test_a_misplaced_object_is_seen_where_the_error_of_its_candidates_puts_it():
    """In the world by the position's numbers, about its own axes by those of the rotation; fingers keep theirs."""
    r = Randomisation(candidate_position=0.1, candidate_rotation=0.2)
    made, choice = Perturbations(r, 2, 26, HANDS, 0.05, CPU, misplaced=True), CandidateChoice(along_x(0.1), 2, CPU)
    error = torch.zeros(1, 26)
    error[0, 1], error[0, 5], error[0, 9] = 1.0, -0.5, 0.7
    left = made.misplace("arm", torch.tensor([1]), error, 0.5)
    assert left[0].nonzero().tolist() == [[9]]
    s = invented(2)
    seen = made.observed(s, {"arm": choice}, STEP)
    torch.testing.assert_close(seen.object.p, torch.tensor([[0.0, 0, 0], [0, 0.05, 0]]))
    torch.testing.assert_close(seen.object.q, torch.cat([IDENTITY, turned(0.0, 0.0, -0.05)]))
    torch.testing.assert_close(seen.object.start_p - s.object.start_p, seen.object.p - s.object.p)
    torch.testing.assert_close(seen.goal.p, choice.goals(seen.object.p, seen.object.q)[0][:, 0])
    assert made.bias("arm")[1].tolist() == pytest.approx([0, 0.05, 0, 0, 0, -0.05])
    plain = Perturbations(r, 2, 26, HANDS, 0.05, CPU)
    assert plain.misplace("arm", torch.tensor([1]), error) is error
    assert plain.observed(s, {"arm": choice}, STEP) is s
    assert not plain.bias("arm").any()


def test_what_is_not_misplaced_is_observed_as_before_to_the_last_bit():
    """Stored runs are evaluated again bit for bit."""
    p = torch.tensor([[0.1, 0.2, 0.3], [1.1, -2.7, 0.013]])
    s = invented(2, object_p=p)
    s = dataclasses.replace(s, objects={n: dataclasses.replace(o, start_p=p / 3) for n, o in s.objects.items()})
    r, choice = Randomisation(observed_joint=0.1, candidate_position=0.1), CandidateChoice(along_x(0.1), 2, CPU)
    seen = Perturbations(r, 2, 26, HANDS, 0.05, CPU).observed(s, {"arm": choice}, STEP)
    assert torch.equal(seen.object.p, p)
    assert torch.equal(seen.object.start_p, p / 3)
    assert torch.equal(seen.object.q, s.object.q)


@pytest.mark.parametrize("env_id", ["DoraJug-v1", "DoraHammer-v1", "DoraMicrowave-v1"])
def test_nothing_but_the_measured_pose_of_a_misplaced_object_is_off(env_id: str):
    """From the same starts: the candidate's error becomes the pose's, and what is observed does not tell it."""
    off, usual = (tasks.make_task(env_id, 4, config=UNNOISY | {"misplaced": what}) for what in ("object", "candidates"))
    for task in (off, usual):
        task.reset(seed=[1, 2, 3, 4])
    s, seen = off.snapshot, off.observed
    assert off.start_numbers.keys() == usual.start_numbers.keys()
    for name, drawn in off.start_numbers.items():
        torch.testing.assert_close(drawn, usual.start_numbers[name], atol=0.05, rtol=1e-3)
    r = off.config.randomisation
    for name, arm in off.arms.items():
        body, choice = s.handles[name], arm.guide.choice
        chosen = choice.buffers.chosen.long()
        assert torch.equal(choice.buffers.position[:, 0], choice.candidates.position[chosen])
        away = seen.objects[body].p - s.objects[body].p
        assert 0.1 * r.candidate_position < away.abs().max() <= r.candidate_position + 1e-6
        assert away.std(0).min() > 0.1 * r.candidate_position
        turn = rotation_angle(seen.objects[body].q, s.objects[body].q)
        assert 0.2 * r.candidate_rotation < turn.max() < 3**0.5 * r.candidate_rotation
        place = relative((seen.objects[body].p, seen.objects[body].q), (seen.goals[name].p, seen.goals[name].q))
        torch.testing.assert_close(place[0], choice.candidates.position[chosen], atol=1e-5, rtol=0)
        torch.testing.assert_close(lifted(seen.of(name)), lifted(s.of(name)), atol=1e-5, rtol=0)
    off.close()
    usual.close()


def test_the_error_stays_for_the_episode_is_restored_and_is_shared_out_by_curricula():
    task = tasks.make_task("DoraJug-v1", 3, config=UNNOISY | {"misplaced": "object"})
    task.reset(seed=0)

    def away() -> torch.Tensor:
        return task.observed.object.p - task.snapshot.object.p

    first = away()
    for _ in range(6):
        task.step(task.scripted_action())
    torch.testing.assert_close(away(), first, atol=1e-6, rtol=0)
    state = task.get_state_dict()
    task.reset(options={"env_idx": torch.tensor([1])})
    assert ((away() - first).norm(dim=-1) > 1e-4).tolist() == [False, True, False]
    task.reset(seed=1)
    task.set_state_dict(state)
    torch.testing.assert_close(away(), first, atol=1e-6, rtol=0)
    task.anneal(error=0.25)
    task.reset(seed=0)
    torch.testing.assert_close(away(), 0.25 * first, atol=1e-6, rtol=0)
    task.close()


def test_settings_of_runs_before_mean_misplaced_candidates():
    config = recommended("DoraJug-v1", "sac", task=plain(task_config(JugConfig, "standard", None)))
    named, before = dict(config.task), {name: value for name, value in config.task.items() if name != "misplaced"}
    assert named["misplaced"] == "candidates"
    digests = [dataclasses.replace(config, task=task).digest() for task in (named, before)]
    assert digests[0] == digests[1]
    assert dataclasses.replace(config, task=config.task | {"misplaced": "object"}).digest() != digests[0]


def test_a_misplaced_object_is_corrected_to_where_it_is():
    """The reference follows the measured pose; with the correction it leads to the candidate at the true one."""
    task = tasks.make_task("DoraJug-v1", 4, preset="hard", config={"misplaced": "object"})
    task.reset(seed=[1, 2, 3, 4])
    arm, pose = task.arms.only, task.target_object.pose
    choice, residual, expand = arm.guide.choice, arm.guide.residual, arm.agent.wrist_controller.expand_hand
    action = oracle.exact_action(task)
    measured = task.perturbations.biased("arm", (pose.p, pose.q))
    b, held, chosen = choice.buffers, choice.candidates, choice.buffers.chosen.long()
    assert torch.equal(b.position[:, 0], held.position[chosen])
    p, q = compose(measured, (b.position[:, 0], b.quaternion[:, 0]))
    right = compose((pose.p, pose.q), (held.position[chosen], held.quaternion[chosen]))
    residual.begin(torch.arange(4))
    for _ in range(SETTLED):
        mended = residual.apply(Target(p, q, b.grasp.clone()), action, expand)
    inside = action[:, :6].abs().amax(-1) < 1
    assert inside.any()
    assert ((p - right[0]).norm(dim=-1) > 1e-3).all()
    assert (mended.wrist_p - right[0])[inside].abs().max() < 1e-5
    assert rotation_angle(mended.wrist_q, right[1])[inside].max() < 1e-3
    task.close()
