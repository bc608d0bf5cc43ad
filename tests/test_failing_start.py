"""Workers that cannot be started: the run says so and ends."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import functools
from fake_task import PointMass
from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import TrainingRules, TaskEnv
from dora.agents.learners.networks import Normaliser, Policy, TanhActor

class Stuck:
    "A hook that cannot be sent to a process."
    def __call__(self, *args): ...
    def __deepcopy__(self, memo): return self
    def __reduce__(self): raise AttributeError("it cannot be sent")

if __name__ == "__main__":
    observation, action = TaskEnv(PointMass(2)).sizes
    actor = TanhActor(observation, action, (8,), -1.1)
    actor.register_forward_hook(Stuck())
    make = functools.partial(PointMass, 2)
    policy = Policy(Normaliser(observation, 9), actor)
    Rollouts(make, policy, workers=2, num_envs=2, rollout=4, seeds=[1, 2], rules=TrainingRules())
"""


def test_a_policy_that_cannot_be_sent_ends_the_process(project_root: Path, tmp_path: Path):
    (tmp_path / "start.py").write_text(SCRIPT)
    paths = f"{project_root}:{project_root / 'tests'}"
    done = subprocess.run(
        [sys.executable, tmp_path / "start.py"], env={"PYTHONPATH": paths, "PATH": "/usr/bin:/bin"},
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.strip().endswith("WorkerFailure: The workers failed with AttributeError: it cannot be sent.")
