"""Options of reset and parts of states: what is wrong is told in one sentence, before anything is changed."""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from dora.errors import InputError
from dora.sim import BACKEND

START = "reset_to_env_states"


@pytest.fixture(scope="module", params=["PickCube-v1", "DoraCube-v1"])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = gym.make(request.param, num_envs=2, sim_backend=BACKEND, obs_mode="state", render_backend="none")
    made.reset(seed=0)
    yield made.unwrapped
    made.close()


def changed(**parts: Any) -> Callable[[Any], dict[str, Any]]:
    """A whole state with these parts in place of its own."""
    return lambda env: {START: {"env_states": env.get_state_dict() | parts}}


OPTIONS: list[tuple[str, Callable[[Any], Any], str]] = [
    ("slip env_ids", lambda env: {"env_ids": [0]}, "did you mean 'env_idx'"),
    ("slip states", lambda env: {"reset_to_env_state": {}}, "did you mean 'reset_to_env_states'"),
    ("word", lambda env: {"reconfigure": "no"}, "True or False"),
    ("rebuild of some", lambda env: {"reconfigure": True, "env_idx": [0]}, "env_idx"),
    ("no states", lambda env: {START: {"env_states": None}}, "dictionary with 'env_states'"),
    ("only obs", lambda env: {START: {"obs": np.zeros((2, 3))}}, "dictionary with 'env_states'"),
    ("empty", lambda env: {START: {"env_states": {}}}, "actors"),
    ("slip actor", lambda env: {START: {"env_states": {"actor": {}}}}, "actor"),
    ("number for actors", changed(actors=5), "actors.*must be a dictionary"),
    ("list for robots", changed(articulations=[1, 2]), "must be a dictionary"),
    ("number for controller", changed(controller=5), "controller.*must be a dictionary"),
    ("obs of another size", lambda env: {
        START: {"env_states": env.get_state_dict(), "obs": np.zeros((2, 3))}}, r"obs.* has shape \(2, 3\)"),
    ("obs of too many", lambda env: {"env_idx": [1], START: {
        "env_states": env.get_state_dict(), "obs": env.get_obs()}}, "has shape|env_states|needed"),
]  # fmt: skip
"""Names, options that are wrong, and words of the answer."""


@pytest.mark.parametrize(("options", "words"), [case[1:] for case in OPTIONS], ids=[case[0] for case in OPTIONS])
def test_wrong_options_of_reset_change_nothing(env: Any, options: Callable[[Any], Any], words: str):
    given, before = options(env), env.get_state()
    with pytest.raises(InputError, match=words) as error:
        env.reset(options=given)
    assert "\n" not in str(error.value)
    assert torch.equal(env.get_state(), before)
    assert env.step(env.action_space.sample() * 0)[0].isfinite().all()


STATES: list[tuple[str, Any, str]] = [
    ("empty", {}, "the state (has nothing|lacks)"),
    ("slip", {"actor": {}}, "actor"),
    ("number for robots", {"actors": {}, "articulations": 5}, "must be a dictionary|is missing"),
    ("list for actors", {"actors": [1, 2], "articulations": {}}, "must be a dictionary|is missing"),
]


@pytest.mark.parametrize(("state", "words"), [case[1:] for case in STATES], ids=[case[0] for case in STATES])
def test_wrong_states_change_nothing(env: Any, state: Any, words: str):
    before = env.get_state()
    with pytest.raises(InputError, match=words) as error:
        env.set_state_dict(state)
    assert "\n" not in str(error.value)
    assert torch.equal(env.get_state(), before)


def test_options_that_a_task_may_know_are_let_through_and_the_others_work(env: Any):
    env.reset(seed=0, options={"episode_id": 3, "reconfigure": None})
    env.reset(seed=0, options={"reconfigure": np.bool_(True)})
    state, obs = env.get_state_dict(), env.get_obs()
    found = env.reset(options={START: {"env_states": state, "obs": obs}})[0]
    assert torch.equal(torch.as_tensor(found), torch.as_tensor(obs))


def test_rows_of_a_state_are_read_as_they_are_written(env: Any):
    env.reset(seed=1)
    saved = env.get_state()
    env.step(torch.ones(env.action_space.shape))
    assert not torch.equal(env.get_state(), saved)
    env.set_state(saved)
    torch.testing.assert_close(env.get_state(), saved, rtol=0, atol=1e-6)
