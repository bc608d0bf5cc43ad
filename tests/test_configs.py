"""Numbers of tasks as configuration: overridden by name, checked, shown, and in force."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils.structs.types import SimConfig

import dora
from dora.agents.runs.recommended import recommended
from dora.configs import built, overridden, plain
from dora.errors import InputError
from dora.tasks import find_task, make_task, options_under_preset, task_ids
from dora.tasks.cube import CubeConfig
from dora.tasks.env.description import config_rows
from dora.tasks.env.options import task_config
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.jug import JugConfig
from dora.tasks.mdp.randomisation import PRESETS
from dora.tools import describe

assert dora


@dataclass(frozen=True)
class Inner:
    """A nested configuration."""

    weight: float = 1.0


@dataclass(frozen=True)
class Outer:
    """A configuration of all types of fields."""

    length: float = 0.1
    count: int = 2
    name: str = "a"
    both: tuple[float, float] = (0.0, 1.0)
    limit: float | None = None
    inner: Inner = field(default_factory=Inner)


def test_a_field_that_is_missing_is_named():
    @dataclass
    class Needy:
        length: float

    with pytest.raises(InputError, match=r'^the file: missing value for field "length"\.$'):
        built(Needy, {}, "the file")


def test_fields_are_overridden_by_name_and_the_others_stay():
    changed = overridden(Outer(), {"length": 2, "inner": {"weight": 3}, "both": [1, 2], "limit": 0.5}, "config")
    assert changed == Outer(length=2.0, both=(1.0, 2.0), limit=0.5, inner=Inner(3.0))
    assert isinstance(changed.length, float)
    assert overridden(Outer(), Outer(count=5), "config") == Outer(count=5)


@pytest.mark.parametrize("env_id", task_ids())
def test_every_number_of_a_task_says_what_it_means(env_id: str):
    rows = config_rows(SimpleNamespace(config=task_config(find_task(env_id).CONFIG, "standard", None)))
    assert [name for name, _, meaning in rows if not meaning] == []
    meanings = {name: meaning for name, _, meaning in rows}
    assert meanings["weights.penetration"].startswith("Overlap beyond what is free")
    assert meanings["control_frequency"] == "Control steps per second [Hz]."


def test_numbers_are_shown_as_an_override_takes_them():
    """Switches, too: every value of the table, given back as an option, is the number in force."""
    config = replace(task_config(CubeConfig, "standard", None), optimised=True)
    shown = {name: value for name, value, _ in config_rows(SimpleNamespace(config=config))[1:]}
    assert shown["optimised"] == "True"
    assert shown["centre"] == "0.55, 0"
    again = overridden(config, {"optimised": shown["optimised"] == "True"}, "config")
    assert again == config


@pytest.mark.parametrize("env_id", task_ids())
@pytest.mark.parametrize("earlier", PRESETS)
@pytest.mark.parametrize("preset", PRESETS)
def test_stored_numbers_under_another_preset_are_those_of_that_preset(env_id: str, earlier: str, preset: str):
    cls = find_task(env_id).CONFIG
    stored = {"preset": earlier, "config": plain(task_config(cls, earlier, None))}
    wanted = {"preset": preset, "config": plain(task_config(cls, preset, None))}
    assert options_under_preset(env_id, stored, preset) == wanted
    assert options_under_preset(env_id, {"guidance": "none"}, preset) == {"guidance": "none", "preset": preset}


def test_a_whole_configuration_can_be_put_under_another_preset():
    options = options_under_preset("DoraJug-v1", {"config": task_config(JugConfig, "standard", None)}, "hard")
    assert options == {"preset": "hard", "config": plain(task_config(JugConfig, "hard", None))}


def test_a_number_that_was_chosen_stays_under_another_preset():
    own = {"pose_filter": 0.4, "lift": 0.12}
    options = options_under_preset("DoraJug-v1", {"preset": "hard", "config": own}, "standard")
    assert options["config"] == own


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lenght": 1.0}, "config has no field 'lenght': did you mean 'length'?"),
        ({"qqq": 1.0}, "choose one of length, count"),
        ({"inner": {"wait": 1.0}}, "config.inner has no field 'wait'"),
        ({"length": "far"}, "length must be float, not 'far'"),
        ({"count": 1.5}, "count must be int, not 1.5"),
        ({"count": True}, "count"),
        ({"both": [1.0]}, "both must be 2 values (float, float), not (1.0,)"),
        ({"both": "ab"}, "config.both must be a list, not 'ab'"),
        ({"inner": 3}, "inner"),
        ([("length", 1.0)], "mapping"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_sentence(changes: object, words: str):
    with pytest.raises(InputError) as error:
        overridden(Outer(), changes, "config")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lift": -1.0}, "config.lift is -1.0; it cannot be negative"),
        ({"lift": float("nan")}, "config.lift is nan; it has to be a finite number"),
        ({"centre": (0.5, float("inf"))}, "config.centre is inf"),
        ({"weights": {"lift": float("nan")}}, "config.weights.lift is nan"),
        ({"residual": {"joint": -0.1}}, "config.residual.joint is -0.1"),
        ({"randomisation": {"push": -1.0}}, "config.randomisation.push is -1.0"),
        ({"randomisation": {"mass": 1.0}}, "config.randomisation.mass is 1.0; it is a share"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(changes: dict, words: str):
    with pytest.raises(InputError) as error:
        task_config(CubeConfig, "standard", changes)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("agent", "name", "value"),
    [
        ("ppo", "gamma", 2.0), ("sac", "gamma", float("nan")), ("ppo", "minibatch", 0), ("sac", "n_step", 0),
        ("sac", "polyak", -0.1), ("ppo", "learning_rate", 0.0), ("ppo", "noise_correlation", 1.0),
        ("sac", "hidden", (256, 0)), ("sac", "hidden", (4096, 4096)), ("ppo", "hidden", (4096, 4096, 4096)),
        ("mappo", "hidden", (4096,) * 16), ("happo", "hidden", (2048,) * 9),
        ("ppo", "target_kl", float("inf")), ("ppo", "clip", 1.0), ("happo", "clip", 1.0),
    ],
)  # fmt: skip
def test_settings_of_a_learner_that_make_no_sense_are_refused(agent: str, name: str, value: object):
    with pytest.raises(InputError, match=name.replace("_", ".")):
        recommended("DoraCube-v1", agent, learner={name: value})


@pytest.mark.parametrize(("agent", "hidden"), [("sac", (2048, 2048)), ("ppo", (4096, 4096)), ("happo", (512,) * 16)])
def test_networks_whose_checkpoints_can_be_read_are_not_refused(agent: str, hidden: tuple[int, ...]):
    assert recommended("DoraCube-v1", agent, learner={"hidden": hidden}).learner.hidden == hidden


def test_plain_data_make_the_same_configuration_again():
    for config in (Outer(), CubeConfig(), HammerConfig()):
        assert built(type(config), plain(config)) == config
        assert overridden(type(config)(), plain(config), "config") == config
    with pytest.raises(InputError, match="settings"):
        built(Outer, plain(Outer()) | {"count": "two"})


@pytest.mark.parametrize("env_id", task_ids())
def test_the_preset_is_the_randomisation_that_can_be_overridden(env_id: str):
    cls = find_task(env_id).CONFIG
    for name, randomisation in cls.PRESETS.items():
        assert task_config(cls, name, None).randomisation == randomisation
        shared = plain(PRESETS[name])
        assert {key: plain(randomisation)[key] for key in shared} == shared
    changed = task_config(cls, "hard", {"randomisation": {"push": 0.5}}).randomisation
    assert (changed.push, changed.delay) == (0.5, PRESETS["hard"].delay)
    assert changed == replace(cls.PRESETS["hard"], push=0.5)


def test_a_preset_brings_other_numbers_of_a_task_too():
    shares = {preset: task_config(JugConfig, preset, None).pose_filter for preset in JugConfig.PRESETS}
    assert shares == {"none": 1.0, "standard": 1.0, "hard": 0.15}
    assert task_config(JugConfig, "hard", {"pose_filter": 0.3}).pose_filter == 0.3
    task = make_task("DoraJug-v1", 2, preset="hard")
    assert task.config.pose_filter == 0.15
    task.close()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"control_frequency": 0}, "is 0 and has to be from 1 to 10000"),
        ({"pose_filter": 0.0}, "config.pose_filter is 0.0 and has to be from 0.01 to 1"),
        ({"arm_effort": 1.5}, "config.arm_effort is 1.5 and has to be from 0.01 to 1"),
        ({"physics_frequency": 110}, "multiple of config.control_frequency, 20 Hz"),
        ({"lift": None}, "lift must be float"),
        ({"definition": 0}, "config.definition is 0 and has to be from 1"),
        ({"definition": 99}, "config.definition is 99 and has to be from 1"),
    ],
)
def test_numbers_that_cannot_be_built_are_refused(changes: dict, words: str):
    with pytest.raises(InputError, match=words):
        gym.make("DoraCube-v1", config=changes)


def test_thresholds_weights_and_rates_are_in_force():
    numbers = {"lift": 0.02, "control_frequency": 10, "weights": {"lift": 6.0}, "residual": {"position": 0.0}}
    task = make_task("DoraCube-v1", 2, preset="none", config=numbers)
    usual = make_task("DoraCube-v1", 2, preset="none")
    for env in (task, usual):
        env.reset(seed=0)
    assert (task.control_freq, usual.control_freq) == (10, 20)
    s = task.snapshot
    shares = [float(env.terms.terms["lift"].weight) for env in (task, usual)]
    assert shares == [6.0, 3.0]
    push = torch.ones(2, task.action_size)
    start = s.hand.wrist_p.clone()
    for _ in range(3):
        task.step(push * torch.tensor([1.0] * 3 + [0.0] * (task.action_size - 3)))
    beside = make_task("DoraCube-v1", 2, preset="none", config=numbers)
    beside.reset(seed=0)
    for _ in range(3):
        beside.step(0 * push)
    # residuals of no size move nothing
    torch.testing.assert_close(task.snapshot.hand.wrist_p, beside.snapshot.hand.wrist_p, atol=1e-6, rtol=0)
    assert (task.snapshot.hand.wrist_p - start).norm(dim=-1).min() > 0.01
    for env in (task, usual, beside):
        env.close()


@pytest.mark.parametrize(
    "rates",
    [
        {"sim_freq": 120, "control_freq": 60, "scene_config": {"bounce_threshold": 1.0}},
        {"sim_freq": np.int64(120), "control_freq": np.int32(60)},
        SimConfig(sim_freq=120, control_freq=60),
    ],
)
def test_the_rates_of_a_sim_config_are_those_of_the_task(rates: Any):
    """Holds, noise and the nail count in control and physics steps of this length."""
    task = make_task("DoraCube-v1", 1, guidance="none", sim_config=rates)
    assert (task.config.physics_frequency, task.config.control_frequency) == (task.sim_freq, task.control_freq)
    assert task.control_freq == 60
    task.close()
    with pytest.raises(InputError, match="multiple of"):
        make_task("DoraCube-v1", 1, guidance="none", sim_config={"sim_freq": 110, "control_freq": 60})


def test_printing_an_environment_shows_the_tables_in_force(capsys: pytest.CaptureFixture[str]):
    assert describe.main(["DoraJug-v1", "--preset", "hard", "--task.lift", "0.12", "--task.weights.lift", "2.5"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for words in ("lift task 2.5 rise", "reach 0.05 never", "weights.lift 2.5", "lift 0.12", "randomisation.push 0.05"):
        assert words in shown, words
    task = make_task("DoraJug-v1", 1, guidance="none")
    text = str(task)
    assert "guided" not in text
    assert "hand_q" in text
    assert text in str(gym.Wrapper(task))
    task.close()


@pytest.mark.parametrize(("words", "message"), [([], "Say which task"), (["DoraJog-v1"], "did you mean 'DoraJug-v1'")])
def test_describing_nothing_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]):
    assert describe.main(words) == 2
    assert message in capsys.readouterr().err
