"""Episodes, films and figures of an evaluation, and statistics of the task environment, worked out by hand."""

import functools
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from fake_task import STEP, PointMass
from tensordict import TensorDict
from test_run_by_hand import COLUMNS, evaluation_of
from torch import Tensor

from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import EpisodeColumns, TaskEnv, TrainingRules, ended_episodes
from dora.agents.config import PPOConfig, RunConfig
from dora.agents.evaluation import play
from dora.agents.evaluation.evaluate import (
    FINAL_SEED,
    MOST_SEEDS,
    STARTS,
    Evaluation,
    first_seed,
    no_correction,
    run_batch,
)
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.evaluation.play import (
    check_film,
    checkpoint_path,
    episode_frames,
    evaluate_zero,
    record,
    write_film,
)
from dora.agents.learners.learner import make_learner
from dora.agents.seeds import TRAINING_SEEDS, seeds_for
from dora.errors import InputError

# ---------------------------------------------------------------------- evaluations


def test_figures_of_an_evaluation_are_those_of_its_table():
    found = evaluation_of([1.0, 0.0, 0.0, 0.0, 0.0])
    assert (found.success_rate, found.raw_success_rate, found.return_mean) == (pytest.approx(0.2), 1.0, 2.0)
    assert found.success_at_end_rate == found.success_rate
    assert found.stage_rates == {"reach": 1.0, "lift": pytest.approx(0.2)}
    assert found.nonfinite_episodes == 4
    assert (found.penetration_mm(), found.penetration_mm(0.5)) == (4.0, 2.0)
    assert found.penetration_p95_mm == pytest.approx(3.8)
    assert found.success_interval == pytest.approx((0.0362, 0.6245), abs=1e-4)
    assert found.values("reward/near").tolist() == [0.5] * 5
    assert found.values("length").tolist() == [10.0] * 5
    with pytest.raises(ValueError, match="not in tuple"):
        found.values("unknown")
    plain = EpisodeColumns.of(("reward/near",))
    other = Evaluation(plain, torch.ones(2, len(plain.names)))
    assert (other.raw_success_rate, other.penetration_mm(), other.penetration_p95_mm) == (None, None, None)
    assert (other.nonfinite_episodes, other.stage_rates, other.success_at_end_rate) == (0, {}, 1.0)


def test_starts_of_a_seed_follow_those_of_the_seed_before():
    assert [first_seed(seed, 1) - FINAL_SEED for seed in (0, 1, 7)] == [10_000, 20_000, 80_000]
    assert first_seed(0, STARTS) == FINAL_SEED + STARTS
    assert first_seed(MOST_SEEDS - 1, 1) == FINAL_SEED + STARTS * MOST_SEEDS
    for seed, episodes in ((-1, 1), (MOST_SEEDS, 1), (0, STARTS + 1)):
        with pytest.raises(InputError, match="starts"):
            first_seed(seed, episodes)


def test_seeds_of_training_differ_and_depend_on_seed_and_step():
    many = seeds_for(3, 0, 1000)
    assert len(set(many)) == 1000
    assert all(0 <= seed < TRAINING_SEEDS for seed in many)
    assert max(many) > 0.9 * TRAINING_SEEDS
    assert seeds_for(3, 0, 10) == many[:10]
    assert not set(seeds_for(3, 1, 1000)) & set(many)
    assert not set(seeds_for(4, 0, 1000)) & set(many)


class Unequal(PointMass):
    """Row k fails after k + 1 steps, and says so in its start."""

    def step(self, action: Tensor) -> Any:
        *rest, info = super().step(action)
        return *rest, info | {"fail": self.elapsed_steps > torch.arange(self.num_envs)}

    @property
    def start_numbers(self) -> dict[str, Tensor]:
        return {"steps": self.elapsed_steps.float(), "goal": self.goal[:, 0].clone()}


def test_each_episode_counts_to_its_own_end_and_has_the_seed_after_the_one_before():
    env = TaskEnv(Unequal(4))
    table = run_batch(env, no_correction(2), 40)
    names = env.columns.names
    assert table[:, names.index("length")].tolist() == [1, 2, 3, 4]
    assert table[:, len(names)].tolist() == [0.0] * 4
    goals = [np.random.default_rng(40 + row).uniform(-1, 1, 4)[2] for row in range(4)]
    assert table[:, len(names) + 1].tolist() == pytest.approx(goals)


