"""The folder of a run: what is where, and what `result.json` contains."""

import contextlib
import dataclasses
import datetime
import fcntl
import importlib.metadata
import itertools
import os
import platform
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from dora.agents.config import RunConfig, config_from_dict, of_training
from dora.agents.evaluation.evaluate import Evaluation
from dora.agents.limits import check
from dora.agents.runs.stored_results import MOST_RESULT, OF_TABLES, with_digests
from dora.configs import plain
from dora.digests import SEAL, check_file, check_text, file_sha256, is_whole, with_checksum
from dora.errors import InputError
from dora.files import check_name, renew_checksums, write_bytes, write_csv, write_json
from dora.reading import read_json, read_text, read_yaml
from dora.version import VERSION, source_commit

PACKAGES = ("mani_skill", "sapien", "torch", "torchrl", "tensordict", "gymnasium", "numpy")
"""Packages whose versions are written besides that of Dora."""
EVALUATION = "evaluation.txt"
"""File of a folder in which a policy is only evaluated."""
VERSIONS, LOCK = "versions.txt", ".lock"
"""Files of the versions of packages, and of the process that works in the folder."""
OWN_FILES = (EVALUATION, "config.yaml", "result.json", "curve.csv", "eval.csv", "zero.csv", "progress.csv",
             "checkpoints/latest.safetensors", "checkpoints/best.safetensors")  # fmt: skip
