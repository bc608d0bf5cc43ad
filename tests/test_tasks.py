"""What every registered Dora task must do, whatever it is about."""

import weakref
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from torch import Tensor

import dora.tasks as tasks
from dora.errors import InputError
from dora.tasks.env.env import DoraEnv

BATCH = 6
"""Environments in a batch."""
MOST_SLIP = 12e-3
"""Largest slip of fingers that lean on one another, twice the largest that was seen, of the jug's hand [rad]."""


def actions(task: DoraEnv, steps: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * (2 * torch.rand(steps, task.num_envs, task.action_size, generator=generator) - 1)


def flat_state(task: DoraEnv) -> Tensor:
    return torch.as_tensor(task.get_state())


def remembered(task: DoraEnv) -> dict[str, Tensor]:
    """All that the task remembers of its episodes."""
    parts = {"machine": task.machine, "memory": task.memory, **{name: arm.guide for name, arm in task.arms.items()}}
    return {f"{name}.{key}": value for name, part in parts.items() for key, value in part.get_state().items()}


def roll(task: DoraEnv, steps: Tensor, **reset) -> Tensor:
    """Observations (t + 1, n, o)."""
    out = [task.reset(**reset)[0]]
    out += [task.step(a)[0] for a in steps]
    return torch.stack(out)


def test_a_scene_that_is_built_anew_takes_the_place_of_the_old_one():
    """PhysX tells every scene of a friction that changes, and one that is never stepped would gather that for ever."""
    task = tasks.make_task("DoraCube-v1", 2)
    for build in (lambda: task.reset(seed=0), lambda: task.rebuild(1.05 * task.scale)):
        old = weakref.ref(task.scene)
        build()
        assert old() is None
    task.close()


@pytest.fixture(scope="module", params=tasks.task_ids())
def batch(request: pytest.FixtureRequest) -> Iterator[DoraEnv]:
    task = tasks.make_task(request.param, BATCH, preset="hard")  # with noise, delay and pushes
    yield task
    task.close()


def slow_for(*long: str) -> list:
    """All tasks, some of which are left to the slow tests."""
    return [pytest.param(name, marks=pytest.mark.slow) if name in long else name for name in tasks.task_ids()]


@pytest.fixture(scope="module", params=["affordance", pytest.param("none", marks=pytest.mark.slow)])
def guidance(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.mark.parametrize("env_id", slow_for("DoraJug-v1", "DoraHammer-v1", "DoraMicrowave-v1"))
@pytest.mark.filterwarnings("ignore")
def test_gymnasium_contract(env_id: str):
    env = gym.make(env_id, obs_mode="state")
    check_env(CPUGymWrapper(env), skip_render_check=True, skip_close_check=True)
    env.close()


def test_same_seed_same_trajectory_other_seed_other(batch: DoraEnv):
    steps = actions(batch, 15)
    a, b, c = (roll(batch, steps, seed=s) for s in (3, 3, 4))
    assert torch.equal(a, b)
    assert not torch.equal(a, c)


def test_consecutive_resets_and_rows_differ(batch: DoraEnv):
    first, second = batch.reset(seed=0)[0], batch.reset()[0]
    assert (first != second).any(-1).all()
    assert len(first.unique(dim=0)) == BATCH


def test_terms_add_up_to_the_reward_within_their_bounds(batch: DoraEnv):
    batch.reset(seed=0)
    for a in actions(batch, 20):
        _, reward, *_, info = batch.step(a)
        parts = {k: v for k, v in info.items() if k.startswith("reward/")}
        torch.testing.assert_close(reward, torch.stack(list(parts.values())).sum(0))
        assert ((reward >= batch.terms.lower) & (reward <= batch.terms.upper)).all()
        for name, value in parts.items():
            term = batch.terms.terms[name.removeprefix("reward/")]
            low, high = sorted((0.0, term.weight))
            assert ((value >= low - 1e-6) & (value <= high + 1e-6)).all(), name


def test_every_logged_name_is_in_the_info(batch: DoraEnv):
    batch.reset(seed=0)
    info = batch.step(torch.zeros(BATCH, batch.action_size))[-1]
    assert set(batch.logged) <= set(info)
    assert all(info[name].shape == (BATCH,) for name in batch.logged)


def test_observations_are_fresh_memory(batch: DoraEnv):
    before = batch.reset(seed=0)[0]
    copy = before.clone()
    after = batch.step(actions(batch, 1)[0])[0]
    assert torch.equal(before, copy)
    assert before.data_ptr() != after.data_ptr()


def test_evaluate_changes_nothing(batch: DoraEnv):
    batch.reset(seed=0)
    for a in actions(batch, 5):
        batch.step(a)
    state = remembered(batch)
    first = batch.evaluate()
    for _ in range(5):
        again = batch.evaluate()
    assert all(torch.equal(first[k], again[k]) for k in first)
    now = remembered(batch)
    assert all(torch.equal(state[k], now[k]) for k in state)


def test_state_round_trip_restores_stage_observation_and_future(batch: DoraEnv):
    batch.reset(seed=0)
    for _ in range(9):
        batch.step(batch.scripted_action())
    state, info = batch.get_state_dict(), batch.get_info()
    seen = batch.get_obs(info)
    batch.step(batch.scripted_action())
    after, touching = batch.snapshot, touching_itself(batch)
    batch.reset(seed=9)
    batch.set_state_dict(state)
    assert all(torch.equal(now, state["machine"][name]) for name, now in batch.machine.get_state().items())
    torch.testing.assert_close(batch.get_obs(batch.get_info()), seen, atol=5e-3, rtol=0.02)
    batch.step(batch.scripted_action())
    # PhysX remembers friction from step to step and no state holds it: fingers that lean on one another slip. Where
    # none do, joints [rad] are within 1e-7, and objects [m], which lie or fall, within 2e-6.
    now, free = batch.snapshot, ~(touching | touching_itself(batch))
    for name in after.objects:
        torch.testing.assert_close(now.objects[name].p, after.objects[name].p, atol=1e-5, rtol=0)
    for arm in after.hands:
        torch.testing.assert_close(now.hands[arm].q[free], after.hands[arm].q[free], atol=1e-6, rtol=0)
        slip = (now.hands[arm].q - after.hands[arm].q).abs().max().item()
        assert slip <= MOST_SLIP, f"{arm}: {slip:.5f} rad"


def touching_itself(task: DoraEnv) -> Tensor:
    """Mask (n,) of the environments in which links of robots touch each other."""
    links = {link.name for arm in task.arms.values() for link in arm.agent.robot.get_links()}
    systems: list[Any] = [scene.physx_system for scene in task.scene.sub_scenes]
    found = [[{body.entity.name for body in c.bodies} for c in system.get_contacts()] for system in systems]
    return torch.tensor([any(pair <= links for pair in pairs) for pairs in found])


@pytest.mark.parametrize("which", [[2], pytest.param([0, 1, 3, 4, 5], marks=pytest.mark.slow)])
def test_partial_reset_leaves_the_others_bit_identical(batch: DoraEnv, which: list[int]):
    rows = torch.tensor(which)
    others = torch.tensor([i for i in range(BATCH) if i not in which])
    steps = actions(batch, 24)
    whole = roll(batch, steps, seed=1)
    batch.reset(seed=1)
    for a in steps[:12]:
        batch.step(a)
    obs = batch.reset(options={"env_idx": rows})[0]
    assert torch.equal(obs[others], whole[12][others])
    assert not torch.equal(obs[rows], whole[12][rows])
    assert (batch.elapsed_steps[rows] == 0).all()
    for t, a in enumerate(steps[12:]):
        assert torch.equal(batch.step(a)[0][others], whole[13 + t][others])


@pytest.mark.parametrize("env_id", slow_for("DoraJug-v1", "DoraHammer-v1", "DoraMicrowave-v1"))
def test_a_batch_equals_singles(env_id: str):
    seeds = [11, 12, 13]
    task = tasks.make_task(env_id, len(seeds))
    steps = actions(task, 8, scale=0.2)  # contacts amplify the last bit in which torch's batches differ
    together = roll(task, steps, seed=seeds)
    task.close()
    for i, seed in enumerate(seeds):
        single = tasks.make_task(env_id, 1, sim_backend="physx_cpu")
        alone = roll(single, steps[:, i : i + 1], seed=[seed])
        single.close()
        torch.testing.assert_close(alone[:, 0], together[:, i], atol=2e-3, rtol=0)


@pytest.mark.parametrize("env_id", slow_for("DoraHammer-v1", "DoraMicrowave-v1"))
def test_the_script_visits_every_stage_in_order_and_succeeds(env_id: str, guidance: str):
    n = 48 if env_id == "DoraHammer-v1" else 16  # of 16 starts three more or less of its blows hit
    task = tasks.make_task(env_id, n, guidance=guidance, preset="none")
    task.reset(seed=5)
    seen, rewards, success = [], [], torch.zeros(n, dtype=torch.bool)
    for _ in range(task.max_steps):
        _, reward, _, _, info = task.step(task.scripted_action())
        seen.append(info["stage"])
        rewards.append(reward)
        success = info["success"]
    stages = torch.stack(seen)
    done = stages[-1] == len(task.machine)
    for column in stages[:, done].T:
        assert set(column.tolist()) >= set(range(1, len(task.machine) + 1))
    assert success.float().mean() >= 0.8
    earned = torch.stack(rewards)[:, success]
    assert (earned.sum(0) > task.max_steps * earned[0]).all()  # finishing pays
    task.close()


@pytest.mark.parametrize("env_id", slow_for("DoraHammer-v1", "DoraMicrowave-v1"))
def test_no_observation_is_constant_and_all_are_finite(env_id: str, guidance: str):
    task = tasks.make_task(env_id, 8, guidance=guidance)
    obs, _ = task.reset(seed=2)
    seen = [obs]
    for noise in actions(task, task.max_steps, scale=0.2):
        seen.append(task.step((task.scripted_action() + noise).clamp(-1, 1))[0])
    values = torch.stack(seen).flatten(0, 1)
    assert torch.isfinite(values).all()
    assert values.abs().max() < 50
    start, constant = 0, []
    for name, entry in task.observation_entries.items():
        size = entry.value(task.snapshot).shape[-1]
        moving = values[:, start : start + size].std(0) > 0
        # Not every part of the hand touches the object, but some must.
        if not (moving.any() if name.split("/")[-1] in ("touch", "phase", "class") else moving.all()):
            constant.append(name)
        start += size
    assert start == values.shape[-1]
    assert not constant
    task.close()


@pytest.mark.parametrize("env_id", tasks.task_ids())
def test_guidance_removes_exactly_what_it_adds(env_id: str):
    guided, plain = (tasks.make_task(env_id, 2, guidance=g) for g in ("affordance", "none"))
    extra = [k for k, e in guided.observation_entries.items() if e.guided]
    assert extra
    assert list(plain.observation_entries) == [k for k in guided.observation_entries if k not in extra]
    assert list(plain.terms.terms) == [k for k, t in guided.terms.terms.items() if not t.guided]
    assert guided.action_size == plain.action_size
    # One initial state and one success test for both.
    a, b = guided.reset(seed=7)[0], plain.reset(seed=7)[0]
    for name, body in guided.snapshot.objects.items():
        torch.testing.assert_close(body.p, plain.snapshot.objects[name].p, atol=0, rtol=0)
    assert a.shape[-1] > b.shape[-1]
    guided.close()
    plain.close()


@pytest.mark.parametrize("mode", ["dense", "normalized_dense", "sparse", "none", "paper"])
def test_reward_modes(mode: str):
    task = tasks.make_task("DoraCube-v1", 2, reward_mode=mode)
    task.reset(seed=0)
    rewards = torch.stack([task.step(a)[1] for a in actions(task, 5)]).float()
    assert torch.isfinite(rewards).all()
    assert rewards.max() <= (1.0 if mode in ("normalized_dense", "sparse", "none") else 10.0)
    assert (rewards == 0).all() == (mode in ("sparse", "none"))
    task.close()


def test_coupled_hand_has_fewer_actions_and_exact_commands():
    task = tasks.make_task("DoraCube-v1", 2, hand_joints=15)
    task.reset(seed=0)
    for a in actions(task, 8):
        task.step(a)
    target = task.agent.wrist_controller.target[:, 7:].unflatten(-1, (5, 4))
    assert task.action_size == 21
    assert torch.equal(target[..., 3], target[..., 2])
    assert target[..., 2].std() > 0
    task.close()


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_joint_delta_pos"])
@pytest.mark.parametrize("joints", [20, 15])
def test_joint_control_modes(mode: str, joints: int):
    task = tasks.make_task("DoraCube-v1", 2, control_mode=mode, hand_joints=joints)
    task.reset(seed=0)
    assert task.action_size == 7 + joints
    obs = task.step(actions(task, 1, scale=0.1)[0])[0]
    assert torch.isfinite(obs).all()
    with pytest.raises(InputError, match="commands no wrist"):
        _ = task.agent.wrist_controller
    task.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"guidance": "magic"}, "guidance"),
        ({"preset": "brutal"}, "preset"),
        ({"robot_uids": "nobody"}, "robot"),
        ({"robot_uids": "panda"}, "panda"),
        ({"hand_joints": 7}, "hand_joints"),
        ({"num_envs": 0}, "num_envs"),
        ({"control_mode": "telepathy"}, "control"),
    ],
)
def test_bad_options_get_one_clear_sentence(options: dict, words: str):
    with pytest.raises(InputError, match=words) as error:
        gym.make("DoraCube-v1", **options)
    assert "\n" not in str(error.value)


