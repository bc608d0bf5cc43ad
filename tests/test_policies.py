"""Policies that come with Dora: chosen by training, used on observations of `gym.make`, and what their cards say."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import dora
from dora.agents.checkpoint import read_checkpoint
from dora.agents.collecting.task_env import EpisodeColumns
from dora.agents.evaluation.evaluate import Evaluation
from dora.agents.reports.run_results import find_runs
from dora.digests import sealed
from dora.errors import InputError
from dora.policies import bundle
from dora.policies.bundle import PAGE, cards_table, check_agrees, chosen, is_bundled, make_card
from dora.policies.card import Card
from dora.policies.policy import bundled_files, bundled_ids, load_policy
from dora.tables import wilson
from dora.tasks import find_task, task_ids
from dora.tasks.env.options import task_config

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results" / "tasks"
CARDS = [env_id for env_id in bundled_ids() if bundled_files(env_id)[1].is_file()]
STARTS, FEWEST = 8, 6
"""Episodes of the check of a policy, and how many of them have to succeed [1]."""


def observation(env_id: str, rows: int = 3) -> np.ndarray:
    size = load_policy(env_id).observation_size
    return np.random.default_rng(0).normal(size=(rows, size)).astype(np.float32)


def test_every_task_has_a_policy_and_every_policy_a_card() -> None:
    assert bundled_ids() == task_ids()
    assert task_ids() == CARDS


def test_the_package_names_what_it_offers() -> None:
    assert {"load_policy", "__version__"} <= set(dora.__all__)
    assert all(hasattr(dora, name) for name in dora.__all__)


def test_importing_dora_imports_no_learner() -> None:
    code = "import sys, dora; print({'torchrl', 'tensordict', 'dora.policies', 'dora.agents'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


@pytest.mark.parametrize("env_id", bundled_ids())
def test_arrays_and_tensors_single_and_batched_give_the_same_actions(env_id: str) -> None:
    policy, batch = dora.load_policy(env_id), observation(env_id)
    actions = policy(batch)
    assert isinstance(actions, np.ndarray)
    assert actions.shape == (3, policy.action_size)
    assert np.abs(actions).max() <= 1
    as_tensor = policy(torch.from_numpy(batch))
    assert isinstance(as_tensor, torch.Tensor)
    assert np.array_equal(as_tensor.numpy(), actions)
    assert policy(batch[1].tolist()).shape == (policy.action_size,)
    np.testing.assert_allclose(policy(batch[1].astype(np.float64)), actions[1], atol=1e-5)
    assert np.array_equal(policy(batch), actions), "it is greedy"


@pytest.mark.parametrize("env_id", bundled_ids())
def test_an_action_does_not_depend_on_how_many_are_asked_for_at_once(env_id: str) -> None:
    """To the last digit: of the jug, an episode that succeeded alone failed among fifty others."""
    policy = dora.load_policy(env_id)
    obs = torch.randn(50, policy.observation_size, generator=torch.Generator().manual_seed(0))
    together = policy(obs)
    for size in range(1, 10):
        assert torch.equal(torch.cat([policy(some) for some in obs.split(size)]), together), size


@pytest.mark.filterwarnings("error")
def test_arrays_may_be_views_of_others_and_read_only() -> None:
    env_id = bundled_ids()[0]
    policy, batch = dora.load_policy(env_id), observation(env_id)
    actions = policy(batch)
    batch.flags.writeable = False
    assert np.array_equal(policy(batch), actions)
    np.testing.assert_allclose(policy(batch[::-1]), actions[::-1], atol=1e-5)
    assert np.array_equal(policy(np.asfortranarray(batch)), actions)


def test_the_action_is_that_of_evaluation_clipped() -> None:
    """Of PPO, whose mean action has no bounds."""
    path = RESULTS / "DoraCube-v1" / "ppo-affordance-s10" / "policy.safetensors"
    policy, batch = dora.load_policy(path), 20 * observation("DoraCube-v1", 64)
    bare = policy._networks.greedy(torch.from_numpy(batch)).numpy()
    assert np.abs(bare).max() > 1, "the observations are such that something is clipped"
    assert np.array_equal(policy(batch), bare.clip(-1, 1))


def test_numbers_that_are_not_finite_count_as_zero() -> None:
    policy, batch = dora.load_policy("DoraCube-v1"), observation("DoraCube-v1")
    bad, zero = batch.copy(), batch.copy()
    bad[0, :2], zero[0, :2] = (np.nan, np.inf), 0.0
    assert np.array_equal(policy(bad), policy(zero))


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        (np.zeros(7), "takes (211,)"),
        (np.zeros((2, 3, 211)), "(2, 3, 211)"),
        (torch.zeros(()), "()"),
        ({"state": np.zeros(211)}, "not a dict"),
        ((np.zeros(211), {}), "not a tuple"),
        (["a"], "an array of numbers"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused_with_a_remedy(obs: object, said: str) -> None:
    with pytest.raises(InputError, match=r"policy\.make") as refusal:
        dora.load_policy("DoraCube-v1")(obs)
    assert said in str(refusal.value)


def test_wrong_ids_and_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'DoraCube-v1'"):
        dora.load_policy("DoraCub-v1")
    with pytest.raises(InputError, match="checkpoint"):
        dora.load_policy(tmp_path / "policy.safetensors")


def test_a_run_of_ones_own_is_loaded_by_its_path(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    bundled = bundled_files("DoraCube-v1")[0]
    (tmp_path / "checkpoints" / "best.safetensors").write_bytes(bundled.read_bytes())
    batch = observation("DoraCube-v1")
    for place in (tmp_path, str(tmp_path), bundled):
        mine = dora.load_policy(place)
        assert mine.card is None
        assert np.array_equal(mine(batch), dora.load_policy("dora:DoraCube-v1")(batch))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, None),
        ({"preset": "hard", "config": {"lift": 0.12}}, None),
        ({"guidance": "none"}, "guidance 'affordance', and the environment has 'none'"),
        ({"guidance": "grasps"}, "has 'grasps'"),
        ({"guidance_parts": ["prior"]}, r"has 'affordance \(prior alone\)'"),
        ({"hand_joints": 15}, "control mode"),
        ({"obs_mode": "state_dict"}, "hold no plain state"),
        ({"config": {"residual": {"joint": 0.2}}}, r"config\.residual"),
        ({"config": {"wrist_speed": 0.4}}, r"config\.wrist_speed 1\.0, and the environment has 0\.4"),
        ({"config": {"hand_speed": 0.3}}, r"config\.hand_speed"),
        ({"config": {"optimised": True}}, r"config\.optimised False"),
    ],
)
def test_an_environment_of_another_kind_is_refused(options: dict, said: str | None) -> None:
    policy, env = dora.load_policy("DoraCube-v1"), gym.make("DoraCube-v1", **options)
    if said is None:
        policy.check(env)
        policy(env.reset(seed=0)[0])
    else:
        with pytest.raises(InputError, match=said):
            policy.check(env)
    env.close()


def test_an_environment_in_which_a_correction_is_a_larger_one_is_refused() -> None:
    env = gym.make("DoraHammer-v1", config={"reference": {"held_freedom": 1.0}})
    with pytest.raises(InputError, match=r"config\.reference\.held_freedom 0\.2, and the environment has 1\.0"):
        dora.load_policy("DoraHammer-v1").check(env)
    env.close()


def test_an_environment_of_another_task_is_refused() -> None:
    env = gym.make("DoraJug-v1")
    with pytest.raises(InputError, match="is of DoraCube-v1, not of DoraJug-v1"):
        dora.load_policy("DoraCube-v1").check(env)
    env.close()


def test_the_environment_that_a_policy_makes_fits_it() -> None:
    policy = dora.load_policy("DoraCube-v1")
    env: Any = policy.make(2, sim_backend="physx_cpu_batch")
    policy.check(env)
    obs, _ = env.reset(seed=[3, 4])
    assert policy(obs).shape == (2, 26)
    assert env.unwrapped.config.fewest_lifts == policy.config.task["fewest_lifts"]  # pyright: ignore[reportAttributeAccessIssue]
    env.close()


@pytest.mark.parametrize("env_id", ["DoraCube-v1", pytest.param("DoraHammer-v1", marks=pytest.mark.slow),
                                    pytest.param("DoraJug-v1", marks=pytest.mark.slow),
                                    pytest.param("DoraMicrowave-v1", marks=pytest.mark.slow)])  # fmt: skip
def test_a_policy_succeeds_in_the_environment_of_gym_make(env_id: str) -> None:
    """On starts that no training, evaluation or card uses."""
    policy = dora.load_policy(env_id)
    env: Any = gym.make(env_id, num_envs=STARTS, sim_backend="physx_cpu_batch")
    obs, info = env.reset(seed=[77_000 + k for k in range(STARTS)])
    for _ in range(env.unwrapped.max_steps):  # pyright: ignore[reportAttributeAccessIssue]
        obs, _, _, _, info = env.step(policy(obs))
    assert int(info["success"].sum()) >= FEWEST
    env.close()


# ----------------------------------------------------------------------- cards


@pytest.mark.parametrize("env_id", CARDS)
def test_a_card_agrees_with_the_run_that_it_names(env_id: str) -> None:
    policy, path = bundled_files(env_id)
    card = Card.read(path)
    run = RESULTS / card.run
    result = json.loads((run / "result.json").read_text())
    assert (run / "policy.safetensors").read_bytes() == policy.read_bytes()
    assert card.success_rate == result["success_rate"]
    assert list(card.success_interval) == pytest.approx(result["success_interval"])
    assert card.overlap_p95_mm == result["penetration_p95_mm"]
    assert card.stage_rates == result["stage_rates"]
    assert card.counted_successes + sum(card.failures.values()) == card.episodes == result["eval_episodes"]
    low, high = wilson(card.counted_successes, card.episodes)
    assert low <= card.success_rate <= high
    assert card.commit
    for word in (card.env, card.run, card.date, str(card.seed)):
        assert word in str(card)


def test_another_preset_brings_its_numbers_to_the_environment_of_a_policy() -> None:
    policy = load_policy("DoraJug-v1")
    config = task_config(find_task("DoraJug-v1").CONFIG, "hard", None)
    other = dataclasses.replace(config, pose_filter=0.5)
    for options, wanted in (({}, config), ({"config": {"pose_filter": 0.5}}, other)):
        env: Any = policy.make(1, preset="hard", **options)
        assert env.unwrapped.config == wanted
        env.close()


@pytest.mark.parametrize("env_id", task_ids())
def test_the_bundled_policy_is_the_one_that_training_evaluated_best(env_id: str) -> None:
    """Whatever its success on the starts of the table is."""
    choice = chosen(find_runs(RESULTS), env_id)
    assert choice is not None
    assert is_bundled(choice)


def test_the_best_evaluation_during_training_is_chosen_and_not_the_best_result(tmp_path: Path) -> None:
    """The runs' results are turned round: the choice stays."""
    runs = find_runs(RESULTS)
    choice = chosen(runs, "DoraCube-v1")
    assert choice is not None
    turned = [
        dataclasses.replace(run, result=run.result | {"success_rate": 1 - run.result["success_rate"]}) for run in runs
    ]
    again = chosen(turned, "DoraCube-v1")
    assert again is not None
    assert again.run.folder == choice.run.folder
    best = [
        read_checkpoint(run.folder / "policy.safetensors").progress["best"]
        for run in runs
        if run.folder.parent.name == "DoraCube-v1" and "-affordance-s" in run.folder.name
    ]
    assert choice.checkpoint.progress["best"] == max(best)
    assert choice.among == len(best)


