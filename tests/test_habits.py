"""What users of ManiSkill are used to writing works with our tasks and with its own on `physx_cpu_batch`."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.utils import common
from mani_skill.utils.wrappers.cached_reset import CachedResetWrapper
from mani_skill.utils.wrappers.record import RecordEpisode

import dora.sim
from dora.errors import InputError
from dora.sim.batch.resets import START

COUNT = 4
OURS, STOCK = "DoraCube-v1", "PickCube-v1"
TARGETS = "pd_joint_target_delta_pos"
"""A control mode of ManiSkill whose targets are relative to the last ones."""


def make(env_id: str, num_envs: int = COUNT, **options: Any) -> Any:
    settings: Any = {"sim_backend": dora.sim.BACKEND, "render_backend": "none", "obs_mode": "state", **options}
    if env_id == OURS:
        settings = {"config": {"randomisation": {"size": 0.0}}, "preset": "hard"} | settings
    return gym.make(env_id, num_envs=num_envs, **settings)


def options_of(env_id: str) -> dict[str, Any]:
    """How the environments of the fixtures are made."""
    return {} if env_id == OURS else {"control_mode": TARGETS}


@pytest.fixture(scope="module", params=[OURS, STOCK])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    env: Any = make(request.param, **options_of(request.param))
    yield env
    env.close()


@pytest.fixture(scope="module")
def other(env: Any) -> Iterator[Any]:
    """Another environment of the same task."""
    env_id = base(env).spec.id
    other = make(env_id, **options_of(env_id))
    yield other
    other.close()


def base(env: Any) -> Any:
    return env.unwrapped


def moved(env: Any, seed: int, steps: int = 5) -> Any:
    """The environment after some random actions; its observation."""
    env.reset(seed=seed)
    generator, obs = np.random.default_rng(seed), None
    for _ in range(steps):
        obs = env.step(0.5 * generator.uniform(-1, 1, env.action_space.shape or ()))[0]
    return obs


def flat(state: Any) -> list[tuple[str, torch.Tensor]]:
    """Leaves of a state with their names."""
    if isinstance(state, dict):
        return [(f"{name}/{path}", leaf) for name, part in state.items() for path, leaf in flat(part)]
    return [("", state)]


def lists(state: Any) -> Any:
    return {name: lists(part) for name, part in state.items()} if isinstance(state, dict) else state.tolist()


def assert_alike(one: Any, two: Any, rows: Any = slice(None), others: Any = slice(None), atol: float = 0.0) -> None:
    for (path, first), (_, second) in zip(flat(one), flat(two), strict=True):
        torch.testing.assert_close(first[rows], second[others], rtol=0, atol=atol, msg=path)


# ---- states and seeds ----------------------------------------------------------------------------


@pytest.mark.parametrize("form", [common.to_numpy, lists])
def test_states_of_any_form_are_set(env: Any, other: Any, form: Any):
    moved(env, 0)
    state = base(env).get_state_dict()
    moved(other, 1)
    base(other).set_state_dict(form(state))
    now = base(other).get_state_dict()
    keep = [kind for kind in state if base(env).spec.id == OURS or kind != "controller"]
    assert_alike({k: now[k] for k in keep}, {k: state[k] for k in keep}, atol=1e-5)


@pytest.mark.parametrize("form", [np.asarray])
def test_flat_states_restore_all_that_they_hold(env: Any, other: Any, form: Any):
    moved(env, 0)
    state = base(env).get_state()
    moved(other, 1)
    before = base(other).get_state()
    base(other).set_state(form(state[[2, 0]]), env_idx=[1, 3])
    after = base(other).get_state()
    width = state.shape[1] if base(env).spec.id == OURS else state.shape[1] - 9  # stock keeps its controllers' targets
    torch.testing.assert_close(after[[1, 3], :width], state[[2, 0], :width], rtol=0, atol=1e-5)
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    base(other).set_state(form(state[0]))  # one row for all
    torch.testing.assert_close(base(other).get_state()[:, :width], state[[0] * COUNT, :width], rtol=0, atol=1e-5)


@pytest.mark.parametrize("rows", [[3, 1], np.array([3, 1])])
def test_rows_of_a_state_go_where_they_are_sent(env: Any, other: Any, rows: Any):
    """In any order, although ManiSkill writes rows in ascending order."""
    moved(env, 0)
    state = base(env).get_state_dict()
    moved(other, 1)
    part = {k: {n: v[[0, 2]] for n, v in state[k].items()} for k in ("actors", "articulations")}
    base(other).set_state_dict(part, env_idx=rows)
    now = base(other).get_state_dict()
    assert_alike({k: now[k] for k in part}, part, rows=[3, 1], atol=1e-5)


def test_wrong_states_are_refused_in_one_sentence(env: Any):
    state = base(env).get_state_dict()
    name = next(iter(state["actors"]))
    cases: list[tuple[Any, Any, str]] = [
        (state | {"actors": {name: np.zeros((COUNT, 12))}}, None, "shape"),
        (state | {"actors": {name: np.zeros((3, 13))}}, None, "shape"),
        (state | {"actors": {name: "there"}}, None, "must be numbers"),
        ([1, 2], None, "dictionary"),
        (state, [0, 9], "the environments are 0 to 3"),
    ]
    for wrong, rows, words in cases:
        with pytest.raises(InputError, match=words) as error:
            base(env).set_state_dict(wrong, env_idx=rows)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="the state has shape"):
        base(env).set_state(np.zeros((COUNT, 7)))


@pytest.mark.parametrize(
    "seeds",
    [
        np.array([5, 6, 7, 8], np.uint32),
        [np.int64(5), 6, 7, torch.tensor(8)],
    ],
)
def test_seeds_of_any_form_give_the_same_start(env: Any, seeds: Any):
    assert torch.equal(env.reset(seed=[5, 6, 7, 8])[0], env.reset(seed=seeds)[0])


def test_one_seed_of_numpy_is_that_seed(env: Any):
    seed = np.random.SeedSequence(1).generate_state(1)[0]
    wanted = env.reset(seed=int(seed))[0]
    for form in (seed, torch.tensor(int(seed))):
        assert torch.equal(env.reset(seed=form)[0], wanted)


# ---- partial resets ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rows",
    [
        [3, 1],
        np.array([1, 3]),
        torch.tensor([False, True, False, True]),
    ],
)
def test_a_partial_reset_names_environments_in_any_form(env: Any, rows: Any):
    before = moved(env, 2)
    state = base(env).get_state_dict()
    obs, _ = env.reset(options={"env_idx": rows})
    assert torch.equal(obs[[0, 2]], before[[0, 2]])
    assert (base(env).elapsed_steps == torch.tensor([5, 0, 5, 0])).all()
    assert_alike(base(env).get_state_dict(), state, rows=[0, 2], others=[0, 2])


@pytest.mark.parametrize("rows", [[], np.zeros(COUNT, bool)])
def test_a_reset_of_no_environment_changes_nothing(env: Any, rows: Any):
    before = moved(env, 2)
    state = base(env).get_state()
    obs, info = env.reset(options={"env_idx": rows})
    assert torch.equal(obs, before)
    assert torch.equal(base(env).get_state(), state)
    assert not info["reconfigure"]
    base(env).set_state(state[:0], env_idx=rows)
    assert torch.equal(base(env).get_state(), state)


def test_the_options_of_the_caller_stay_as_they_are(env: Any):
    options = {"env_idx": [1]}
    env.reset(options=options)
    assert options == {"env_idx": [1]}


# ---- episodes that begin in states ---------------------------------------------------------------


def test_all_begin_in_given_states_with_their_controllers(env: Any, other: Any):
    obs = moved(env, 3)
    state = base(env).get_state_dict()
    moved(other, 4)
    found, _ = other.reset(options={START: {"env_states": common.to_numpy(state)}})
    torch.testing.assert_close(found, obs, rtol=0, atol=2e-3)
    assert_alike(base(other).get_state_dict()["controller"], state["controller"])
    ours = [kind for kind in state if kind not in ("actors", "articulations", "controller")]
    now = base(other).get_state_dict()
    assert_alike({k: now[k] for k in ours}, {k: state[k] for k in ours})
    assert base(env).spec.id == STOCK or len(ours) >= 4


def test_one_environment_on_maniskills_own_back_end_begins_in_a_state_too():
    """Where nothing of ManiSkill's reset is wrapped; with its controllers, from arrays without the first axis."""
    one, two = (make(OURS, 1, sim_backend="physx_cpu") for _ in range(2))
    obs = moved(one, 3)
    state = base(one).get_state_dict()
    moved(two, 4)
    found, _ = two.reset(options={"env_idx": np.array([0]), START: {"env_states": _rows(common.to_numpy(state), 0)}})
    torch.testing.assert_close(found, obs, rtol=0, atol=2e-3)
    assert_alike(base(two).get_state_dict()["controller"], state["controller"])
    two.step(np.zeros(two.action_space.shape or ()).tolist())
    for env in (one, two):
        env.close()