def test_unknown_ids_are_refused_with_a_suggestion():
    with pytest.raises(InputError, match="did you mean 'DoraCube-v1'"):
        tasks.make_task("DoraCub-v1", 1)


@pytest.mark.parametrize("backend", ["physx_cpu", "physx_cpu_batch"])
@pytest.mark.parametrize("bad", ["nan", "shape"])
def test_bad_actions_are_refused_and_move_nothing(backend: str, bad: str):
    task = tasks.make_task("DoraCube-v1", 1, sim_backend=backend)
    task.reset(seed=0)
    before = flat_state(task)
    action = np.zeros((1, task.action_size if bad == "nan" else 5), np.float32)
    action[0, 0] = np.nan if bad == "nan" else 0.0
    with pytest.raises(InputError):
        task.step(action)
    assert torch.equal(before, flat_state(task))
    task.close()


def test_a_seed_in_a_partial_reset_is_that_of_its_rows_alone(batch: DoraEnv):
    batch.reset(seed=0)
    batch.step(actions(batch, 1)[0])
    others, seeds = [0, 1, 3, 5], batch._episode_seed.copy()
    first = batch.reset(seed=[7, 8], options={"env_idx": torch.tensor([4, 2])})[0]
    batch.step(actions(batch, 1)[0])
    again = batch.reset(seed=[8, 7], options={"env_idx": torch.tensor([2, 4])})[0]
    assert torch.equal(first[[4, 2]], again[[4, 2]])
    assert batch._episode_seed[[4, 2]].tolist() == [7, 8]
    assert (batch._episode_seed[others] == seeds[others]).all()
    with pytest.raises(InputError, match="3 seeds for 2 environments"):
        batch.reset(seed=[1, 2, 3], options={"env_idx": [0, 1]})
