"""Batches as environments of other libraries: gymnasium, TorchRL and Stable-Baselines3."""

import copy
import pickle
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.registration import TimeLimitWrapper
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from dora.errors import InputError
from dora.integrations.batches import make_batch
from dora.integrations.torchrl import BatchEnv
from dora.integrations.torchrl import make as make_torchrl

LIMIT, COUNT = 6, 3
"""Length of an episode [control steps]; number of environments."""
IDS = ("DoraCube-v1", "PickCube-v1")


def test_a_batch_needs_arrays():
    with pytest.raises(InputError, match='choose obs_mode="state"'):
        make_batch("PickCube-v1", 2, {"obs_mode": "state_dict"})


@pytest.mark.parametrize("env_id", IDS)
def test_torchrl_collects_from_it(env_id: str):
    env = make_torchrl(env_id, COUNT, max_episode_steps=LIMIT)
    check_env_specs(env)
    frames = 4 * LIMIT * COUNT
    batch = next(iter(Collector(env, None, frames_per_batch=frames, total_frames=frames)))
    done = batch["next", "done"][..., 0]
    assert batch.shape == (COUNT, 4 * LIMIT)
    assert done.sum(1).tolist() == [4] * COUNT
    assert torch.equal(batch["next", "truncated"], batch["next", "done"])
    assert torch.isfinite(batch["observation"]).all()
    went_on = ~done[:, :-1]
    assert torch.equal(batch["observation"][:, 1:][went_on], batch["next", "observation"][:, :-1][went_on])
    began = batch["observation"][:, 1:][done[:, :-1]]
    assert not torch.equal(began, batch["next", "observation"][:, :-1][done[:, :-1]])
    env.close()


@pytest.mark.parametrize(
    ("ignored", "ends"), [(False, [[1, 3, 5, 7], [3, 7]]), (True, [[3, 7], [3, 7]])], ids=["ends", "goes on"]
)
def test_a_success_ends_an_episode_of_torchrl_unless_that_is_ignored(ignored: bool, ends: list[list[int]]):
    rollout = BatchEnv(Succeeding(), ignored).rollout(8, break_when_any_done=False)["next"]
    assert [torch.nonzero(row[:, 0])[:, 0].tolist() for row in rollout["done"]] == ends
    assert rollout["success"][0, ends[0][0]]
    assert bool(rollout["terminated"].any()) != ignored


def test_torchrl_sees_what_gymnasium_sees():
    env = make_torchrl("DoraCube-v1", COUNT)
    env.set_seed(5)
    after = env.step(env.reset().set("action", torch.full((COUNT, 26), 0.5)))["next"]
    bare: Any = make_batch("DoraCube-v1", COUNT, {})
    bare.reset(seed=5)
    obs, reward, _, _, info = bare.step(torch.full((COUNT, 26), 0.5))
    assert torch.equal(after["observation"], obs)
    assert torch.equal(after["reward"][:, 0], reward)
    assert torch.equal(after["success"][:, 0], info["success"])
    partly = env.reset(after.clone().set("_reset", torch.tensor([[True], [False], [False]])))
    assert torch.equal(partly["observation"][1:], obs[1:])
    assert not torch.equal(partly["observation"][0], obs[0])
    env.close()
    bare.close()


