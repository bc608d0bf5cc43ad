"""Environments whose simulation is not finite: ended, put back, told of, and without any effect on the others."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import dora
from dora.errors import RECORDS, InputError
from dora.integrations.torchrl import BatchEnv
from dora.sim.batch import guard, records
from dora.sim.batch.actions import checked_action
from dora.sim.batch.guard import marked

BAD = 1
"""The environment that becomes bad."""
TASKS = ("PickCube-v1", "TriFingerRotateCubeLevel1-v1", "DoraCube-v1", "DoraJug-v1", "DoraHammer-v1")
NAN3 = np.full(3, np.nan, np.float32)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the records go."""
    monkeypatch.setenv(RECORDS, str(tmp_path / "nonfinite"))
    return tmp_path / "nonfinite"


def make(env_id: str, rows: int = 3, **options: Any) -> Any:
    assert dora
    options = {"sim_backend": "physx_cpu_batch", "render_backend": "none", "obs_mode": "state"} | options
    env = gym.make(env_id, num_envs=rows, **options).unwrapped
    env.reset(seed=0)
    return env


def body_of(env: Any) -> Any:
    return next(b for b in env.scene.sub_scenes[BAD].physx_system.rigid_dynamic_components if not b.kinematic)


def robot_of(env: Any) -> Any:
    """The robot, or the first of two arms."""
    agents = getattr(env.agent, "agents", [env.agent])
    return agents[0].robot._objs[BAD]


def joints(value: float) -> Callable[[Any, str], None]:
    return lambda env, what: getattr(robot_of(env), f"set_{what}")(np.full(robot_of(env).dof, value, np.float32))


def spoil_targets(env: Any) -> None:
    for joint in robot_of(env).active_joints:
        joint.set_drive_target(np.nan)


SPOIL: dict[str, Callable[[Any], None]] = {
    "velocity is NaN": lambda env: body_of(env).set_linear_velocity(NAN3),
    "rotation is infinite": lambda env: body_of(env).set_angular_velocity(np.full(3, np.inf)),
    "place is NaN": lambda env: body_of(env).entity.set_pose(sapien.Pose(NAN3)),
    "too fast": lambda env: body_of(env).set_linear_velocity([5e3, 0, 0]),
    "too far": lambda env: body_of(env).entity.set_pose(sapien.Pose([0, 1e5, 0])),
    "joints are NaN": lambda env: joints(np.nan)(env, "qpos"),
    "joint velocities are NaN": lambda env: joints(np.nan)(env, "qvel"),
    "joint forces are NaN": lambda env: joints(np.nan)(env, "qf"),
    "joint forces are huge": lambda env: joints(3e38)(env, "qf"),
    "targets are NaN": spoil_targets,
    "base is NaN": lambda env: robot_of(env).set_root_pose(sapien.Pose(NAN3)),
}


def zero(env: Any) -> torch.Tensor:
    return torch.zeros(env.num_envs, *env.single_action_space.shape)


def all_finite(value: Any) -> bool:
    if isinstance(value, dict):
        return all(all_finite(part) for part in value.values())
    return not torch.is_tensor(value) or not value.is_floating_point() or bool(value.isfinite().all())


def spoil(env: Any, kind: str) -> Any:
    """A step with the damage; all numbers are finite and only one row is bad."""
    SPOIL[kind](env)
    env.scene.px.invalidate()
    observation, reward, terminated, _, info = step = env.step(zero(env))
    assert all_finite({"o": observation, "r": reward, "info": info}), kind
    assert info["nonfinite"].tolist() == [row == BAD for row in range(env.num_envs)], kind
    assert (bool(terminated[BAD]), float(reward[BAD]), bool(info["success"][BAD])) == (True, 0.0, False), kind
    return step


