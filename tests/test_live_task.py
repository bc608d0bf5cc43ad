"""An environment of a live session, invented: who acts, when an episode is over, and when it is made anew."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from invented_live import DT, LAST, SETUP, poses

from dora.errors import InputError
from dora.live.live_task import Beginning, LiveTask
from dora.live.players import Player
from dora.live.recordings import RecordedEpisode, Recording
from dora.sim.batch.resets import START
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.starts import ChosenStarts

ENV = "DoraCube-v1"


class Invented(DoraEnv):
    """Keeps what it is asked; its reward is the number of the step, and it fails in step `fails`."""

    def __init__(self, options: dict[str, Any], arms: int = 1):
        starts = ChosenStarts(SETUP.numbers, draws=lambda shares: 10 * shares, shares=lambda draws, pose: draws / 10)
        pose = SimpleNamespace(p=torch.zeros(1, 3), q=torch.zeros(1, 4))
        task = SimpleNamespace(
            starts=lambda: starts, reachable=lambda arm, rows, p, q: torch.tensor([[True, False, True]])
        )
        each = {f"arm {k}": SimpleNamespace(name=f"arm {k}", spec=SimpleNamespace(object="cube")) for k in range(arms)}
        group = Arms(each)
        group.choices = {"arm 0": SimpleNamespace(buffers=SimpleNamespace(chosen=torch.tensor([2])))}
        self.__dict__.update({
            "options": options, "task": task, "arms": group, "arm": each["arm 0"], "action_size": 3, "machine": None,
            "objects": dict.fromkeys(("cube", "lid"), SimpleNamespace(pose=pose)), "mdp": SimpleNamespace(failure="hm"),
            "task_scene": SimpleNamespace(push=lambda impulse: self.pushed.append(impulse)), "pushed": [],
            "resets": [], "actions": [], "count": 0, "fails": 0, "closed": False,
        })  # fmt: skip

    def __getattribute__(self, name: str) -> Any:
        own = object.__getattribute__(self, "__dict__")
        return own[name] if name in own else object.__getattribute__(self, name)

    def reset(self, seed: Any = None, options: Any = None) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.__dict__["count"] = 0
        self.resets.append(seed if options is None else options)
        assert self.chosen_start is not None
        self.placed = self.chosen_start(torch.tensor([[1.0, 2.0]]))
        return torch.full((1, 2), float(len(self.resets))), {}

    def step(self, action: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.__dict__["count"] += 1
        self.actions.append(action[0].tolist())
        return torch.zeros(1, 2), torch.tensor([float(self.count)]), None, None, self.evaluate()

    def evaluate(self) -> Any:
        flags = {"success": self.count >= 2, "raw_success": False, "fail": self.count == self.fails > 0}
        values = {**flags, "unreachable": False, "penetration_mm": 0.5, "penetration_max_mm": 1.0}
        return {name: torch.tensor([value]) for name, value in values.items()}

    def close(self) -> None:
        self.__dict__["closed"] = True


class Arms(dict):
    """Arms by name, and the candidates that they chose."""

    choices: Any


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Environments that are made in the test."""
    made: list[Any] = []

    def make(env_id: str, num_envs: int, **options: Any) -> DoraEnv:
        if options.get("config") == "wrong":
            raise TypeError("no number")
        made.append(Invented(options, options.get("arms", 1)))
        return made[-1]

    reader = SimpleNamespace(passed=lambda: (poses(1.0), poses(2.0), poses(3.0)))
    monkeypatch.setattr("dora.live.live_task.make_task", make)
    monkeypatch.setattr("dora.live.live_task.read_setup", lambda env, env_id: SETUP)
    monkeypatch.setattr("dora.live.live_task.Reader", lambda env: reader)
    monkeypatch.setattr("dora.live.live_task.active_stages", lambda machine: (1,))
    return made


def begins(player: Player, **given: Any) -> Beginning:
    return Beginning(**{"player": player, "preset": "none", "seed": 7, **given})


class Recorded(Recording):
    """Two episodes with two and six actions; the second has a first state."""

    def episode(self, number: int) -> RecordedEpisode:
        actions = np.full((2 + 4 * number, 3), [[0.1, 0.2, 0.3]], np.float32)
        actions[:, 0] = np.arange(len(actions))
        return RecordedEpisode(
            40 + number, actions, {"actors": {"cube": np.ones((1, 13), np.float32)}} if number else None
        )


RECORDING = Recorded(Path("a.h5"), ENV, {}, (("traj_0", 1), ("traj_1", 2)))


def play(task: LiveTask) -> int:
    """Steps until the episode is over."""
    for count in range(1, 20):
        task.step()
        if task.over:
            return count
    return 0