def test_no_correction_is_an_action_of_zeros():
    assert no_correction(3)(torch.ones(2, 7)).tolist() == [[0.0] * 3] * 2


def test_zero_correction_is_evaluated_on_as_many_episodes_as_are_asked_for():
    config = RunConfig("Fake-v1", "ppo", workers=1, eval_envs=4, final_episodes=6, learner=PPOConfig(hidden=(4,)))
    made = evaluate_zero(config, PointMass, 90)
    assert (len(made.table), made.first_seed) == (6, 90)
    evaluators = Evaluators(PointMass, config)
    assert torch.equal(evaluators.run(None, 6, 90).table, made.table)
    assert not torch.equal(evaluators.run(None, 6, 91).table, made.table)
    evaluators.close()


# ---------------------------------------------------------------------------- films


class Filmed(PointMass):
    """Its picture is as bright as the steps of the episode, its actions are noted."""

    control_freq = 10

    def __init__(self, num_envs: int = 1, **options: Any):
        super().__init__(num_envs, max_steps=5, **options)
        self.actions: list[list[float]] = []

    def step(self, action: Tensor) -> Any:
        self.actions.append(action[0].tolist())
        return super().step(action)

    def render(self) -> Tensor:
        return torch.full((1, 24, 40, 3), 20 * int(self.elapsed_steps[0]), dtype=torch.uint8)


@pytest.mark.parametrize(("fail_at", "steps"), [(-1, 5), (5, 5), (3, 3), (1, 1)])
def test_an_episode_is_shown_from_its_start_to_its_end(fail_at: int, steps: int):
    task = Filmed(fail_at=fail_at)
    frames = episode_frames(task, lambda observation: torch.full((len(observation), 2), 9.0), 3)
    assert [int(frame[0, 0, 0]) for frame in frames] == [20 * k for k in range(steps + 1)]
    assert {frame.shape for frame in frames} == {(24, 40, 3)}
    assert task.actions == [[1.0, 1.0]] * steps  # within the bounds of actions


@pytest.mark.parametrize(("make", "rate"), [(Filmed, 10), (functools.partial(PointMass, 1, 5), 20)])
def test_a_film_has_the_size_and_the_rate_of_its_task(tmp_path: Path, make: Any, rate: int):
    path = tmp_path / "deep" / "video" / "a.mp4"
    record(make, None, path, 2, first_seed=4)
    opened: Any = imageio.get_reader(path)
    with opened as reader:
        meta = reader.get_meta_data()
        frames = [np.asarray(frame) for frame in reader]
    assert meta["fps"] == rate
    assert meta["size"] == ((40, 24) if make is Filmed else (32, 32))
    assert len(frames) == 2 * 6
    if make is Filmed:
        assert [float(frame.mean()) for frame in frames] == pytest.approx([0, 20, 40, 60, 80, 100] * 2, abs=6)


@pytest.mark.parametrize("share", [0.5, 0.0])
def test_a_film_that_the_encoder_did_not_finish_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
):
    """As on a disk that is full; what was there before stays, and nothing else does."""
    path = tmp_path / "a.mp4"
    path.write_text("an earlier film")
    is_whole = play.film_is_whole

    def cut(film: Path, frames: int, rate: int) -> bool:
        content = film.read_bytes()
        film.write_bytes(content[: int(share * len(content))])
        return is_whole(film, frames, rate)

    monkeypatch.setattr(play, "film_is_whole", cut)
    with pytest.raises(InputError, match=r"a\.mp4 cannot be written"):
        record(Filmed, None, path, 2)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert path.read_text() == "an earlier film"


def test_a_film_lacks_no_frame(tmp_path: Path):
    record(Filmed, None, tmp_path / "a.mp4", 2)
    assert play.film_is_whole(tmp_path / "a.mp4", 12, 10)
    assert not play.film_is_whole(tmp_path / "a.mp4", 14, 10)
    assert not play.film_is_whole(tmp_path / "b.mp4", 1, 10)