def test_a_state_that_is_set_after_a_reset_waits_for_no_reset():
    """Only within a reset does ManiSkill reset controllers after it has restored a state."""
    env = make(OURS, 1)
    moved(env, 3)
    assert not base(env).resetting
    with pytest.raises(InputError):
        env.reset(seed="no number")
    assert not base(env).resetting
    env.close()


@pytest.mark.parametrize(("rows", "cached"), [([3, 1], True), (np.array([False, True, False, True]), False)])
def test_some_begin_in_given_states_and_the_others_go_on_bit_for_bit(env: Any, other: Any, rows: Any, cached: bool):
    obs = moved(env, 3)
    state = base(env).get_state_dict()
    before = moved(other, 4)
    steps = 0.5 * np.random.default_rng(0).uniform(-1, 1, (4, *(other.action_space.shape or ())))
    rest = [other.step(a)[0][[0, 2]] for a in steps]
    assert torch.equal(moved(other, 4), before)
    source = [2, 0] if isinstance(rows, list) else [0, 2]
    place = [3, 1] if isinstance(rows, list) else [1, 3]
    given = {"env_states": _rows(state, source)} | ({"obs": obs[source]} if cached else {})
    kept = base(other)._last_obs
    copy = kept.clone()
    found, _ = other.reset(options={"env_idx": rows, START: given})
    assert torch.equal(kept, copy), "the observation returned before has changed"
    torch.testing.assert_close(found[place], obs[source], rtol=0, atol=0 if cached else 2e-3)
    assert torch.equal(found[[0, 2]], before[[0, 2]])
    now = base(other).get_state_dict()
    assert_alike(now["controller"], state["controller"], rows=place, others=source)
    for a, wanted in zip(steps, rest, strict=True):
        assert torch.equal(other.step(a)[0][[0, 2]], wanted)