def test_zero_correction_is_a_zero_action_for_as_long_as_an_episode_lasts(made: list[Any]):
    task = LiveTask(ENV, begins(Player("zero")))
    assert made[0].resets == [7]
    first = task.episode()
    assert (first.step, first.time, first.reward, first.over, first.success) == (0, 0.0, 0.0, False, False)
    assert play(task) == LAST
    assert made[0].actions == [[0.0] * 3] * LAST
    last = task.episode()
    assert (last.step, last.time, last.reward, last.over, last.success) == (LAST, LAST * DT, float(LAST), True, True)
    assert (last.chosen, last.stages, last.seed) == ({"arm 0": 2}, (1,), 7)
    assert last.history.time.tolist() == [DT, 2 * DT, 3 * DT, 4 * DT]
    assert [each.objects["cube"][0] for each in task.passed] == [1.0, 2.0]
    task.begin(begins(Player("zero"), seed=8))
    assert (task.over, task.episode().step, len(task.episode().history.time)) == (False, 0, 0)
    assert len(made) == 1


def test_actions_of_a_policy_are_cut_to_their_range(made: list[Any]):
    seen: list[float] = []
    act = lambda seen_now: seen.append(float(seen_now[0, 0])) or np.array([[3.0, -3.0, 0.5]], np.float32)  # noqa: E731
    task = LiveTask(ENV, begins(Player("policy", {}, act)))
    task.step()
    task.step()
    assert made[0].actions == [[1.0, -1.0, 0.5]] * 2
    assert seen == [1.0, 0.0]


def test_a_failure_ends_an_episode(made: list[Any]):
    task = LiveTask(ENV, begins(Player("zero")))
    made[0].__dict__["fails"] = 2
    assert play(task) == 2
    assert task.episode().verdict == "failed: hm"


@pytest.mark.parametrize(("seed", "number"), [(2, 0), (5, 1)])
def test_recordings_are_played_to_their_ends_one_after_the_other(made: list[Any], seed: int, number: int):
    task = LiveTask(ENV, begins(Player("recording", {}, None, RECORDING), seed=seed))
    env, length = made[0], 2 + 4 * number
    assert env.resets[0] == 40 + number
    assert len(env.resets) == 1 + number
    if number:
        assert torch.equal(env.resets[1][START]["env_states"]["actors"]["cube"], torch.ones(1, 13))
    assert play(task) == length
    assert env.actions == [pytest.approx([k, 0.2, 0.3]) for k in range(length)]
    assert len(task.episode().history.time) == length


def test_an_environment_is_made_anew_for_other_options_only(made: list[Any]):
    task = LiveTask(ENV, begins(Player("one", {"a": 1})))
    task.begin(begins(Player("two", {"a": 1})))
    assert len(made) == 1
    task.begin(begins(Player("one", {"a": 1}), preset="hard"))
    assert (len(made), made[0].closed, made[1].closed) == (2, True, False)
    assert made[1].options["preset"] == "hard"
    with pytest.raises(InputError, match="cannot be made with"):
        task.begin(begins(Player("three", {"config": "wrong"}, None, Recorded(Path("b"), ENV, {}, (("traj_0", 0),)))))
    assert not made[1].closed
    task.close()
    task.close()
    assert made[1].closed


def test_a_start_is_random_unless_its_numbers_are_chosen(made: list[Any]):
    task = LiveTask(ENV, begins(Player("zero")))
    assert made[0].placed.tolist() == [[1.0, 2.0]]
    assert task.episode().shares == pytest.approx((0.1, 0.2))
    task.begin(begins(Player("zero"), shares=(0.5, 0.25)))
    assert made[0].placed.tolist() == [[5.0, 2.5]]
    assert task.episode().shares == (0.5, 0.25)
    made[0].task.starts = lambda: None
    task.begin(begins(Player("zero")))
    assert (made[0].placed.tolist(), task.episode().shares) == ([[1.0, 2.0]], ())


def test_a_candidate_is_chosen_alone_among_all(made: list[Any]):
    task = LiveTask(ENV, begins(Player("zero")))
    assert made[0].narrow == {}
    assert task.episode().reachable == (0, 2)
    task.begin(begins(Player("zero"), candidate=1))
    assert made[0].narrow["arm 0"](torch.tensor([[True, False, True]])).tolist() == [[False, True, False]]


def test_of_several_arms_no_candidate_is_said_to_be_within_reach(made: list[Any]):
    player = Player("recording", {"arms": 2}, None, RECORDING)
    assert LiveTask(ENV, begins(player)).episode().reachable == ()


def test_a_push_is_of_the_first_object(made: list[Any]):
    LiveTask(ENV, begins(Player("zero"))).push(0.3, -0.4)
    torch.testing.assert_close(made[0].pushed[0], torch.tensor([[[0.3, -0.4, 0.0], [0.0, 0.0, 0.0]]]))