@pytest.mark.parametrize("env_id", [*TASKS, pytest.param("DoraMicrowave-v1", marks=pytest.mark.slow)])
def test_a_bad_row_ends_and_its_reset_is_healthy(env_id: str):
    env = make(env_id)
    for _ in range(3):
        _, _, terminated, _, info = env.step(zero(env))
        assert not info["nonfinite"].any()
        assert not terminated.any()
    for kind in SPOIL:
        spoil(env, kind)
        if env_id != "TriFingerRotateCubeLevel1-v1":  # ManiSkill cannot reset a part of its rows
            env.reset(options={"env_idx": torch.tensor([BAD])})
        for _ in range(3):
            observation, reward, terminated, _, info = env.step(zero(env))
            assert not info["nonfinite"].any(), kind
            assert all_finite({"o": observation, "r": reward, "info": info}), kind
    env.close()


def test_a_bad_row_that_is_not_reset_goes_on_healthy():
    env = make("PickCube-v1")
    for _ in range(3):
        env.step(zero(env))
    for kind in SPOIL:
        spoil(env, kind)
        for _ in range(2):
            observation, _, terminated, _, info = env.step(zero(env))
            assert not info["nonfinite"].any(), kind
            assert not terminated.any(), kind
            assert observation.isfinite().all(), kind
    env.close()


@pytest.mark.parametrize(
    "env_id", ["PickCube-v1", "DoraCube-v1", pytest.param("DoraHammer-v1", marks=pytest.mark.slow)]
)
def test_the_other_rows_are_bit_identical(env_id: str):
    """Two equal batches, in one of which a row is spoilt again and again; contacts included."""
    results = []
    for spoilt in (False, True):
        env, found = make(env_id, rows=4), []
        generator = np.random.default_rng(0)
        kinds = iter(SPOIL)
        for step in range(60):
            if spoilt and step % 5 == 4 and (kind := next(kinds, None)):
                SPOIL[kind](env)
                env.scene.px.invalidate()
            action = torch.tensor(generator.uniform(-1, 1, zero(env).shape), dtype=torch.float32)
            observation, reward, _, _, info = env.step(action)
            found.append(torch.cat([observation, reward[:, None], info["success"][:, None]], 1))
        results.append(torch.stack(found))
        env.close()
    others = [row for row in range(4) if row != BAD]
    assert torch.equal(results[0][:, others], results[1][:, others])
    assert results[1].isfinite().all()


def test_a_reset_of_other_rows_returns_finite_numbers():
    env = make("DoraCube-v1")
    env.step(zero(env))
    SPOIL["place is NaN"](env)
    env.scene.px.invalidate()
    observation, _ = env.reset(options={"env_idx": torch.tensor([0])})
    assert observation.isfinite().all()
    assert env.step(zero(env))[4]["nonfinite"].tolist() == [False, True, False]
    assert not env.step(zero(env))[4]["nonfinite"].any()
    SPOIL["place is NaN"](env)
    env.scene.px.invalidate()
    env.reset(options={"env_idx": torch.tensor([BAD])})
    assert not env.step(zero(env))[4]["nonfinite"].any()  # another episode
    env.close()


def test_the_contacts_of_a_bad_row_do_not_count():
    env = make("DoraCube-v1")
    for _ in range(20):
        env.step(zero(env))
    assert env.memory.objects["cube"].supported[BAD] == 1
    joints(np.nan)(env, "qf")
    info = env.step(zero(env))[4]
    assert info["nonfinite"][BAD]
    assert info["penetration_mm"][BAD] == 0
    assert env.memory.objects["cube"].supported.tolist() == [1, 0, 1]
    env.close()


def test_forces_that_are_sound_stay_when_a_row_is_put_back():
    """The nail's resistance: without it the next blow would drive it further."""
    env = make("DoraHammer-v1")
    nail = env.task.nail
    env.step(zero(env))
    for force in (np.nan, 3e38):
        joints(force)(env, "qf")
        assert env.step(zero(env))[4]["nonfinite"][BAD]
        assert nail._bodies[BAD].qf.tolist() == [-nail.settings.resistance]
        assert not robot_of(env).qf.any()
    env.close()


