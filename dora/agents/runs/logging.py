"""What TensorBoard shows of a run: tags and what they mean, layout, hyperparameters, film, and their writer."""

import contextlib
import itertools
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.summary.writer.event_file_writer import _AsyncWriterThread
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from dora.agents.config import RunConfig
from dora.configs import flat, plain
from dora.tables import markdown_table

LOST = "TensorBoard's events could not all be written"
"""Beginning of the line about a full disk."""
TAGS: dict[str, str] = {
    "evaluation/success_rate": "share of evaluation episodes (fixed seeds, greedy) that end in success",
    "evaluation/return_mean": "mean sum of rewards of evaluation episodes",
    "evaluation/penetration_p95_mm": "95th percentile of the largest penetration of evaluation episodes [mm]",
    "evaluation/stage/<name>": "share of evaluation episodes that reached the stage",
    "evaluation/film": "the best policy, if a film was asked for with --video and can be rendered",
    "final/success_rate": "share of successes in the last evaluation of the best policy, as in result.json",
    "final/zero_success_rate": "the same without any correction",
    "final/penetration_p95_mm": "95th percentile of the largest penetration in the last evaluation [mm]",
    "training/success_rate": "share of this iteration's episodes that end in success",
    "training/raw_success_rate": "the same, overlap not counted",
    "training/success_at_end_rate": "share of those episodes in whose last step what was reached still holds",
    "training/return_mean": "mean sum of rewards of those episodes",
    "training/length_mean": "mean length of those episodes [control steps]",
    "training/reward/<term>": "mean per control step of the reward term over those episodes, weight included",
    "training/stage/<name>": "share of those episodes that reached the stage",
    "training/penetration_mm": "mean over those episodes of their largest penetration [mm]",
    "training/nonfinite": "share of those episodes that ended because their simulation was not finite",
    "training/<other>": "mean per control step of any other value that the task logs",
    "loss/policy": "PPO: clipped surrogate objective, negative",
    "loss/value": "PPO: squared error of the value times its weight",
    "loss/bound": "PPO: mean squared excess of mean actions over [-1, 1], without its weight",
    "loss/policy/<agent>": "MAPPO, HAPPO: the same of the agent's actor",
    "loss/bound/<agent>": "MAPPO, HAPPO: the same of the agent's mean actions",
    "loss/qvalue": "SAC: squared Bellman error, summed over both critics",
    "loss/actor": "SAC: temperature times log probability minus the smaller critic, without the prior's share",
    "learner/entropy": "entropy of the policy [nats]",
    "learner/kl": "PPO: divergence from the policy that collected the batch, last epoch [nats]",
    "learner/clip_fraction": "PPO: share of transitions whose probability ratio is clipped",
    "learner/learning_rate": "learning rate (PPO adapts it to the divergence)",
    "learner/grad_norm": "norm of the gradient before clipping (of the actor)",
    "learner/action_std": "mean standard deviation of the exploration noise (SAC: before the tanh)",
    "learner/correction": "root mean square of the mean action over the batch (SAC: after the tanh)",
    "learner/explained_variance": "PPO: 1 - Var(target - value) / Var(target); 1 is perfect",
    "learner/factor_std/<agent>": "HAPPO: deviation of the compounded ratio by which its advantages are multiplied",
    "learner/<value>/<agent>": (
        "MAPPO, HAPPO: entropy, kl, clip_fraction, learning_rate, grad_norm, action_std, correction of one"
    ),
    "learner/alpha": "SAC: temperature",
    "learner/updates": "SAC: gradient steps so far",
    "learner/replay": "SAC: transitions in the replay buffer",
    "speed/steps_per_second": "environment steps per second of wall time, this iteration",
    "speed/collect_share": "share of wall time since the start spent collecting",
    "speed/learn_share": "share of wall time since the start spent learning",
    "speed/evaluate_share": "share of wall time since the start spent evaluating",
}
"""TensorBoard tags and what they mean."""

FILM = "evaluation/film"
"""Tag of the film of the best policy."""
FINAL = ("success_rate", "zero_success_rate", "penetration_p95_mm")
"""Entries of `result.json` that stand beside the settings of a run."""
LAYOUT = {
    "Success": {
        "success": ["Multiline", ["evaluation/success_rate", "training/success_rate"]],
        "stages, evaluation": ["Multiline", ["evaluation/stage/.*"]],
        "with overlap not counted": ["Multiline", ["training/success_rate", "training/raw_success_rate"]],
    },
    "Overlap": {"penetration [mm]": ["Multiline", ["evaluation/penetration_p95_mm", "training/penetration_mm"]]},
    "Reward": {
        "terms, per control step": ["Multiline", ["training/reward/.*"]],
        "sum of an episode": ["Multiline", ["evaluation/return_mean", "training/return_mean"]],
    },
    "Time": {"shares": ["Multiline", ["speed/.*_share"]]},
}
"""Charts of the page "Custom Scalars": category, title, tags as regular expressions."""

