"""The largest and smallest settings, counters and sizes that runs and checkpoints may have, and what is beyond."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from dora.agents.agent_columns import AgentColumns
from dora.agents.checkpoint import (
    Checkpoint,
    bytes_of,
    check_belongs,
    check_finite,
    pack_rng,
    read_checkpoint,
    unpack_rng,
)
from dora.agents.config import HAPPOConfig, PPOConfig, RunConfig, SACConfig, config_from_dict
from dora.agents.counters import checked_counters
from dora.agents.limits import check, check_episodes
from dora.configs import plain
from dora.errors import InputError
from dora.files import MOST_BYTES, MOST_HEADER, read_safetensors, write_safetensors

CONFIG = RunConfig("Fake-v1", "ppo", "none")
NAN, INF = float("nan"), float("inf")
PLACE = Path("a.safetensors")

# ------------------------------------------------------------------------ counters


@pytest.mark.parametrize(
    ("name", "fits", "wrong"),
    [
        ("best", [None, [0, 0.0], [1, -9e11], [0.25, 9e11]],
         [[0.5], [0.5, 1.0, 2.0], [-0.01, 1.0], [1.01, 1.0], [0.5, 1e12], [0.5, -1e12], [0.5, NAN]]),
        ("curve", [[], [[0, 0, 0]], [[5, 1.5, 1, -3.0, NAN]], [[1, 1, 0.5], [2, 2, 0.25]]],
         [[[1, 1]], [[1, 1, True]], [[1, 1, 0.5], [1, 1, "x"]], [[-1, 1, 0.5]], [[1e12, 1, 0.5]], [[1, 1, -0.01]],
          [[1, 1, 1.01]], [[1, 1, NAN]]]),
        ("seconds", [{"collect": 0.0, "learn": 0, "evaluate": 9e11}],
         [{"collect": 0.0, "learn": 0.0}, {"collect": 0.0, "learn": 0.0, "evaluate": 0.0, "x": 0.0},
          {"collect": -0.1, "learn": 0.0, "evaluate": 0.0}, {"collect": 0.0, "learn": 1e12, "evaluate": 0.0}]),
        ("learner", [{}, {"x": -9e11, "y": 9e11, "z": 0}],
         [{"x": True}, {"x": "1"}, {"x": 1e12}, {"x": -1e12}, {"x": 1.0, "y": NAN}, {"x": NAN, "y": 1.0}, [], None]),
        ("env_steps", [0, 1, 10**12 - 1], [-1, 10**13, False]),
        ("reached", [0], [-1, True]),
    ],
)  # fmt: skip
def test_counters_are_read_up_to_their_bounds(name: str, fits: list[Any], wrong: list[Any]):
    for value in fits:
        found = checked_counters({name: value}, PLACE)
        assert name == "learner" or getattr(found, name) == value
    for value in wrong:
        with pytest.raises(InputError, match=name):
            checked_counters({name: value}, PLACE)


# ------------------------------------------------------------------------ settings


def test_iterations_have_at_most_a_hundred_million_transitions():
    """Of all workers; without workers, the main process is one."""
    for envs, workers, rollout in ((100_000, 10, 100), (1_000, 0, 100_000), (1_000, 1, 100_000), (50_000, 20, 100)):
        run = dataclasses.replace(CONFIG, num_envs=envs, workers=workers, learner=PPOConfig(rollout=rollout))
        check(run)
        for more in ({"workers": max(workers, 1) + 1}, {"learner": PPOConfig(rollout=rollout + 1)}):
            with pytest.raises(InputError, match=r"transitions at once|rollout"):
                check(dataclasses.replace(run, **more))


@pytest.mark.parametrize(("workers", "capacity"), [(0, 800), (1, 800), (2, 1600)])
def test_a_replay_buffer_holds_an_iteration(workers: int, capacity: int):
    def run(size: int) -> RunConfig:
        return RunConfig("x", "sac", num_envs=8, workers=workers, learner=SACConfig(rollout=100, capacity=size))

    check(run(capacity))
    with pytest.raises(InputError, match=f"capacity is {capacity - 1}, and an iteration collects {capacity}"):
        check(run(capacity - 1))


@pytest.mark.parametrize(("settings", "copies"), [(PPOConfig(), 6), (SACConfig(), 12), (HAPPOConfig(), 6)])
def test_hidden_layers_are_as_wide_as_a_checkpoint_can_hold(settings: PPOConfig | SACConfig, copies: int):
    """Four bytes for each of so many copies of the weights between two layers."""
    wide = (MOST_BYTES - MOST_HEADER) // (4 * copies) // (2 * 4096)
    agent = {PPOConfig: "ppo", SACConfig: "sac", HAPPOConfig: "happo"}[type(settings)]
    for hidden in ((4096, wide, 4096), (4096,), ()):
        check(RunConfig("x", agent, learner=dataclasses.replace(settings, hidden=hidden)))
    size = 4 * copies * 2 * 4096 * (wide + 1)
    with pytest.raises(InputError, match=f"checkpoints of {size / 1e6:.0f} MB"):
        check(RunConfig("x", agent, learner=dataclasses.replace(settings, hidden=(4096, wide + 1, 4096))))


def test_the_smaller_of_two_settings_may_equal_the_larger():
    for fits in (
        PPOConfig(learning_rate_min=1e-3),
        PPOConfig(log_std_min=-0.7),
        PPOConfig(log_std_last=-0.7),
        PPOConfig(log_std_last=-3.0),
    ):
        check(dataclasses.replace(CONFIG, learner=fits))
    for wrong, words in (
        (PPOConfig(learning_rate_min=1.1e-3), "learning-rate-min"),
        (PPOConfig(log_std_min=-0.6), "log-std-min"),
        (PPOConfig(log_std_last=-0.6), "log-std-last"),
        (PPOConfig(log_std_last=-3.1), "log-std-min"),
    ):
        with pytest.raises(InputError, match=f"{words} is .*: the first has to be the smaller one"):
            check(dataclasses.replace(CONFIG, learner=wrong))
    check(RunConfig("x", "sac", workers=0, learner=SACConfig()))


def test_new_evaluations_have_from_one_to_ten_thousand_episodes():
    for count, fits in ((0, False), (1, True), (10_000, True), (10_001, False)):
        if fits:
            check_episodes(count)
        else:
            with pytest.raises(InputError, match=f"--episodes is {count} and has to be from 1 to 10000"):
                check_episodes(count)


@pytest.mark.parametrize(
    ("guidance", "parts", "prior"),
    [("affordance", None, True), ("grasps", ("prior",), True), ("affordance", ("reward",), False),
     ("none", None, False), ("none", ("prior",), False), ("grasps", (), False)],
)  # fmt: skip
def test_actions_are_residuals_of_a_prior_that_is_in_force(guidance: Any, parts: Any, prior: bool):
    config = dataclasses.replace(CONFIG, guidance=guidance, guidance_parts=parts)
    assert config.has_prior == prior
    shown = None if parts is None else list(parts)
    assert config.task_options == {"guidance": guidance, "guidance_parts": shown, "preset": "standard"}
    more = dataclasses.replace(config, reward="paper", task={"lift": 0.1}).task_options
    assert (more["reward_mode"], more["config"]) == ("paper", {"lift": 0.1})


# ------------------------------------------------------------------------ the file


@pytest.mark.parametrize(
    ("sizes", "fits"),
    [((1, 1), True), ((65_536, 1), True), ((1, 65_536), True), ((0, 1), False), ((1, 0), False), ((65_537, 1), False),
     ((1, 65_537), False)],
)  # fmt: skip
def test_sizes_of_a_checkpoint_are_from_one_to_65536(tmp_path: Path, sizes: tuple[int, int], fits: bool):
    path = tmp_path / "a.safetensors"
    Checkpoint(CONFIG, sizes, {"w": torch.zeros(2)}).write(path)
    if fits:
        assert read_checkpoint(path).sizes == sizes
    else:
        with pytest.raises(InputError, match="has the sizes"):
            read_checkpoint(path)


@pytest.mark.parametrize(
    ("entry", "words"),
    [({"sizes": "[4, 2, 3]"}, "the sizes"), ({"sizes": "[true, 2]"}, "the sizes"), ({"sizes": "4"}, "the sizes"),
     ({"progress": "[]"}, "no counters"), ({"config_digest": "0" * 12}, "settings that were changed"),
     ({"version": "0"}, "version"), ({"version": "3"}, "version")],
)  # fmt: skip
def test_a_header_that_does_not_fit_is_refused(tmp_path: Path, entry: dict[str, str], words: str):
    path = tmp_path / "a.safetensors"
    Checkpoint(CONFIG, (4, 2), {"w": torch.zeros(2)}).write(path)
    tensors, header = read_safetensors(path, "checkpoint", {})
    kept = {name: value for name, value in header.items() if name != "digest"}
    write_safetensors(path, tensors, kept | entry)
    with pytest.raises(InputError, match=words):
        read_checkpoint(path)
    write_safetensors(path, tensors, kept)
    assert read_checkpoint(path).config == CONFIG


def test_a_checkpoint_of_an_earlier_version_may_have_numbers_that_are_refused_today(tmp_path: Path):
    path = tmp_path / "a.safetensors"
    for earlier in ({"eval_episodes": 100_000}, {"final_episodes": 10**6}, {"learner": PPOConfig(log_std=0.5)}):
        config = dataclasses.replace(CONFIG, **earlier)
        with pytest.raises(InputError):
            check(config)
        Checkpoint(config, (4, 2), {"w": torch.zeros(2)}).write(path)
        assert read_checkpoint(path).config == config


def test_a_checkpoint_holds_the_networks_and_two_moments_of_each_parameter():
    module = nn.BatchNorm1d(3)  # parameters: 2 * 3 floats; buffers: 2 * 3 floats and a whole number of 8 bytes
    adam = torch.optim.Adam(module.parameters())
    assert bytes_of({"a": module}, {"adam": adam}) == 4 * (6 + 6) + 8 + 2 * 4 * 6
    assert bytes_of({"a": module}, {}) == 4 * 12 + 8


def test_the_first_difference_of_a_checkpoint_is_named():
    agents = {"left": AgentColumns((0, 1), (0,)), "right": AgentColumns((2, 3), (1,))}
    stored = Checkpoint(CONFIG, (4, 2), {}, agents=agents)
    other = dataclasses.replace(CONFIG, env="Other-v1", seed=3)
    less = {"left": AgentColumns((0,), (0,)), "right": agents["right"]}
    for config, sizes, found, words in (
        (other, (5, 2), None, "env Fake-v1, not Other-v1"),
        (CONFIG, (5, 3), None, "observation size 4, not 5"),
        (CONFIG, (4, 3), agents, "action size 2, not 3"),
        (CONFIG, (4, 2), None, "agents left, right, not none"),
        (CONFIG, (4, 2), {"left": agents["left"]}, "agents left, right, not left"),
        (CONFIG, (4, 2), less, "columns of left"),
        (dataclasses.replace(CONFIG, seed=3), (4, 2), agents, "config digest"),
        (dataclasses.replace(CONFIG, seed=3), (4, 2), less, "columns of left"),
    ):
        with pytest.raises(InputError, match=words):
            check_belongs(stored, PLACE, config, sizes, found, exactly=True)
    check_belongs(stored, PLACE, CONFIG, (4, 2), agents, exactly=True)
    check_belongs(stored, PLACE, dataclasses.replace(CONFIG, seed=3), (4, 2), agents, exactly=False)


def test_one_number_of_a_tensor_that_is_not_finite_is_enough():
    check_finite({"a": torch.ones(2), "b": torch.arange(3)}, PLACE)
    with pytest.raises(InputError, match="infinity in b"):
        check_finite({"a": torch.ones(2), "b": torch.tensor([1.0, INF])}, PLACE)


def test_random_numbers_go_on_where_they_were():
    np.random.standard_normal()  # noqa: NPY002  of a pair the second one waits
    state = pack_rng()
    draws = []
    for _ in range(2):
        unpack_rng(state)
        draws.append((torch.rand(3).tolist(), np.random.standard_normal(3).tolist()))  # noqa: NPY002
    assert draws[0] == draws[1]


@pytest.mark.parametrize("content", [[], "x", None, {1: "x"}, {"env": "x", 2: "y"}])
def test_settings_that_are_no_mapping_of_names_are_refused(content: Any):
    with pytest.raises(InputError, match="must be a mapping of names to values"):
        config_from_dict(content)
    assert config_from_dict(plain(CONFIG)) == CONFIG
