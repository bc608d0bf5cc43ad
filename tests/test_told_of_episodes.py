"""What an environment tells of itself: its tables, how its episodes began, what is logged, where hands touched."""

from math import pi
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_guidance import CPU
from torch import Tensor

from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_from_yaw
from dora.sim.batch.hooks import BACKEND
from dora.tasks.env import description
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.episode_start import start_numbers
from dora.tasks.env.state_reader import StateReader
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.rewards import Term
from dora.tasks.mdp.snapshot import CONTACT_CLASSES
from dora.tasks.mdp.stages import Stage

# ------------------------------------------------------------------------ tables


def environment(**more: Any) -> Any:
    """What the tables read of an environment."""
    return SimpleNamespace(
        observed=torch.zeros(2, 1), num_envs=2, parts=frozenset(("prior", "filter")), max_steps=80, ranking_steps=None,
        config=SimpleNamespace(
            dt=0.05, control_frequency=20, physics_frequency=100, solver_iterations=6, penetration_limit=0.003
        ),
        **more,
    )  # fmt: skip


def test_columns_of_the_observation_are_counted_through():
    def wide(size: int) -> Any:
        return lambda s: s.expand(-1, size)

    entries = {
        "q": Entry(wide(20), "rad", "joints", sensed=True),
        "p": Entry(wide(3), "m", "place"),
        "goal": Entry(wide(6), "m, rad", "to the candidate", guided=True),
        "near": Entry(wide(5), "m", "to the region", guided=True, region=True),
        "phase": Entry(wide(1), "1", "of the reference", guided=True, prior=True, sensed=True),
    }
    assert description.observation_rows(environment(observation_entries=entries))[1:] == [
        ["0-19", "`q`", "20", "rad", "joints", "always", "yes"],
        ["20-22", "`p`", "3", "m", "place", "always", ""],
        ["23-28", "`goal`", "6", "m, rad", "to the candidate", "guided", ""],
        ["29-33", "`near`", "5", "m", "to the region", "affordance", ""],
        ["34-34", "`phase`", "1", "1", "of the reference", "prior", "yes"],
    ]


def test_a_stage_is_held_for_a_control_step_at_least():
    def never(_: Any) -> Tensor:
        return torch.tensor([False])

    stages = [Stage[Any]("reach", never), Stage[Any]("hold", never, hold=0.5, lost=never, back_to="reach")]
    rows = description.stage_rows(environment(machine=SimpleNamespace(stages=stages)))
    assert rows[1:] == [["`reach`", "0.05", "never"], ["`hold`", "0.5", "`reach`"]]


def test_terms_are_told_with_part_weight_and_what_they_exist_with():
    def nothing(*_: Any) -> Tensor:
        return torch.zeros(2)

    terms = {
        "lift": Term(nothing, 3.0, "task", doc="the rise"),
        "near": Term(nothing, 0.25, "affordance", guided=True, doc="the region", region=True),
    }
    rows = description.term_rows(environment(terms=SimpleNamespace(terms=terms)))
    assert rows[1:] == [
        ["`lift`", "task", "3", "the rise", "always"],
        ["`near`", "affordance", "0.25", "the region", "affordance"],
    ]


def test_limits_are_told_in_seconds_and_millimetres():
    found = dict(description.limit_rows(environment())[1:])
    assert found["control / physics"] == "20 / 100 Hz"
    assert found["episode"] == "80 steps, 4 s"
    assert found["largest penetration of a success"] == "3 mm"
    assert found["control steps that ranking the candidates took"] == "unknown"
    known = environment()
    known.ranking_steps = 121_600
    assert description.limit_rows(known)[-1][-1] == "121600"


def test_an_environment_without_a_scene_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch):
    bare = environment()
    assert description.describe(bare) == "SimpleNamespace: 2 environments, guidance filter, prior"
    bare.parts = frozenset()
    assert description.describe(bare).endswith("guidance none")
    monkeypatch.setattr(description, "TABLES", {"names": lambda _: [["name", "size"], ["`q`", "20"]]})
    lines = description.describe(environment(arms={})).splitlines()
    assert lines[0].startswith("SimpleNamespace")
    assert lines[1:3] == ["", "names"]
    assert [line.split() for line in (lines[3], lines[-1])] == [["name", "size"], ["q", "20"]]


# ------------------------------------------------------------------------ what is logged


@pytest.mark.parametrize(
    ("backend", "parts", "more"),
    [(BACKEND, ("filter",), ("nonfinite", "unreachable")), (BACKEND, (), ("nonfinite",)), ("physx_cpu", (), ())],
)
def test_what_is_worth_a_curve_is_named(backend: str, parts: tuple[str, ...], more: tuple[str, ...]):
    env = SimpleNamespace(
        stage_names=("reach", "lift"), terms=SimpleNamespace(terms={"effort": None}), parts=frozenset(parts),
        backend=SimpleNamespace(sim_backend=backend),
    )  # fmt: skip
    env.unwrapped = env
    logged: Any = DoraEnv.logged
    assert logged.fget(env) == (
        "reward/effort", "stage/reach", "stage/lift", "penetration_mm", "raw_success", "success_at_end", "finished",
        *more,
    )  # fmt: skip


# ------------------------------------------------------------------------ how episodes began