def test_gymnasium_makes_a_batch_as_a_vector_environment():
    """In a process that has not imported Dora: the prefix does it."""
    code = """
import gymnasium as gym, numpy as np
env = gym.make_vec("dora:DoraCube-v1", num_envs=3, max_episode_steps=4)
assert isinstance(env, gym.vector.VectorEnv)
obs, _ = env.reset(seed=5)
ends = [bool(env.step(np.zeros(env.action_space.shape))[3].all()) for _ in range(8)]
print(type(env).__name__, tuple(obs.shape), [k for k, over in enumerate(ends) if over])
single = gym.make("dora:DoraCube-v1", max_episode_steps=2)
first, _ = single.reset(seed=5)
print([bool(single.step(None)[3]) for _ in range(2)], bool((first[0] == obs[0]).all()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-2:] == [
        "ManiSkillVectorEnv (3, 211) [3, 7]",
        "[False, True] True",
    ]


HEADLESS: dict[str, Any] = {"render_backend": "none", "obs_mode": "state"}
COPIES = {
    "itself": lambda spec: spec,
    "deep copy": copy.deepcopy,
    "pickled": lambda spec: pickle.loads(pickle.dumps(spec)),
    "deep copy, pickled and copied again": lambda spec: copy.deepcopy(pickle.loads(pickle.dumps(copy.deepcopy(spec)))),
}
"""Ways to come by what is registered under an id."""


def _ends(env: Any, steps: int) -> list[list[bool]]:
    """Which environments are out of time after each step; a limit of gymnasium's, no tensor, has no `tolist`."""
    env.reset(seed=0)
    ends = [env.step(None)[3].tolist() for _ in range(steps)]
    env.close()
    return ends


@pytest.mark.parametrize("way", COPIES)
def test_what_is_registered_keeps_its_time_limit_when_it_is_copied(way: str):
    copied = COPIES[way](gym.spec("DoraCube-v1"))
    env: Any = gym.make(copied, num_envs=2, max_episode_steps=2, **HEADLESS)
    assert type(env) is TimeLimitWrapper
    assert _ends(env, 2) == [[False] * 2, [True] * 2]
    env = gym.make(copied, num_envs=1, **HEADLESS)
    assert env._max_episode_steps == copied.max_episode_steps == env.unwrapped.max_steps
    env.close()


def test_an_episode_of_a_copied_id_is_as_long_as_its_task():
    env: Any = gym.make(copy.deepcopy(gym.spec("DoraCube-v1")), num_envs=1, **HEADLESS)
    limit = env.unwrapped.max_steps
    assert _ends(env, limit) == [[False]] * (limit - 1) + [[True]]


def test_a_registered_id_has_no_json_as_those_of_maniskill_have_none():
    for env_id in IDS:
        with pytest.raises(ValueError, match="Callable found"):
            gym.spec(env_id).to_json()


@pytest.mark.parametrize(
    ("mode", "way"),
    [(None, "deep copy, pickled and copied again"), ("vector_entry_point", "itself"), ("sync", "itself")],
)
def test_gymnasium_makes_a_vector_environment_of_what_was_copied(mode: str | None, way: str):
    _check_vector(COPIES[way](gym.spec("DoraCube-v1")), mode)
    assert gym.spec("DoraCube-v1").additional_wrappers, "make_vec took the wrapper of what is registered"


@pytest.mark.parametrize("context", [None, pytest.param("spawn", marks=pytest.mark.slow)])
def test_processes_of_gymnasium_work(context: str | None):
    """Forked ones, the default on Linux, have none of the threads that torch of this process has begun."""
    assert float((torch.ones(512, 512) @ torch.ones(512, 512)).mean()) == 512
    _check_vector("DoraCube-v1", "async", vector_kwargs={"context": context})


def _check_vector(env_id: Any, mode: str | None, **kwargs: Any) -> None:
    env = gym.make_vec(env_id, 2, mode, max_episode_steps=2, **HEADLESS, **kwargs)
    kinds = {"sync": gym.vector.SyncVectorEnv, "async": gym.vector.AsyncVectorEnv}
    assert type(env) is kinds.get(mode or "", ManiSkillVectorEnv)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape or (), np.float32)
    assert [np.ravel(env.step(action)[3]).tolist() for _ in range(2)] == [[False] * 2, [True] * 2]
    env.close()


@pytest.fixture
def sb3() -> Any:
    return pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")