def _rows(state: Any, rows: Any) -> Any:
    return {n: _rows(p, rows) for n, p in state.items()} if isinstance(state, dict) else state[rows]


@pytest.mark.slow
def test_states_with_objects_of_other_sizes_leave_the_random_numbers_of_the_others():
    one, two, three = (gym.make("DoraJug-v1", num_envs=3, preset="standard").unwrapped for _ in range(3))
    one.reset(seed=0)
    two.reset(seed=1)
    three.reset(seed=1)
    state: Any = base(one).get_state_dict()
    two.reset(options={"env_idx": [1], START: {"env_states": _rows(state, [2])}})
    three.reset(options={"env_idx": [1]})
    assert torch.equal(base(two).scale, torch.stack([base(three).scale[0], base(one).scale[2], base(three).scale[2]]))
    assert_alike(base(two).get_state_dict()["controller"], state["controller"], rows=[1], others=[2])
    for env in (two, three):
        env.reset(options={"env_idx": [0]})
    torch.testing.assert_close(base(two).snapshot.object.p[0], base(three).snapshot.object.p[0], rtol=0, atol=1e-6)
    for env in (one, two, three):
        env.close()


def test_states_with_objects_of_other_sizes_leave_the_others_as_if_their_own_state_were_set():
    """At the sizes of the preset: PhysX forgets contacts, here of fingers with each other and the cube, and no more."""
    env = make(OURS, 3, preset="standard", config=None)
    moved(env, 1, 12)
    state = _rows(base(env).get_state_dict(), [0, 2])
    steps = 0.5 * np.random.default_rng(9).uniform(-1, 1, (3, *(env.action_space.shape or ())))
    found = []
    for way in ("nothing", "own state", "other sizes"):
        seen, before, sizes = [moved(env, 2, 12)], base(env).get_state(), base(env).scale
        if way == "own state":
            base(env).set_state_dict(base(env).get_state_dict())
        elif way == "other sizes":
            seen = [env.reset(options={"env_idx": [2, 0], START: {"env_states": state}})[0]]
            assert not torch.equal(base(env).scale[[0, 2]], sizes[[0, 2]])
            torch.testing.assert_close(base(env).get_state()[1], before[1], rtol=0, atol=1e-6)
        found.append(torch.stack([*seen, *(env.step(a)[0] for a in steps)])[:, 1])
    wanted, own, other = found
    assert (other[0] - wanted[0]).abs().max() < 1e-3
    assert (other - wanted).abs().max() < 0.2
    assert (other - own)[1:].abs().max() < 0.02
    env.close()