def choice(away: float, turn: float) -> Any:
    """The second of two candidates was chosen, and is seen at a distance [m] and an angle [rad] from the stored one;
    a third one, chosen nowhere, is elsewhere."""
    p = torch.tensor([[0.0, 0.0, 0.1], [0.3, 0.0, 0.1], [9.0, 9.0, 9.0]])
    q = quaternion_from_yaw(torch.tensor([0.0, 1.0, 2.0]))
    nearest_p = torch.stack([p[1] + torch.tensor([0.0, away, 0.0]), p[2]]).expand(2, 2, 3)
    nearest_q = torch.stack([quaternion_from_yaw(torch.tensor(1.0 + turn)), q[2]]).expand(2, 2, 4)
    return SimpleNamespace(
        candidates=SimpleNamespace(position=p, quaternion=q),
        buffers=SimpleNamespace(chosen=torch.tensor([1.0, 1.0]), position=nearest_p, quaternion=nearest_q),
    )


def begun(objects: tuple[str, ...], choices: dict[str, Any]) -> dict[str, Tensor]:
    """Numbers of two episodes with these objects, whose sizes, masses and frictions count up."""
    drawn = {
        name: SimpleNamespace(mass=torch.tensor([1.0, 2.0]) + 10 * k, friction=torch.tensor([0.1, 0.2]) + k)
        for k, name in enumerate(objects)
    }
    arms = type("Arms", (dict,), {"choices": choices})(dict.fromkeys(choices))
    scale = torch.tensor([[0.9, 1.1], [0.8, 1.2]])[:, : len(objects)]
    memory = SimpleNamespace(objects=drawn)
    off = SimpleNamespace(bias=lambda name: torch.zeros(2, 6))
    known = SimpleNamespace(objects=dict.fromkeys(objects), memory=memory, arms=arms, scale=scale, perturbations=off)
    return start_numbers(known)


def test_one_object_and_one_arm_have_no_names():
    found = begun(("cube",), {"arm": choice(0.004, pi / 36)})
    assert {name: [round(v, 3) for v in value.tolist()] for name, value in found.items()} == {
        "size": [0.9, 0.8], "mass": [1.0, 2.0], "friction": [0.1, 0.2], "candidate_error_mm": [4.0, 4.0],
        "candidate_error_deg": [5.0, 5.0],
    }  # fmt: skip


def test_several_have():
    found = begun(("cube", "door"), {"left": choice(0.0, 0.0), "right": choice(0.002, 0.0)})
    assert set(found) == {
        f"{what}_{name}" for what in ("size", "mass", "friction") for name in ("cube", "door")
    } | {f"candidate_error_{unit}_{arm}" for unit in ("mm", "deg") for arm in ("left", "right")}  # fmt: skip
    assert found["size_door"].tolist() == pytest.approx([1.1, 1.2])
    assert found["mass_door"].tolist() == [11.0, 12.0]
    assert found["candidate_error_mm_left"].tolist() == [0.0, 0.0]
    assert found["candidate_error_mm_right"].tolist() == pytest.approx([2.0, 2.0], abs=1e-4)


# ------------------------------------------------------------------------ where hands touched


def test_points_of_a_hand_are_in_the_frame_of_its_object():
    """Two hands with two parts each, and two objects; the first hand holds the second object."""
    poses = torch.zeros(1, 3, 7)
    poses[..., 3] = 1.0
    poses[0, 0, :3] = 7.0  # a body of a hand
    poses[0, 2, :3] = torch.tensor([0.5, 0.0, 0.0])
    poses[0, 2, 3:] = quaternion_from_rotation_vector(torch.tensor([0.0, 0.0, pi / 2]))
    world = torch.tensor([[[0.5, 0.2, 0.1], [0.1, 0.2, 0.3], [5.0, 5.0, 5.0]]])
    group = torch.tensor([[1, 2, -1]])
    hands = {arm: Buffers(1, CPU, contact_p=(3, 3), contact_finger=(3,)) for arm in ("left", "right")}
    reader: Any = StateReader.__new__(StateReader)
    reader.points = 3
    reader._contacts = SimpleNamespace(points=lambda count: (world[:, :count], group[:, :count]))
    reader._poses = SimpleNamespace(poses=lambda: poses)
    reader._names, reader._handles = ("door", "cube"), {"left": "cube", "right": "door"}
    reader._rows = {"left": [0, 1], "right": [2, 3]}
    reader._classes = torch.tensor([0, 1, CONTACT_CLASSES.index("thumb"), CONTACT_CLASSES.index("index"), 0])
    memory = EpisodeMemory.__new__(EpisodeMemory)
    memory.hands = hands
    reader._record_points(memory)
    left, right = (hands[arm].get_state() for arm in ("left", "right"))
    torch.testing.assert_close(left["contact_p"], torch.tensor([[[0.2, 0.0, 0.1], [0.0] * 3, [0.0] * 3]]))
    torch.testing.assert_close(right["contact_p"], torch.tensor([[[0.0] * 3, [0.1, 0.2, 0.3], [0.0] * 3]]))
    assert left["contact_finger"].tolist() == [[CONTACT_CLASSES.index("thumb"), 0, 0]]
    assert right["contact_finger"].tolist() == [[0, CONTACT_CLASSES.index("index"), 0]]
