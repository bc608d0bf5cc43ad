"""TensorBoard tags, what they mean, and the writer that uses them."""

from collections.abc import Mapping
from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from dora.tables import markdown_table

TAGS: dict[str, str] = {
    "evaluation/success_rate": "share of evaluation episodes (fixed seeds, greedy) that end in success",
    "evaluation/return_mean": "mean sum of rewards of evaluation episodes",
    "evaluation/penetration_p95_mm": "95th percentile of the largest penetration of evaluation episodes [mm]",
    "evaluation/stage/<name>": "share of evaluation episodes that reached the stage",
    "episode/success_rate": "share of this iteration's training episodes that end in success",
    "episode/raw_success_rate": "the same, overlap not counted",
    "episode/success_at_end_rate": "share of successes in which what was reached still holds in the last step",
    "episode/return_mean": "mean sum of rewards of those episodes",
    "episode/length_mean": "mean length of those episodes [control steps]",
    "episode/reward/<term>": "mean per control step of the reward term over those episodes, weight included",
    "episode/stage/<name>": "share of those episodes that reached the stage",
    "episode/penetration_mm": "mean over those episodes of their largest penetration [mm]",
    "episode/nonfinite": "share of those episodes that ended because their simulation was not finite",
    "episode/<other>": "mean per control step of any other value that the task logs",
    "loss/policy": "PPO: clipped surrogate objective, negative",
    "loss/value": "PPO: squared error of the value times its weight",
    "loss/bound": "PPO: mean squared excess of mean actions over [-1, 1], without its weight",
    "loss/qvalue": "SAC: squared Bellman error, summed over both critics",
    "loss/actor": "SAC: temperature times log probability minus the smaller critic, without the prior's share",
    "learner/entropy": "entropy of the policy [nats]",
    "learner/kl": "PPO: divergence from the policy that collected the batch, last epoch [nats]",
    "learner/clip_fraction": "PPO: share of transitions whose probability ratio is clipped",
    "learner/learning_rate": "learning rate (PPO adapts it to the divergence)",
    "learner/grad_norm": "norm of the gradient before clipping (of the actor)",
    "learner/action_std": "mean standard deviation of the exploration noise (SAC: before the tanh)",
    "learner/correction": "SAC: root mean square of the mean action over the batch",
    "learner/explained_variance": "PPO: 1 - Var(target - value) / Var(target); 1 is perfect",
    "learner/alpha": "SAC: temperature",
    "learner/updates": "SAC: gradient steps so far",
    "learner/replay": "SAC: transitions in the replay buffer",
    "speed/steps_per_second": "environment steps per second of wall time, this iteration",
    "speed/collect_share": "share of wall time since the start spent collecting",
    "speed/learn_share": "share of wall time since the start spent learning",
    "speed/evaluate_share": "share of wall time since the start spent evaluating",
}
"""TensorBoard tags and what they mean."""

LOSSES = frozenset(tag.removeprefix("loss/") for tag in TAGS if tag.startswith("loss/"))
"""Names of the losses that have a tag."""


def tags_table() -> str:
    """The tags as a Markdown table."""
    return markdown_table(("tag", "meaning"), [(f"`{tag}`", meaning) for tag, meaning in TAGS.items()])


class RunLog:
    """Writes scalars to the TensorBoard events of a run folder; x is the number of environment steps."""

    def __init__(self, folder: Path, first_step: int = 0):
        self._writer = SummaryWriter(str(folder), purge_step=first_step or None)
        if first_step == 0:
            self._writer.add_text("tags", tags_table())

    def add(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Write `values` as `prefix/<name>`."""
        for name, value in values.items():
            self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def add_learner(self, values: Mapping[str, float], step: int) -> None:
        """Write what a learner's update returned: losses and the rest."""
        for name, value in values.items():
            self._writer.add_scalar(f"{'loss' if name in LOSSES else 'learner'}/{name}", value, step)

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()