"""Files by which a folder is known to hold a run."""
CURVE_HEADER = (
    "env_steps",
    "wall_seconds",
    "success_rate",
    "return_mean",
    "penetration_p95_mm",
    "training_success_rate",
)
"""Columns of a learning curve."""
HALF_WRITTEN = re.compile(r"\..+\.\w{8}")
"""Name of a file that was being written when its process was killed, see `dora.files.write_bytes`."""


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths and writers of one run.

    `config.yaml`, `versions.txt`, TensorBoard events, `checkpoints/{latest,best}.safetensors`,
    `checkpoints/replay/` (SAC), `progress.csv` (one row per iteration), `curve.csv` (one row per evaluation),
    `eval.csv` (one row per episode of the last evaluation), `zero.csv` (the same of zero correction), `result.json`,
    `video/`, `nonfinite/` (last states of simulations that were not finite), `.lock`; `evaluation.txt` where nothing is
    trained.
    """

    path: Path

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def latest(self) -> Path:
        """Checkpoint from which `--resume` goes on."""
        return self.checkpoints / "latest.safetensors"

    @property
    def best(self) -> Path:
        """Checkpoint of the best evaluation."""
        return self.checkpoints / "best.safetensors"

    @property
    def replay(self) -> Path:
        """Folder of the replay buffer."""
        return self.checkpoints / "replay"

    @property
    def progress(self) -> Path:
        """Table of the iterations of training."""
        return self.path / "progress.csv"

    @property
    def nonfinite(self) -> Path:
        """Folder of the last states of simulations that were not finite."""
        return self.path / "nonfinite"

    @property
    def video(self) -> Path:
        """Folder of films."""
        return self.path / "video"

    def has_checkpoint(self) -> bool:
        """Whether there is a state to go on from; not where a run ended before it wrote one.

        Raises:
            InputError: there was one, as evaluations show, and it is missing.
        """
        if self.latest.exists():
            return True
        if self.latest.is_symlink() or self.best.exists() or (self.path / "curve.csv").exists():
            raise InputError(
                f"{self.latest} is missing, from which the run would go on: put it back, or start a new run."
            )
        return False

    def check_free(self, evaluation: bool = False) -> None:
        """Refuse a folder in which no run can be begun, before any work.

        Args:
            evaluation: the run is an evaluation, which may take the place of one that ended before its result.

        Raises:
            InputError: if it holds a run already, or cannot be made or written.
        """
        check_name(self.path)
        try:
            found = [name for name in OWN_FILES if (self.path / name).exists()]
            above = next(path for path in (self.path, *self.path.absolute().parents) if path.exists())
            fits = above.is_dir() and os.access(above, os.W_OK | os.X_OK)
        except (OSError, ValueError) as error:
            raise InputError(f"Cannot make the run folder {self.path} ({error}): choose another --out.") from error
        if evaluation and EVALUATION in found and "result.json" not in found:
            found = []
        if found and self.is_evaluation():
            raise InputError(f"{self.path} holds an evaluation already ({found[0]}): choose another --out.")
        if found:
            raise InputError(
                f"{self.path} holds a run already ({found[0]}): continue it with --resume or choose another --out."
            )
        if not fits:
            raise InputError(f"Cannot make the run folder {self.path} (nothing can be written): choose another --out.")

    def is_evaluation(self) -> bool:
        """Whether a policy was only evaluated here; the results of earlier versions tell it by the policy they name."""
        if os.path.lexists(self.path / EVALUATION):
            return True
        result = self._stored_result()
        return isinstance(result, dict) and "checkpoint" in result

    def check_trained(self) -> None:
        """Refuse to go on with what was never trained here.

        Raises:
            InputError: the folder is one of `--eval-only`.
        """
        if self.is_evaluation():
            raise InputError(
                f"{self.path} holds an evaluation, in which nothing is trained: give --resume the folder of a run, "
                "or evaluate again by --eval-only."
            )

    def create(self, config: RunConfig, evaluation: bool = False) -> None:
        """Make the folder and write `config.yaml` and `versions.txt`, and before them what tells an evaluation.

        Raises:
            InputError: if it cannot be written or holds a run already, or another process begins one there.
        """
        self.check_free(evaluation)
        try:
            self.checkpoints.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"Cannot make the run folder {self.path} ({error.strerror}): choose another --out."
            ) from error
        with self.locked():
            self.check_free(evaluation)  # of two processes one is first
            if evaluation:
                write_bytes(self.path / EVALUATION, b"A policy is evaluated here, nothing is trained.\n")
            self.write_config(config)
            write_bytes(self.path / VERSIONS, _versions().encode())

    def discard(self) -> None:
        """Remove what `create` made, and the folder if nothing else is in it: no run can begin with its settings."""
        for name in (EVALUATION, "config.yaml", VERSIONS, LOCK):
            (self.path / name).unlink(missing_ok=True)
        for folder in (self.checkpoints, self.path):
            with contextlib.suppress(OSError):  # something else is in it
                folder.rmdir()

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """A context in which no other process works in this folder; removes what a killed one left half written.

        The system drops the lock with the process, however that ends.

        Raises:
            InputError: if another process has it, or the folder cannot be written.
        """
        try:
            descriptor = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise InputError(f"Cannot write in {self.path} ({error.strerror}): make the folder writable.") from error
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(
                    f"Another process is at work in {self.path}: wait until it ends, or choose another --out."
                ) from error
            for place in (self.path, self.checkpoints, self.replay, self.nonfinite):
                for path in place.glob(".*"):
                    if HALF_WRITTEN.fullmatch(path.name) and path.is_file():
                        path.unlink(missing_ok=True)
            yield
        finally:
            os.close(descriptor)

    def mark_unfinished(self) -> None:
        """Let an earlier `result.json` say that the run is not finished, because it goes on."""
        result = self._stored_result()
        if isinstance(result, dict) and result.get("finished"):
            self.write_result(result | {"finished": False})

    def _stored_result(self) -> Any:
        """What `result.json` holds; None where it cannot be read or was changed, so that it gets no new digest."""
        try:
            result = read_json(self.path / "result.json", "result", MOST_RESULT)
        except InputError:
            return None
        changed = isinstance(result, dict) and (SEAL in result or OF_TABLES in result) and not is_whole(result)
        return None if changed else result

    def write_config(self, config: RunConfig) -> None:
        """Write `config.yaml`, with its checksum."""
        path = self.path / "config.yaml"
        write_bytes(path, with_checksum(yaml.safe_dump(plain(config), sort_keys=False)).encode())
        renew_checksums([path])

    def read_config(self) -> RunConfig:
        """Settings of the run.

        Raises:
            InputError: if this is not a run folder, or its settings do not fit this version.
        """
        path = self.path / "config.yaml"
        if not os.path.isfile(path):
            raise InputError(f"{self.path} is not a run folder (no readable config.yaml): give one that a run printed.")
        config = config_from_dict(read_yaml(path, "file of settings"), f"the settings in {path}")
        try:
            check(config, stored=True)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        check_text(read_text(path, "file of settings"), path)
        check_file(path)
        return config

    def write_curve(self, rows: list[list[Any]]) -> None:
        """Write `curve.csv`."""
        write_csv(self.path / "curve.csv", CURVE_HEADER, rows)

    def write_evaluation(self, evaluation: Evaluation, zero: Evaluation | None = None) -> None:
        """Write `eval.csv` and, of zero correction, `zero.csv`."""
        write_csv(self.path / "eval.csv", *evaluation.rows())
        if zero is not None:
            write_csv(self.path / "zero.csv", *zero.rows())

    def write_result(self, result: dict[str, Any]) -> dict[str, Any]:
        """Write `result.json`, with digests of itself, of the tables in the folder and of the policy that was trained
        in it; returns what it got."""
        trained = {"policy_digest": file_sha256(self.best)} if self.best.is_file() else {}
        whole = with_digests(result | trained, self.path)
        write_json(self.path / "result.json", whole)
        return whole


def default_folder(config: RunConfig, agent: str, suffix: str = "") -> Path:
    """runs/<env>/<agent>-<guidance>-s<seed>-<time>, and -2, -3, ... after it where that is taken."""
    time = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{agent}-{config.guidance}-s{config.seed}-{time}{suffix}"
    names = itertools.chain([name], (f"{name}-{k}" for k in itertools.count(2)))
    return next(path for each in names if not os.path.lexists(path := Path("runs") / config.env / each))


def make_result(
    config: RunConfig,
    *,
    env_steps: int,
    wall_seconds: float,
    episodes: int,
    evaluation: Evaluation | None,
    zero: Evaluation | None,
    curve: list[list[Any]],
    finished: bool,
    commit: str | None,
    nonfinite: int = 0,
    other_seconds: float | None = None,
) -> dict[str, Any]:
    """Content of `result.json`; rates are null where nothing was evaluated. `curve` has the rows of `curve.csv`,
    `commit` is that of the sources when the program was started (None: not known),
    `nonfinite` is the number of training episodes whose simulation was not finite, `other_seconds` the processor time
    that other programs took meanwhile [s], None where it is not known."""
    rate = env_steps / wall_seconds if wall_seconds > 0 else 0.0
    some = evaluation
    return {
        "env": config.env,
        "agent": config.agent,
        "guidance": config.guidance,
        "preset": config.preset,
        "seed": config.seed,
        "commit": commit,
        "task_config": config.task,
        "env_steps": env_steps,
        "wall_seconds": round(wall_seconds, 3),
        "env_steps_per_second": round(rate, 1),
        "episodes": episodes,
        "success_rate": some.success_rate if some else None,
        "zero_success_rate": zero.success_rate if zero else None,
        "stage_rates": some.stage_rates if some else {},
        "return_mean": some.return_mean if some else None,
        "penetration_max_mm": some.penetration_mm() if some else None,
        "num_envs": config.num_envs,
        "workers": config.workers,
        "config_digest": config.digest(),
        "finished": finished,
        "eval_episodes": len(some.table) if some else 0,
        "penetration_p95_mm": some.penetration_p95_mm if some else None,
        "guidance_parts": config.task_options["guidance_parts"],
        "success_interval": list(some.success_interval) if some else None,
        "raw_success_rate": some.raw_success_rate if some else None,
        "success_at_end_rate": some.success_at_end_rate if some else None,
        "nonfinite_episodes": nonfinite + (some.nonfinite_episodes if some else 0),
        "ranking_steps": some.ranking_steps if some else None,
        "steps_to_50": steps_to(0.5, curve),
        "steps_to_80": steps_to(0.8, curve),
        "reward": config.reward,
        "overlap_share": config.overlap_share,
        "total_steps": config.total_steps,
        "first_seed": some.first_seed if some else None,
        "other_load": other_seconds / wall_seconds if other_seconds is not None and wall_seconds > 0 else None,
        "learner_config": plain(config.learner),
        "training_config": of_training(config),
    }


def steps_to(success: float, curve: list[list[Any]]) -> int | None:
    """Environment steps of the first row of a learning curve with this success rate; None if there is none."""
    at, rate = CURVE_HEADER.index("env_steps"), CURVE_HEADER.index("success_rate")
    return next((row[at] for row in curve if row[rate] >= success), None)


def _versions() -> str:
    lines = [f"python {platform.python_version()}", f"platform {platform.platform()}"]
    lines += [f"commit {commit}"] if (commit := source_commit()) else []
    lines += [f"dora {VERSION}"]
    for name in PACKAGES:
        try:
            lines.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            lines.append(f"{name} not installed")
    return "\n".join(lines) + "\n"
