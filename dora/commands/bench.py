"""Measure how fast the parts of Dora are: `dora bench env --env PickCube-v1 --json`."""

import dataclasses
import functools
import json
from math import isnan
from typing import Literal, get_args

import torch
import tyro

from dora.agents.learners import benchmark as learner_benchmark
from dora.agents.runs.recommended import recommended
from dora.agents.runs.training_profile import profile_training
from dora.commands import play
from dora.errors import InputError, command
from dora.live import page_rate
from dora.parallel import available_cores
from dora.policies.policy import load_policy
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim import StepProfile
from dora.tables import print_table
from dora.tasks import check_task_id, find_task, make_task
from dora.tools import env_benchmark as benchmark
from dora.tools import grasp_benchmark
from dora.tools import physics_benchmark as task_physics
from dora.tools.filter_benchmark import HEAD, Choice, outcome_rows, outcomes

LONGEST = 86_400.0
"""Longest time of a measurement of learners [s]."""
MOST_EPISODES = 10_000
"""Most episodes of a comparison."""


def bench_env(
    env: str = "PickCube-v1",
    num_envs: int = 256,
    workers: int = available_cores(),
    seconds: float = 10.0,
    obs_mode: str = "state",
    json: bool = False,
) -> None:
    """Environment steps per second with random actions, against an AsyncVectorEnv of single environments.

    Args:
        env: task, any ManiSkill id.
        num_envs: environments in each process.
        workers: processes (default: one per core).
        seconds: length of each of the four measurements [s].
        obs_mode: what is observed, such as state, rgb or rgb+depth+segmentation; pictures need a Vulkan driver.
        json: print one JSON object on the last line instead of a table.
    """
    report(dataclasses.asdict(benchmark.measure(env, num_envs, workers, seconds, obs_mode)), json)


def bench_grasp(object: str = "cube", robot: str = "diana7_hit", json: bool = False) -> None:
    """Grasp candidates per second on one core, against plain pytorch_kinematics and trimesh.

    Args:
        object: name of an object, or the path of its folder or mesh.
        robot: folder of the robot.
        json: print one JSON object on the last line instead of a table.
    """
    report(dataclasses.asdict(grasp_benchmark.measure(object, load_robot(robot))), json)


def bench_learner(env: str = "DoraCube-v1", agent: str = "ppo", seconds: float = 5.0, json: bool = False) -> None:
    """Gradient steps per second of a learner with a task's recommended settings, against the same in plain torch.

    Args:
        env: a Dora id, for the settings and the numbers of components.
        agent: ppo or sac.
        seconds: length of each of the six measurements [s].
        json: print one JSON object on the last line instead of a table.
    """
    if not 0 < seconds <= LONGEST:
        raise InputError(f"--seconds is {seconds:g}: give a time above 0 and up to {LONGEST:g} seconds.")
    config = recommended(env, agent, find_task(env).LEARNERS)
    task = make_task(env, 1)
    observation = sum(entry.value(task.snapshot).shape[-1] for entry in task.observation_entries.values())
    speed = learner_benchmark.measure(config, observation, task.action_size, seconds)
    task.close()
    report(dataclasses.asdict(speed), json)


def bench_training(
    env: str = "DoraCube-v1", agent: str | None = None, steps: int | None = None, json: bool = False
) -> None:
    """Where the time of a training goes, with a task's recommended settings: a short run, which is thrown away.

    Args:
        env: a Dora id.
        agent: learner (default: the task's recommended one).
        steps: environment steps (default: 50,000, or up to the first evaluation where the task's comes later).
        json: print one JSON object on the last line instead of a table.
    """
    config = recommended(env, agent, find_task(env).LEARNERS)
    make_tasks = functools.partial(make_task, env, **config.task_options)
    steps = max(SHORT_TRAINING, config.eval_every) if steps is None else steps
    report(dataclasses.asdict(profile_training(config, make_tasks, StepProfile, steps, available_cores())), json)


SHORT_TRAINING = 50_000
"""Fewest environment steps of a training that is profiled, where nothing else is said [1]."""
PHYSICS = ("120:10:8", "240:2:8", "240:3:6", "240:5:4", "240:5:8", "240:10:4", "240:10:8", "240:10:15", "480:10:8")
"""Default physics settings: rate [Hz], contact offset [mm], position iterations."""