def test_what_a_task_refuses_while_it_is_filmed_is_said_as_it_is(tmp_path: Path):
    class Refusing(Filmed):
        def step(self, action: Tensor) -> Any:
            if self.elapsed_steps[0] == 3:
                raise InputError("the action is NaN.")
            return super().step(action)

    with pytest.raises(InputError, match=r"^the action is NaN"):
        write_film(tmp_path / "a.mp4", (episode_frames(Refusing(), no_correction(2), seed) for seed in (1, 2)), 10)
    assert not list(tmp_path.iterdir())


def test_names_of_films_and_checkpoints(tmp_path: Path):
    for name in ("a.mp4", "a.GIF", "a.b.mkv"):
        check_film(tmp_path / name)
    for name in ("a", "a.txt", "mp4"):
        with pytest.raises(InputError, match="is no name of a film"):
            check_film(tmp_path / name)
    (tmp_path / "a.mp4").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        check_film(tmp_path / "a.mp4")
    assert checkpoint_path(tmp_path) == tmp_path / "checkpoints" / "best.safetensors"
    assert checkpoint_path(tmp_path / "b.safetensors") == tmp_path / "b.safetensors"
    (tmp_path / "policy.safetensors").touch()  # beside a stored result
    assert checkpoint_path(tmp_path) == tmp_path / "policy.safetensors"
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "best.safetensors").touch()
    assert checkpoint_path(tmp_path) == tmp_path / "checkpoints" / "best.safetensors"


# --------------------------------------------------------------------- environment


class Told(PointMass):
    """A task whose answers are given, one for each step."""

    logged = ("success", "raw_success", "success_at_end", "penetration_mm", "stage/a", "reward/a", "nonfinite")
    answers: Any = None

    def step(self, action: Tensor) -> Any:
        observation, _, fail, truncated, _ = super().step(action)
        given = self.answers[int(self.elapsed_steps[0]) - 1]
        observation = observation + torch.tensor(given.get("observation", [0.0, 0.0]))[:, None]
        info = {name: torch.tensor(given.get(name, [0.0, 0.0])) for name in self.logged}
        return observation, torch.tensor(given.get("reward", [1.0, 2.0])), fail, truncated, info


def steps_of(answers: list[dict[str, list[float]]], **rules: Any) -> tuple[TaskEnv, list[TensorDict]]:
    """The environment and what it says after each step of two rows."""
    task = Told(2, max_steps=4)
    task.answers = answers
    env = TaskEnv(task, seed=1, rules=TrainingRules(**rules))
    env.reset()
    data = TensorDict({"action": torch.zeros(2, 2)}, [2])
    return env, [env._step(data) for _ in answers]


def test_statistics_keep_the_last_the_highest_and_the_sum():
    env, said = steps_of([
        {"success": [1, 0], "raw_success": [1, 1], "penetration_mm": [3, 1], "stage/a": [1, 0], "reward/a": [2, 0]},
        {"success": [0, 1], "raw_success": [0, 1], "penetration_mm": [1, 2], "stage/a": [0, 0], "reward/a": [4, 1]},
    ])  # fmt: skip
    wanted = {
        "success": [0, 1], "raw_success": [0, 1], "whole": [1, 1], "penetration_mm": [3, 2], "stage/a": [1, 0],
        "reward/a": [3, 0.5], "return": [2, 4], "length": [2, 2], "nonfinite": [0, 0], "success_at_end": [0, 0],
    }  # fmt: skip
    assert {n: env.columns.column(said[1]["statistics"], n).tolist() for n in env.columns.names} == wanted
    assert env.columns.column(said[0]["statistics"], "success").tolist() == [1, 0]  # a copy: it stays
    zero = torch.zeros(2, len(env.columns.names))
    assert env.columns.column(zero, "reward/a").tolist() == [0, 0]  # before the first step