def test_a_run_that_was_only_evaluated_again_comes_last_but_for_one_of_earlier_rules() -> None:
    runs = find_runs(RESULTS)
    choice = chosen(runs, "DoraCube-v1")
    assert choice is not None
    again = dataclasses.replace(choice.run, result=choice.run.result | {"checkpoint": "x"})
    other = chosen([again if run is choice.run else run for run in runs], "DoraCube-v1")
    assert other is not None
    assert other.run.folder != choice.run.folder
    outdated = dataclasses.replace(other.run, outdated=True)
    last = chosen([again, outdated], "DoraCube-v1")
    assert last is not None
    assert last.run is again


@pytest.mark.parametrize(("known", "again", "made"), [(True, False, 0), (True, True, 1), (False, False, 1)])
def test_a_policy_that_is_bundled_already_is_made_anew_only_if_that_is_asked_for(
    known: bool, again: bool, made: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    done: list[str] = []
    monkeypatch.chdir(tmp_path)  # no page to refresh
    monkeypatch.setattr(bundle, "is_bundled", lambda choice: known)
    monkeypatch.setattr(bundle, "count_runs", lambda choice: None)
    monkeypatch.setattr(bundle, "bundle", lambda choice, *_: done.append(choice.run.result["env"]))
    words = ["bundle", str(RESULTS), "--env", "DoraCube-v1", *(["--again"] if again else [])]
    monkeypatch.setattr(sys, "argv", words)
    assert bundle.main() == 0
    assert len(done) == made
    assert ("is bundled already" in capsys.readouterr().out) == (not made)


def test_a_result_of_a_version_without_what_a_card_needs_is_passed_over() -> None:
    runs = [
        dataclasses.replace(run, result={k: v for k, v in run.result.items() if k != "eval_episodes"})
        for run in find_runs(RESULTS)
    ]
    assert chosen(runs, "DoraCube-v1") is None


COLUMNS = EpisodeColumns.of(
    ("stage/reach", "stage/lift", "penetration_mm", "raw_success", "success_at_end", "nonfinite", "unreachable")
)


def episodes(*rows: dict[str, float]) -> Evaluation:
    """An evaluation of such episodes; what is not given is that of a success."""
    usual = {"success": 1.0, "raw_success": 1.0, "whole": 1.0, "length": 100.0, "stage/reach": 1.0, "stage/lift": 1.0}
    table = torch.tensor([[(usual | row).get(name, 0.0) for name in COLUMNS.names] for row in rows])
    return Evaluation(COLUMNS, table)


def test_a_result_that_the_policy_does_not_reach_is_refused() -> None:
    choice = chosen(find_runs(RESULTS), "DoraCube-v1")
    assert choice is not None
    with pytest.raises(InputError, match="dora run --eval-only"):
        check_agrees(episodes(*[{"success": 0.0}] * 50), choice.run)
    check_agrees(episodes(*[{}] * 49, {"success": 0.0}), choice.run)


def test_a_further_run_that_is_no_better_only_changes_how_many_there_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = bundled_files("DoraCube-v1")
    copies = tuple(tmp_path / path.name for path in files)
    for path, copy in zip(files, copies, strict=True):
        copy.write_bytes(path.read_bytes())
    monkeypatch.setattr(bundle, "bundled_files", lambda _: copies)
    choice = chosen(find_runs(RESULTS), "DoraCube-v1")
    assert choice is not None
    more = dataclasses.replace(choice, among=choice.among + 1)
    assert is_bundled(more)
    bundle.count_runs(more)
    assert Card.read(copies[1]) == dataclasses.replace(Card.read(files[1]), chosen_among=more.among)
    whole = copies[1].read_text()
    copies[1].write_text(whole.replace('"success_rate": 0', '"success_rate": 1'))
    assert not is_bundled(more), "a damaged card is made anew"
    copies[1].write_text(whole)
    copies[0].write_bytes(bundled_files("DoraJug-v1")[0].read_bytes())
    assert not is_bundled(more), "another policy is no longer bundled"


def test_a_card_survives_its_file_and_damage_is_refused(tmp_path: Path) -> None:
    choice = chosen(find_runs(RESULTS), "DoraCube-v1")
    assert choice is not None
    card = make_card(choice, episodes({}, {"success": 0.0}), "DoraCube-v1/run", "0123456789ab")
    card.write(tmp_path / "card.json")
    assert Card.read(tmp_path / "card.json") == card
    assert card.failures == {"too much overlap": 1}
    assert card.overlap_limit_mm == pytest.approx(3.0)
    content = json.loads((tmp_path / "card.json").read_text())
    for damaged in (content | {"seed": "one"}, {k: v for k, v in content.items() if k != "seed"}, [content]):
        (tmp_path / "card.json").write_text(json.dumps(damaged))
        with pytest.raises(InputError, match="card"):
            Card.read(tmp_path / "card.json")


@pytest.mark.parametrize(("name", "value"), [("episodes", 0), ("success_rate", 1.5), ("seed", -1)])
def test_a_card_with_figures_that_cannot_be_is_refused(tmp_path: Path, name: str, value: float) -> None:
    card = json.loads(bundled_files("DoraCube-v1")[1].read_text())
    (tmp_path / "card.json").write_text(json.dumps(sealed(card | {name: value})))
    with pytest.raises(InputError, match=f"{name} of the card .* has to be from"):
        Card.read(tmp_path / "card.json")


def test_the_page_has_the_table_of_the_cards() -> None:
    assert cards_table() in (ROOT / PAGE).read_text()