LOSSES = frozenset(tag.removeprefix("loss/") for tag in TAGS if tag.startswith("loss/"))
"""Names of the losses that have a tag."""


def tags_table() -> str:
    """The tags as a Markdown table."""
    return markdown_table(("tag", "meaning"), [(f"`{tag}`", meaning) for tag, meaning in TAGS.items()])


class RunLog:
    """Writes to the TensorBoard events of a run folder; x is the number of environment steps.

    Args:
        folder: of the run.
        first_step: after which it goes on; later events of earlier calls are hidden. At 0 the table of tags, the
            layout and the settings are written.
        config: settings of the run, for the page of hyperparameters.
    """

    def __init__(self, folder: Path, first_step: int = 0, config: RunConfig | None = None):
        _silence_writing_thread()
        self._writer: SummaryWriter | None = None
        self._settings = {} if config is None else flat_settings(config)
        with self._writing():
            self._writer = SummaryWriter(str(folder), purge_step=first_step + 1 if first_step else 0)
            if first_step == 0:
                self._writer.add_text("tags", tags_table())
                self._writer.add_custom_scalars(LAYOUT)
                self._add_hyperparameters(self._writer, 0, 1)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """A full disk is told once, and the run goes on without the events: it has its other files."""
        try:
            yield
        except OSError as error:
            writer, self._writer = self._writer, None
            print(f"{LOST} ({error.strerror or error}).", file=sys.stderr)
            with contextlib.suppress(OSError):
                if writer is not None:
                    writer.close()

    def add(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Write `values` as `prefix/<name>`."""
        with self._writing():
            for name, value in values.items():
                if self._writer is not None:
                    self._writer.add_scalar(f"{prefix}/{name}", value, step)

    def add_learner(self, values: Mapping[str, float], step: int) -> None:
        """Write what a learner's update returned: losses and the rest."""
        for name, value in values.items():
            self.add("loss" if name.partition("/")[0] in LOSSES else "learner", {name: value}, step)

    def add_final(self, result: Mapping[str, Any], step: int) -> None:
        """Write the figures of a finished run's `result.json` that stand beside its settings."""
        self.add("final", {name: result[name] for name in FINAL if result.get(name) is not None}, step)
        with self._writing():
            if self._writer is not None:
                self._add_hyperparameters(self._writer, 2)

    def _add_hyperparameters(self, writer: SummaryWriter, *parts: int) -> None:
        """Write parts of what the page of hyperparameters reads: 0 their names, 1 the values, 2 that the run ended."""
        summaries = hparams(self._settings, {f"final/{name}": 0.0 for name in FINAL})
        for part in parts:
            writer._get_file_writer().add_summary(summaries[part])  # add_hparams makes a folder of its own

    def close(self) -> None:
        """Flush and close; what a full disk does not take is lost, and the run has its other files."""
        with self._writing():
            if self._writer is not None:
                self._writer.close()


def _silence_writing_thread() -> None:
    """Show no traceback of TensorBoard's thread for a full disk: the error is raised again where the log is written."""
    earlier = threading.excepthook
    if getattr(earlier, "__name__", "") == "_unless_tensorboard":
        return

    def _unless_tensorboard(met: threading.ExceptHookArgs) -> None:
        if not (isinstance(met.thread, _AsyncWriterThread) and isinstance(met.exc_value, OSError)):
            earlier(met)

    threading.excepthook = _unless_tensorboard


def flat_settings(config: RunConfig) -> dict[str, str | float | bool]:
    """Settings of a run by their names on the command line; what is no number, text or bool is written as text."""
    return {name: v if isinstance(v, str | float | int | bool) else str(v) for name, v in flat(plain(config))}


def add_film(folder: Path, film: Path, step: int) -> None:
    """Put a film into the TensorBoard events of a run folder, as a GIF of every second frame in half the size.

    Args:
        folder: of the run.
        film: the file.
        step: environment steps of its policy.
    """
    reader: Any = imageio.get_reader(film)
    frames = [np.asarray(frame)[::2, ::2] for frame in itertools.islice(reader, None, None, 2)]
    milliseconds = 2000 / reader.get_meta_data()["fps"]
    gif: Any = imageio.mimwrite("<bytes>", frames, format="GIF", duration=milliseconds, loop=0)  # pyright: ignore
    height, width = frames[0].shape[:2]
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
    try:
        with SummaryWriter(str(folder)) as writer:
            writer._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=FILM, image=image)]), step)
    except OSError as error:
        print(f"{LOST} ({error.strerror or error}); the film is {film}.", file=sys.stderr)