def bench_physics(
    env: str = "DoraHammer-v1",
    settings: tuple[str, ...] = PHYSICS,
    starts: int = 64,
    preset: str = "none",
    json: bool = False,
) -> None:
    """What a task's scripted solution makes of other physics settings: success, overlaps, tunnelling, time.

    Args:
        env: a Dora id.
        settings: FREQUENCY:OFFSET:ITERATIONS each, in Hz, mm, and position iterations of the solver.
        starts: initial states, the same for all settings.
        preset: how much they are randomised.
        json: print one JSON object on the last line instead of a table.
    """
    if not settings:
        raise InputError(f"--settings needs at least one FREQUENCY:OFFSET:ITERATIONS, such as {PHYSICS[0]}.")
    asked = [task_physics.parse_physics(text) for text in settings]
    with ProgressDisplay() as progress:
        update = progress.phase(f"physics of {env}", "settings")
        rows = task_physics.measure_physics(env, asked, starts, preset, progress=update)
    flat = [dataclasses.asdict(row.physics) | dataclasses.asdict(row) for row in rows]
    flat = [{k: v for k, v in row.items() if k != "physics"} for row in flat]
    if json:
        report({"env": env, "starts": starts, "preset": preset, "rows": flat}, True)
        return
    print_table(list(flat[0]), [[f"{value:.4g}" for value in row.values()] for row in flat])


def bench_page(
    env: tyro.conf.Positional[str] = "DoraHammer-v1",
    seconds: float = 12.0,
    preset: Literal["none", "standard", "hard"] = "standard",
    zero_correction: bool = False,
    json: bool = False,
) -> None:
    """States per second that the page of `dora play` sends to one client, which takes all and draws nothing.

    Args:
        env: a Dora id; who acts is the policy that comes with it, if one does.
        seconds: length of the measurement, rests between episodes included [s].
        preset: how much episodes are randomised.
        zero_correction: let the zero action act.
        json: print one JSON object on the last line instead of a table.
    """
    check_task_id(env)
    torch.set_num_threads(1)  # as `dora play`
    players = play.find_players(play.Args(env=env, zero_correction=zero_correction))
    report(dataclasses.asdict(page_rate.measure(env, players, seconds, preset)), json)


def bench_filter(
    env: tyro.conf.Positional[str] = "DoraJug-v1",
    episodes: int = 1000,
    preset: Literal["none", "standard", "hard"] = "standard",
    policy: bool = False,
    json: bool = False,
) -> None:
    """Whether the reach filter pays: how often candidates fail that f_reach accepts, and those that it rejects.

    Args:
        env: a task of one arm with a table of f_reach.
        episodes: with the candidates that the task would choose, and with random ones; whole batches of 64 each.
        preset: how much episodes are randomised.
        policy: let the policy that comes with Dora act; otherwise the zero action does.
        json: print one JSON object on the last line instead of a table.
    """
    if not 0 < episodes <= MOST_EPISODES:
        raise InputError(f"--episodes is {episodes}: give a number from 1 to {MOST_EPISODES}.")
    act = load_policy(env) if policy else None
    found = {choice: outcomes(env, episodes, preset, choice, act=act) for choice in get_args(Choice)}
    if json:
        report({"env": env, "preset": preset, "policy": policy, **{c: f.summary() for c, f in found.items()}}, True)
        return
    for choice, outcome in found.items():
        print(f"\n{env}, {preset}, {choice} candidates:")
        print_table(HEAD, outcome_rows(outcome))
        shares = zip(("accepted", "rejected"), outcome.failure_rates(), strict=True)
        print("failed:", ", ".join(f"{share:.3f} of the {name}" for name, share in shares if not isnan(share)))


def report(result: dict, as_json: bool) -> None:
    """Print a result as a table or as one line of JSON."""
    if as_json:
        print(json.dumps(result))
    else:
        print_table(("what", "value"), [(name, str(value)) for name, value in result.items()])


KINDS = {
    "env": bench_env, "filter": bench_filter, "grasp": bench_grasp, "learner": bench_learner, "page": bench_page,
    "physics": bench_physics, "training": bench_training,
}  # fmt: skip
"""What `dora bench NAME` does."""


@command
def main() -> int:
    """Run the command; returns the exit status."""
    tyro.extras.subcommand_cli_from_dict(KINDS, description=__doc__)
    return 0