@pytest.mark.parametrize("resets", [6, 2])
def test_cached_resets(env: Any, resets: int):
    wrapped: Any = CachedResetWrapper(env, config={"num_resets": resets, "seed": 0})  # pyright: ignore[reportArgumentType]
    obs, _ = wrapped.reset()
    for row in obs:
        assert any(torch.equal(row, known) for known in wrapped._cached_resets_obs_buffer)
    before = env.step(np.zeros(env.action_space.shape or ()))[0]
    for rows in ([2], np.array([2]), torch.tensor([False, False, True, False])):
        after, _ = wrapped.reset(options={"env_idx": rows})
        assert torch.equal(after[[0, 1, 3]], before[[0, 1, 3]])


def test_wrong_states_to_begin_in_are_refused(env: Any):
    for start, words in (({}, "'env_states'"), ([1], "'env_states'"), ({"env_states": np.zeros((2, 3))}, "shape")):
        with pytest.raises(InputError, match=words):
            env.reset(options={START: start})
    with pytest.raises(InputError, match="dictionary"):
        env.reset(options=3)  # pyright: ignore[reportArgumentType]


# ---- actions -------------------------------------------------------------------------------------


def test_actions_of_any_form_act_alike(env: Any):
    shape = env.action_space.shape or ()
    array: Any = np.linspace(-0.5, 0.5, int(np.prod(shape))).reshape(shape)
    tensor = torch.tensor(array, dtype=torch.float32)
    learned = tensor.clone().requires_grad_()
    mode = base(env).agent.control_mode
    forms = [
        tensor, array, tuple(tuple(row) for row in array.tolist()), learned, [*learned],
        {"control_mode": mode, "action": array.tolist()}, {"control_mode": mode, "action": learned},
    ]  # fmt: skip
    wanted = None
    for form in forms:
        env.reset(seed=0)
        obs, reward, *_ = env.step(form)
        wanted = obs if wanted is None else wanted
        assert torch.equal(obs, wanted)
        assert not obs.requires_grad
        assert not torch.as_tensor(reward).requires_grad
    env.step(np.zeros(shape, int))
    assert not any(leaf.requires_grad for _, leaf in flat(base(env).get_state_dict()))


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (0.5, "shape"),
        ([[0.0]], "shape"),
        ([[0.0], [0.0, 1.0]], "different lengths"),
        ("left", "numbers"),
        ([None] * COUNT, "numbers"),
        ({"arm": [0.0]}, "one robot only"),
        ({"control_mode": "telepathy", "action": [0.0]}, "control_mode"),
        ({"control_mode": None}, "action"),
        ({"control_mode": "pd_joint_pos", "action": [float("nan")]}, "pd_joint_pos"),
        ({"control_mode": "pd_joint_pos", "action": [[0.0, 1.0]]}, "pd_joint_pos"),
        ({"control_mode": "pd_joint_pos", "action": np.full((COUNT, 8), np.inf)}, "pd_joint_pos"),
        ({1: [0.0], "arm": [0.0]}, "one robot only"),
        ((number for number in [0.0]), "generator"),
    ],
)
def test_actions_that_fit_nothing_are_refused_in_one_sentence(env: Any, action: Any, words: str):
    state = base(env).get_state()
    with pytest.raises(InputError, match=words) as error:
        env.step(action)
    assert "\n" not in str(error.value)
    assert torch.equal(base(env).get_state(), state)


def test_another_control_mode_works_after_an_action_for_it_was_refused():
    """As if there had been no such action: with its own controller and the properties of its drives."""
    found, good = [], {"control_mode": "pd_joint_pos", "action": np.full((COUNT, 8), 0.1)}
    for refused in (False, True):
        env = make(STOCK, control_mode="pd_joint_delta_pos")
        env.reset(seed=0)
        if refused:
            with pytest.raises(InputError, match="for pd_joint_pos has shape"):
                env.step({"control_mode": "pd_joint_pos", "action": np.zeros((COUNT, 3))})
            assert base(env).agent.control_mode == "pd_joint_delta_pos"
        found.append([env.step(action)[0] for action in (np.ones((COUNT, 8)), good, good)])
        env.close()
    for one, two in zip(*found, strict=True):
        assert torch.equal(one, two)


def test_a_recorder_takes_what_the_environment_takes(env: Any, tmp_path: Any):
    recorder: Any = RecordEpisode(env, str(tmp_path), save_video=False)
    recorder.reset(seed=np.arange(COUNT))
    shape = env.action_space.shape or ()
    for action in (np.zeros(shape).tolist(), torch.zeros(shape, requires_grad=True), np.zeros(shape)):
        recorder.step(action)
    recorder.reset(options={"env_idx": np.array([True, False, False, False])})
    assert len(recorder._json_data["episodes"]) == 1
    recorder._h5_file.close()
