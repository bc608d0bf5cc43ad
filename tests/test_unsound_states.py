"""States in which no simulation can be are refused before anything changes."""

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import pytest
import torch

from dora.errors import InputError
from dora.sim import BACKEND

START = "reset_to_env_states"
CASES: list[tuple[str, Callable[[dict[str, Any]], Any], str]] = [
    ("NaN", lambda s: s["actors"]["cube"][:, 0].fill_(torch.nan), "not finite"),
    ("infinity", lambda s: robot(s)[:, 15].fill_(torch.inf), "not finite"),
    ("far away", lambda s: robot(s)[:, 15].fill_(1e30), "above 1e\\+06"),
    ("no turn", lambda s: s["actors"]["cube"][:, 3:7].zero_(), "norm is not 1"),
    ("long quaternion", lambda s: robot(s)[1, 3:7].mul_(2), "norm is not 1"),
]
"""Faults of a state of the simulator, and words of the answer."""
OURS: list[tuple[str, Callable[[dict[str, Any]], Any], str]] = [
    ("NaN command", lambda s: s["controller"]["target"][:, 3].fill_(torch.nan), "controller.*not finite"),
    ("no mass", lambda s: s["memory"]["object.cube.mass"].zero_(), "mass.*not from 1e-09"),
    ("negative friction", lambda s: s["memory"]["object.cube.friction"].fill_(-1), "friction.*not from 0"),
    ("NaN mass", lambda s: s["memory"]["object.cube.mass"].fill_(torch.nan), "mass.*not finite"),
    ("stage 99", lambda s: s["machine"]["stage"].fill_(99), "stage.*not from 0 to"),
    ("stage -1", lambda s: s["guide.arm"]["stage"].fill_(-1), "stage.*not from 0 to"),
    ("no candidate", lambda s: s["guide.arm"]["chosen"].fill_(4), "chosen.*not from 0 to 3"),
    ("no size", lambda s: s["task"]["scale"].zero_(), "scale.*not from 0.001"),
    ("huge", lambda s: s["task"]["scale"].fill_(1e9), "scale.*not from 0.001"),
    ("steps", lambda s: s["task"]["elapsed"].fill_(-3), "elapsed.*not from 0"),
]
"""Faults of what our tasks remember."""


def robot(state: dict[str, Any]) -> torch.Tensor:
    """Rows of the first robot."""
    return next(iter(state["articulations"].values()))


@pytest.fixture(scope="module", params=["PickCube-v1", "DoraCube-v1"])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    made = gym.make(request.param, num_envs=2, sim_backend=BACKEND, obs_mode="state", render_backend="none")
    yield made.unwrapped
    made.close()


@pytest.fixture(scope="module")
def ours() -> Iterator[Any]:
    made = gym.make("DoraCube-v1", num_envs=2, sim_backend=BACKEND)
    yield made.unwrapped
    made.close()


def assert_refused(env: Any, spoil: Callable[[dict[str, Any]], Any], words: str) -> None:
    """A spoiled state is refused as such, and as the start of an episode; the environment stays as it was."""
    env.reset(seed=0)
    before, state = env.get_state(), env.get_state_dict()
    spoil(state)
    with pytest.raises(InputError, match=words) as error:
        env.set_state_dict(state)
    assert "\n" not in str(error.value)
    assert torch.equal(env.get_state(), before)
    with pytest.raises(InputError, match="not finite" if "finite" in words else words):
        env.reset(options={START: {"env_states": state}})
    env.reset(seed=0)
    assert env.step(env.action_space.sample() * 0)[0].isfinite().all()


@pytest.mark.parametrize(("spoil", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_a_state_of_the_simulator(env: Any, spoil: Callable[[dict[str, Any]], Any], words: str):
    assert_refused(env, spoil, words)


@pytest.mark.parametrize(("spoil", "words"), [case[1:] for case in OURS], ids=[case[0] for case in OURS])
def test_what_a_task_remembers(ours: Any, spoil: Callable[[dict[str, Any]], Any], words: str):
    assert_refused(ours, spoil, words)


def test_a_flat_state(env: Any):
    env.reset(seed=0)
    flat = env.get_state()
    for column, value, words in ((0, torch.nan, "not finite"), (slice(3, 7), 0.0, "norm is not 1"), (0, 1e9, "above")):
        wrong = flat.clone()
        wrong[1, column] = value
        with pytest.raises(InputError, match=words):
            env.set_state(wrong)
    env.set_state(flat)
    assert torch.allclose(env.get_state(), flat, atol=1e-5)


def test_whole_numbers_are_a_state(env: Any):
    env.reset(seed=0)
    pose = [0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0]
    state = env.get_state_dict()
    state["actors"]["cube"] = [pose, pose]
    env.set_state_dict(state)
    assert torch.equal(env.get_state_dict()["actors"]["cube"], torch.tensor([pose, pose]).float())


def test_overlap_that_was_not_measured_is_no_fault(ours: Any):
    ours.reset(seed=0)
    state = ours.get_state_dict()
    for name in ("episode.penetration", "episode.max_penetration"):
        state["memory"][name].fill_(torch.nan)
    ours.set_state_dict(state)
    assert ours.memory.get_state()["episode.max_penetration"].isnan().all()


def test_rows_that_a_mask_leaves_out_may_hold_anything(env: Any):
    env.reset(seed=0)
    state = env.get_state_dict()
    state["actors"]["cube"][0] = torch.nan
    wanted = state["actors"]["cube"][1].clone()
    env.reset(options={"env_idx": torch.tensor([False, True]), START: {"env_states": state}})
    found = env.get_state_dict()["actors"]["cube"]
    assert found.isfinite().all()
    assert torch.allclose(found[1], wanted, atol=1e-5)


def test_a_state_of_another_size_replaces_one_that_is_unsound(ours: Any):
    ours.reset(seed=0)
    state = ours.get_state_dict()
    ours.memory.objects["cube"].mass[:] = torch.nan
    state["task"]["scale"] *= 1.01
    ours.set_state_dict(state)
    assert ours.memory.objects["cube"].mass.isfinite().all()


def test_a_scene_that_cannot_be_built_leaves_the_next_reset_as_it_was(ours: Any, monkeypatch: pytest.MonkeyPatch):
    ours.reset(seed=0)
    sizes = ours.scale.clone()
    with monkeypatch.context() as patch:
        patch.setattr(type(ours.task), "build", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            ours.rebuild(2 * sizes)
    ours.reset(seed=0, options={"reconfigure": True})
    assert (ours.scale < 1.5).all()
