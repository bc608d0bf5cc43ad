"""Short training runs on the fake task."""

from pathlib import Path
from typing import Any

from fake_task import PointMass

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer

BASE = RunConfig(
    "Fake-v1", "ppo", "affordance", num_envs=16, workers=0, eval_envs=16, eval_episodes=16, final_episodes=40
)
"""Settings of a short run."""
SMALL_PPO = PPOConfig(rollout=16, minibatch=128, hidden=(32, 32))
"""Settings of a small learner."""


def run(path: Path, config: RunConfig, make: Any = PointMass, resume: bool = False) -> dict[str, Any]:
    """The result of a run in a folder, which is made unless it is resumed."""
    folder = RunFolder(path)
    if not resume:
        folder.create(config)
    return Trainer(config, make, folder, resume=resume).run()