@pytest.mark.parametrize(
    "wrong", [{"observation": [0, float("inf")]}, {"reward": [5, float("nan")]}, {"nonfinite": [0, 1]}]
)
def test_a_row_that_is_not_finite_fails_earns_nothing_and_is_no_success(wrong: dict[str, list[float]]):
    good = {"success": [1.0, 1.0], "raw_success": [1.0, 1.0], "reward": [5.0, 7.0]}
    env, said = steps_of([good, good, good, good | wrong])  # in the last step, where the other one's time is over
    last = said[3]
    assert last["terminated"][:, 0].tolist() == [False, True]
    assert last["truncated"][:, 0].tolist() == [True, False]
    assert last["done"][:, 0].tolist() == [True, True]
    assert last["reward"][:, 0].tolist() == [5, 0]
    assert last["observation"].isfinite().all()
    found = {name: env.columns.column(last["statistics"], name).tolist() for name in env.columns.names}
    assert (found["success"], found["raw_success"], found["whole"]) == ([1, 0], [1, 0], [1, 1])
    assert (found["nonfinite"], found["return"]) == ([0, 1], [20, 21])
    assert not any(one["done"].any() for one in said[:3])


def test_first_episodes_that_are_staggered_last_from_one_step_to_the_most():
    task = PointMass(400, max_steps=4)
    env = TaskEnv(task, seed=2, rules=TrainingRules(stagger=True))
    env.reset()
    data = TensorDict({"action": torch.zeros(400, 2)}, [400])
    said = [env._step(data) for _ in range(4)]
    first = torch.stack([one["done"][:, 0] for one in said], 1).float().argmax(1) + 1
    assert [60 < int((first == length).sum()) < 140 for length in (1, 2, 3, 4)] == [True] * 4
    whole = env.columns.column(said[3]["statistics"], "whole")
    assert torch.equal(whole == 1, first == 4)
    done, statistics = torch.ones(400, 1, dtype=torch.bool), said[3]["statistics"]
    assert len(ended_episodes(done, statistics, env.columns)) == int((first == 4).sum())
    assert len(ended_episodes(~done, statistics, env.columns)) == 0


def test_the_second_episode_of_a_row_is_a_whole_one_and_begins_with_empty_statistics():
    env = TaskEnv(PointMass(3, max_steps=4), seed=0, rules=TrainingRules(stagger=True))
    state: Any = env.reset()
    lengths: list[list[float]] = [[], [], []]
    for _ in range(14):
        state["action"] = torch.zeros(3, 2)
        out, state = env.step_and_maybe_reset(state)
        for row in out["next", "done"][:, 0].nonzero()[:, 0].tolist():
            lengths[row].append(float(env.columns.column(out["next", "statistics"], "length")[row]))
    assert all(found[1:3] == [4.0, 4.0] and 1 <= found[0] <= 4 for found in lengths)
    restarted = env.restart([5, 6, 7])
    assert restarted["statistics"].eq(0).all()
    assert not restarted["done"].any()
    goals = [np.random.default_rng(seed).uniform(-1, 1, 4)[2] for seed in (5, 6, 7)]
    assert restarted["observation"][:, 2].tolist() == pytest.approx(goals)


def test_actions_beyond_either_bound_are_clipped():
    task = PointMass(2)
    env = TaskEnv(task, seed=0)
    env.reset()
    before = task.position.clone()
    env._step(TensorDict({"action": torch.tensor([[9.0, -9.0], [0.5, -1.0]])}, [2]))
    torch.testing.assert_close(task.position - before, STEP * torch.tensor([[1.0, -1.0], [0.5, -1.0]]))
    assert env.sizes == (4, 2)
    assert COLUMNS.names[:3] == ("success", "whole", "raw_success")


def test_a_task_is_closed_with_its_environment_and_with_those_that_evaluate():
    made: list[PointMass] = []

    def make(num_envs: int) -> PointMass:
        made.append(PointMass(num_envs))
        return made[-1]

    env = TaskEnv(make(2))
    assert not made[0].closed
    env.close()
    assert made[0].closed
    config = RunConfig("Fake-v1", "ppo", workers=1, eval_envs=4, learner=PPOConfig(hidden=(4,)))
    evaluators = Evaluators(make, config)
    evaluators.run(None, 7, 1)
    assert [task.closed for task in made[1:]] == [False, False]
    evaluators.close()
    assert [task.closed for task in made[1:]] == [True, True]
    rules = TrainingRules()
    policy = make_learner(config, 4, 2).policy
    with Rollouts(lambda: make(4), policy, workers=0, num_envs=4, rollout=2, seeds=[1], rules=rules) as rollouts:
        rollouts.collect()
        assert not made[-1].closed
    assert made[-1].closed
