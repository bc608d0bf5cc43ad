"""Options of `reset` are checked, all of them, before anything is set: on `physx_cpu_batch` and in tasks of ours."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from dora.arguments import taken
from dora.errors import InputError
from dora.sim import BACKEND
from dora.sim.batch.resets import START

OURS, STOCK = "DoraCube-v1", "PickCube-v1"
COUNT = 3


def make(env_id: str, **options: Any) -> Any:
    settings: Any = {"sim_backend": BACKEND, "render_backend": "none", "obs_mode": "state", **options}
    return gym.make(env_id, num_envs=COUNT, **settings)


@pytest.fixture(scope="module", params=[OURS, STOCK])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    """An environment whose controllers have targets."""
    env: Any = make(request.param, **({} if request.param == OURS else {"control_mode": "pd_joint_target_delta_pos"}))
    yield env
    env.close()


def test_states_that_would_set_nothing_or_half_are_refused(env: Any):
    env.reset(seed=0)
    state = env.unwrapped.get_state_dict()
    name = next(iter(state["actors"]))
    cases: list[tuple[Any, str]] = [
        ({}, "nothing in 'actors'|lacks 'actors'"),
        ({"controller": state["controller"]}, "nothing in 'actors'|lacks 'actors'"),
        (state | {"articulations": 5}, "must be a dictionary"),
        (state | {"actors": [1, 2]}, "must be a dictionary"),
        (state | {"actors": {name: {"p": [1]}}}, "must be rows"),
        (state | {"actor": state["actors"]}, "'actor'.*did you mean 'actors'"),
        ({"articulation": state["articulations"]}, "did you mean 'articulations'"),
    ]
    for wrong, words in cases:
        with pytest.raises(InputError, match=words) as error:
            env.unwrapped.set_state_dict(wrong)
        assert "\n" not in str(error.value)
        assert torch.equal(env.unwrapped.get_state_dict()["actors"][name], state["actors"][name])


def test_options_that_cannot_be_are_refused_before_anything_is_set(env: Any):
    env.reset(seed=0)
    obs = env.step(env.action_space.sample())[0]
    state = env.unwrapped.get_state_dict()
    target = next(iter(state["controller"]))
    shaped = {"env_states": state, "obs": obs[:, 1:]}
    cases: list[tuple[Any, str]] = [
        ({"env_ids": [0]}, "did you mean 'env_idx'"),
        ({"ENV_IDX": [0]}, "did you mean 'env_idx'"),
        ({"reset_to_env_state": {"env_states": state}}, f"did you mean '{START}'"),
        ({"reconfigure": "no"}, "True or False"),
        ({"reconfigure": True, "env_idx": [0]}, "builds all environments anew"),
        ({START: {"env_states": None}}, "'env_states'"),
        ({START: {"env_states": state, "observation": obs}}, "perhaps 'obs'"),
        ({START: shaped}, "obs has shape"),
        ({START: shaped | {"obs": {"state": obs}}}, "obs has names"),
        ({"env_idx": [0], START: {"env_states": taken(state, torch.tensor([0])), "obs": obs}}, "obs has shape"),
        ({START: {"env_states": state | {"controller": 5}}}, "must be a dictionary"),
        ({START: {"env_states": state | {"controller": {"x": 5}}}}, "'x'"),
        ({START: {"env_states": state | {"controller": {target: [1, 2]}}}}, "controller"),
        ({START: {"env_states": state | {"articulations": 5}}}, "must be a dictionary"),
        ({START: {"env_states": np.zeros((COUNT, 7))}}, "the state has shape"),
    ]
    before, random = env.unwrapped.get_state(), env.unwrapped._batched_main_rng.rngs[0].get_state()[1].copy()
    steps = env.unwrapped.elapsed_steps.clone()
    for options, words in cases:
        with pytest.raises(InputError, match=words) as error:
            env.reset(seed=3 if "env_idx" not in options else None, options=options)
        assert "\n" not in str(error.value)
        assert torch.equal(env.unwrapped.get_state(), before), options
        assert torch.equal(env.unwrapped.elapsed_steps, steps), options
        assert (env.unwrapped._batched_main_rng.rngs[0].get_state()[1] == random).all(), options


def test_options_that_tasks_know_and_truth_values_of_any_form_pass(env: Any):
    given = {"episode_id": 3, "build_config_idxs": [0], "mine": 1, "reconfigure": np.bool_(False), "env_idx": None}
    assert not env.reset(options=given)[1]["reconfigure"]


def test_a_reset_of_some_that_is_due_to_build_all_anew_is_refused():
    env = make(STOCK, reconfiguration_freq=1)
    with pytest.raises(InputError, match="reconfiguration_freq is 1"):
        env.reset(options={"env_idx": [0]})
    env.close()