def test_last_states_are_written_to_few_files(folder: Path, monkeypatch: pytest.MonkeyPatch):
    said: list[str] = []
    monkeypatch.setattr(records.logger, "warning", said.append)
    env = make("PickCube-v1")
    for _ in range(guard.HISTORY + 3):
        env.step(zero(env) + 0.25)
    for _ in range(records.MOST + 3):
        spoil(env, "velocity is NaN")
    files = sorted(folder.iterdir())
    assert len(files) == records.MOST
    said = [line for line in said if "episode ended" in line]  # not of a driver that is missing
    assert len(said) == 1
    assert str(files[0]) in said[0]
    assert "environment 1" in said[0]
    with np.load(files[0]) as record:
        k, entities = guard.HISTORY + 1, len(record["entities"])
        assert record["environment"] == BAD
        assert record["poses"].shape == (k, entities, 7)
        assert "scene-1_cube" in record["entities"]
        assert np.isfinite(record["states"][:-2]).all()
        assert not np.isfinite(record["states"][-1]).all()
        assert record["actions"].shape == (k - 1, 8)
        assert (record["actions"][:-1] == 0.25).all()
    others = [folder / f"expert-{number:02d}.npz" for number in range(20)]
    for path in others:
        path.write_bytes(b"of the user")
    for number in range(2 * records.MOST_IN_FOLDER):
        monkeypatch.setattr(records, "_numbers", iter([1000 + number]))
        records.StateRecorder().write(records.Record(0, [b""], [b""], [], []))
    assert all(path.exists() for path in others)
    assert len(list(folder.iterdir())) == records.MOST_IN_FOLDER + len(others)
    env.close()


@pytest.mark.parametrize(
    "form",
    [
        lambda action: action.bfloat16(),
        lambda action: action.numpy().astype(">f8"),
        lambda action: action.tolist(),
        lambda action: {"control_mode": "pd_joint_delta_pos", "action": action},
    ],
)
def test_actions_of_any_form_are_in_the_record(form: Callable[[torch.Tensor], Any], folder: Path):
    env = make("PickCube-v1", control_mode="pd_joint_delta_pos")
    env.step(form(zero(env) + 0.25))
    with pytest.raises(InputError):
        env.step(form(zero(env) + np.nan))
    SPOIL["velocity is NaN"](env)
    env.scene.px.invalidate()
    assert env.step(form(zero(env) + 0.5))[4]["nonfinite"].tolist() == [False, True, False]
    assert not env.step(form(zero(env)))[4]["nonfinite"].any()
    (file,) = folder.iterdir()
    with np.load(file) as record:
        assert record["actions"].tolist() == [[0.25] * 8]
    env.close()


def test_an_environment_is_put_back_whatever_happens_to_its_record(monkeypatch: pytest.MonkeyPatch):
    env = make("PickCube-v1")
    env.step(zero(env))

    def fail(self: Any) -> Any:
        raise TypeError("no record")

    monkeypatch.setattr(records.Record, "arrays", fail)
    spoil(env, "place is NaN")
    assert not env.step(zero(env))[4]["nonfinite"].any()
    monkeypatch.setattr(env.scene.px.guard.recorder, "write", fail)
    SPOIL["place is NaN"](env)
    env.scene.px.invalidate()
    with pytest.raises(TypeError, match=r"no record|argument"):
        env.step(zero(env))
    assert env.get_state().isfinite().all()
    env.close()