@pytest.mark.parametrize("env_id", IDS)
def test_a_vecenv_ends_and_begins_episodes(sb3: Any, env_id: str):
    from dora.integrations.sb3 import make

    env: Any = make(env_id, COUNT, max_episode_steps=LIMIT)
    env.seed(3)
    first, ended = env.reset(), 0
    for step in range(2 * LIMIT):
        obs, reward, done, infos = env.step(np.zeros((COUNT, *env.action_space.shape)))
        assert obs.shape == first.shape
        assert reward.shape == done.shape == (COUNT,)
        assert done.all() == done.any() == ((step + 1) % LIMIT == 0)
        for row, info in enumerate(infos):
            assert ("terminal_observation" in info) == ("is_success" in info) == ("episode" in info) == done[row]
            if done[row]:
                assert info["TimeLimit.truncated"]
                assert info["episode"]["l"] == LIMIT
                assert not np.array_equal(info["terminal_observation"], obs[row])
                ended += 1
    assert ended == 2 * COUNT
    assert env.get_attr("control_freq", [0, 2]) == [20, 20]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [False] * COUNT
    env.env_method("get_state")
    with pytest.raises(ValueError, match="leave indices out"):
        env.set_attr("x", 1, [0])
    env.seed(3)
    assert np.array_equal(env.reset(), first)
    env.close()


class Succeeding(gym.Env):
    """Two environments, the first of which succeeds in its second step; time is over after four."""

    num_envs = 2
    device = torch.device("cpu")
    single_observation_space = gym.spaces.Box(-1, 1, (1,))
    single_action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[torch.Tensor, dict]:
        rows = torch.arange(2) if options is None else torch.as_tensor(options["env_idx"])
        self.steps = getattr(self, "steps", torch.zeros(2, dtype=torch.int64))
        self.steps[rows] = 0
        return self.steps[:, None] / 4, {}

    def step(self, action: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        self.steps += 1
        success = (self.steps >= 2) & torch.tensor([True, False])
        return self.steps[:, None] / 4, torch.ones(2), success, self.steps >= 4, {"success": success}


@pytest.mark.parametrize(
    ("ignored", "ends"), [(False, [[1, 3, 5, 7], [3, 7]]), (True, [[3, 7], [3, 7]])], ids=["ends", "goes on"]
)
def test_a_success_ends_an_episode_unless_that_is_ignored(sb3: Any, ignored: bool, ends: list[list[int]]):
    from dora.integrations.sb3 import BatchVecEnv

    env = BatchVecEnv(Succeeding(), ignored)
    env.reset()
    steps = [env.step(np.zeros((2, 1))) for _ in range(8)]
    assert [[k for k, (_, _, done, _) in enumerate(steps) if done[row]] for row in range(2)] == ends
    info = steps[ends[0][0]][3][0]
    assert (info["is_success"], info["TimeLimit.truncated"]) == (True, ignored)


def test_options_of_a_vecenv_are_those_of_its_next_reset(sb3: Any):
    from dora.integrations.sb3 import BatchVecEnv

    class Asked(Succeeding):
        options: Any = None

        def reset(self, *, seed: Any = None, options: Any = None) -> tuple[torch.Tensor, dict]:
            self.options = options
            return super().reset(seed=seed)

    batch = Asked()
    env = BatchVecEnv(batch)
    env.set_options({"reconfigure": True})
    env.reset()
    assert batch.options == {"reconfigure": True}
    env.reset()
    assert batch.options is None
    env.set_options([{"reconfigure": True}, {}])
    with pytest.raises(ValueError, match="give all of them the same"):
        env.reset()


def test_stable_baselines_learns_and_evaluates_on_it(sb3: Any):
    from stable_baselines3.common.evaluation import evaluate_policy

    from dora.integrations.sb3 import make

    env = make("DoraCube-v1", COUNT, max_episode_steps=LIMIT)
    model = sb3.PPO("MlpPolicy", env, n_steps=2 * LIMIT, batch_size=8, n_epochs=1, device="cpu")
    model.learn(4 * LIMIT * COUNT)
    assert len(model.ep_info_buffer) == 4 * COUNT
    assert all(np.isscalar(episode["r"]) for episode in model.ep_info_buffer)
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [LIMIT] * 4
    assert np.isfinite(returns).all()
    env.close()