def test_a_record_that_cannot_be_written_is_told_and_no_more(folder: Path, monkeypatch: pytest.MonkeyPatch):
    said: list[str] = []
    monkeypatch.setattr(records.logger, "warning", said.append)
    folder.write_text("no folder")
    records.StateRecorder().write(records.Record(0, [b""], [b""], [], []))
    assert "could not be written" in said[0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("env_id", ["PickCube-v1", "DoraCube-v1"])
def test_an_action_that_is_not_finite_is_refused_with_its_row(env_id: str, value: float):
    env = make(env_id)
    action = zero(env)
    action[2, 1] = value
    before = env.get_state()
    with pytest.raises(InputError, match="action of environment 2 contains NaN or infinity") as error:
        env.step(action)
    assert "\n" not in str(error.value)
    assert torch.equal(env.get_state(), before)
    action[:] = value
    with pytest.raises(InputError, match="of environments 0, 1, 2 "):
        env.step(action.numpy())
    assert not env.step(zero(env))[4]["nonfinite"].any()
    env.close()


def test_a_finite_action_is_never_blamed():
    """Whatever its size and type; and a state that makes NaN of it is to blame, not the action."""
    env = make("DoraCube-v1")
    space = env.single_action_space
    for value in (1e30, -1e300, 1e-310, 1e-45):
        for action in (np.full(zero(env).shape, value), torch.full(zero(env).shape, value, dtype=torch.float64)):
            checked = checked_action(action, space, env.num_envs, env.device)
            assert checked is not None
            assert checked.dtype == torch.float32
            assert torch.equal(checked, torch.tensor(value, dtype=torch.float64).clamp(-1, 1).float().expand(3, 26))
            observation, reward, _, _, info = env.step(action)
            assert observation.isfinite().all()
            assert reward.isfinite().all()
            assert not info["nonfinite"].any()
    env.guide.residual.buffers.residual[BAD] = torch.nan
    assert env.step(zero(env))[4]["nonfinite"].tolist() == [False, True, False]
    env.close()


def test_rows_are_marked_by_what_they_return():
    nothing = torch.zeros(3, dtype=torch.bool)
    observation, reward = torch.arange(6.0).reshape(3, 2), torch.ones(3)
    info = {"success": ~nothing, "fail": nothing, "depth": torch.tensor([1.0, torch.inf, torch.nan])}
    step = (observation, reward, nothing, nothing, info)
    assert marked(step, nothing)[0][0] is observation
    assert not info["nonfinite"].any()
    assert torch.equal(info["depth"][:1], torch.ones(1))
    assert info["depth"][1] == torch.inf
    observation[1, 0], reward[2] = torch.inf, torch.nan
    (o, r, terminated, _, i), rows = marked(step, nothing)
    assert rows.tolist() == terminated.tolist() == i["fail"].tolist() == [False, True, True]
    assert (i["success"].tolist(), i["depth"].tolist()) == ([True, False, False], [1.0, 0.0, 0.0])
    assert (o.tolist(), r.tolist()) == ([[0, 1], [0, 3], [4, 5]], [1, 0, 0])


def maniskill(env: Any) -> Any:
    return ManiSkillVectorEnv(env, auto_reset=False, ignore_terminations=True)


def sb3(env: Any) -> Any:
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    from dora.integrations.sb3 import BatchVecEnv

    return BatchVecEnv(env, ignore_terminations=True)


def torchrl(env: Any) -> Any:
    return BatchEnv(env, ignore_terminations=True)


@pytest.mark.parametrize("wrap", [maniskill, sb3, torchrl], ids=lambda wrap: wrap.__name__)
def test_a_bad_row_ends_where_terminations_are_ignored(wrap: Callable[[Any], Any]):
    env = gym.make("DoraCube-v1", num_envs=3, obs_mode="state", sim_backend="physx_cpu_batch")
    wrapped = wrap(env)
    begun = wrapped.reset()
    base: Any = env.unwrapped
    SPOIL["velocity is NaN"](base)
    base.scene.px.invalidate()
    action = np.zeros((3, *base.single_action_space.shape), np.float32)
    if wrap is torchrl:
        done = wrapped.step(begun.set("action", torch.from_numpy(action)))["next", "done"].flatten()
    elif wrap is sb3:
        done = torch.from_numpy(wrapped.step(action)[2])
    else:
        _, _, terminated, truncated, _ = wrapped.step(action)
        done = terminated | truncated
    assert done.tolist() == [row == BAD for row in range(3)]
    env.close()
