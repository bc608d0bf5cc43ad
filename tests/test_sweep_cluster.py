"""A sweep on a cluster of Ray: what is begun there, what comes back, and what becomes of runs that fail."""

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_run import fake_words
from fake_sweep import few, states

from dora.agents.runs.run_folder import RunFolder
from dora.configs import plain
from dora.errors import InputError
from dora.sweeps import ray_cluster
from dora.sweeps.launching import LOG, NOT_THE_RUN, resuming
from dora.sweeps.sweep import State, Sweep


class RayError(Exception):
    """What Ray raises about its cluster."""


class RayTaskError(RayError):
    """What Ray raises when a task has failed."""

    def __init__(self, cause: str):
        super().__init__(f"a traceback\n{cause}")
        self.cause = RuntimeError(cause)


class FakeRay(SimpleNamespace):
    """Ray as its launcher uses it, with machines of `cpus` cores, the last one gone."""

    def __init__(self, cpus: list[int], error: Exception | None = None):
        super().__init__(cpus=cpus, error=error, begun=[], ended=0, options={}, submitted=[], waited=[], cancelled=[])
        self.results: dict[str, Any] = {}
        self.exceptions = SimpleNamespace(RayTaskError=RayTaskError, RayError=RayError)

    def init(self, **options: Any) -> None:
        if self.error is not None:
            raise self.error
        self.begun.append(options)

    def shutdown(self) -> None:
        self.ended += 1

    def nodes(self) -> list[dict[str, Any]]:
        alive = [True] * (len(self.cpus) - 1) + [False]
        return [{"Resources": {"CPU": n}, "Alive": yes} for n, yes in zip(self.cpus, alive, strict=True)]

    def remote(self, **options: Any) -> Any:
        self.options = options
        return lambda function: SimpleNamespace(remote=self.submit, function=function)

    def submit(self, *arguments: Any) -> str:
        self.submitted.append(arguments)
        return f"task {len(self.submitted)}"

    def wait(self, tasks: list[str], **options: Any) -> tuple[list[str], list[str]]:
        self.waited.append((tasks, options))
        return [t for t in tasks if t in self.results], [t for t in tasks if t not in self.results]

    def get(self, task: str) -> Any:
        if isinstance(self.results[task], Exception):
            raise self.results[task]
        return self.results[task]

    def cancel(self, task: str) -> None:
        self.cancelled.append(task)


def test_a_cluster_has_room_for_whole_runs_on_each_living_machine(monkeypatch: pytest.MonkeyPatch):
    """Three cores of one and three of another machine are room for two runs of two cores, not for three."""
    ray = FakeRay([3, 3, 64])
    monkeypatch.setitem(sys.modules, "ray", ray)
    launcher = ray_cluster.RayLauncher("10.0.0.1:6379", cores=2)
    assert launcher.room == 2
    assert ray.begun == [
        {"address": "10.0.0.1:6379", "include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    ]
    assert ray.options == {"num_cpus": 2, "max_retries": ray_cluster.RETRIES}
    assert not ray.ended
    with pytest.raises(InputError, match="A run takes 4 cores, and no machine"):
        ray_cluster.RayLauncher(cores=4)
    assert ray.ended == 1


@pytest.mark.parametrize(("address", "where"), [("10.0.0.1:6379", "10.0.0.1:6379"), (None, "this machine")])
def test_a_cluster_that_does_not_answer_is_named(address: str | None, where: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", FakeRay([2], ConnectionError("no route\nto host")))
    with pytest.raises(InputError, match=rf"at {where} \(ConnectionError: no route\): start one"):
        ray_cluster.RayLauncher(address)


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    ray = FakeRay([4, 0])
    monkeypatch.setitem(sys.modules, "ray", ray)
    return ray


def test_a_machine_that_is_gone_or_that_has_no_cores_has_no_room(monkeypatch: pytest.MonkeyPatch):
    """One that Ray knows without cores, too."""
    ray = FakeRay([0, 2, 2])
    nodes = ray.nodes()
    del nodes[0]["Resources"]["CPU"]
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    monkeypatch.setitem(sys.modules, "ray", ray)
    assert ray_cluster.RayLauncher(cores=1).room == 2


def test_without_ray_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"--launcher ray needs Ray: pip install ray\."):
        ray_cluster.RayLauncher()


def test_what_has_ended_on_a_cluster_is_told_once_with_what_went_wrong(tmp_path: Path, ray: FakeRay):
    rows, launcher = few(5), ray_cluster.RayLauncher()
    folders = [tmp_path / str(index) for index in range(5)]
    assert launcher.ended() == []
    assert ray.waited == [], "nothing was asked for"
    for row, folder in zip(rows, folders, strict=True):
        folder.mkdir()
        launcher.start(row, folder, zero=folder.name == "0")
        assert len(list(folder.glob(".seen-*"))) == 1
    assert [(folder, settings, command, zero) for folder, _, settings, command, zero in ray.submitted] == [
        (str(folder), plain(row.config), resuming, folder.name == "0")
        for row, folder in zip(rows, folders, strict=True)
    ]
    assert [marker for _, marker, *_ in ray.submitted] == [next(f.glob(".seen-*")).name for f in folders]
    assert launcher.ended() == []
    assert ray.waited == [([f"task {n}" for n in range(1, 6)], {"num_returns": 5, "timeout": 0})]
    (tmp_path / "3" / "curve.csv").mkdir()
    ray.results = {
        "task 1": {"eval.csv": b"tables", "result.json": b"{}", "checkpoints/best.safetensors": b"b", "../x": b"no"},
        "task 2": RayTaskError("status 1: the disk is full"), "task 3": RayError("its machine is gone\nsince noon"),
        "task 4": {"curve.csv": b"new"},
    }  # fmt: skip
    ended = launcher.ended()
    assert [row for row, _ in ended] == rows[:4]
    assert [told for _, told in ended[:3]] == [None, "status 1: the disk is full", "RayError: its machine is gone"]
    assert str(ended[3][1]).startswith(f"Cannot write {folders[3] / 'curve.csv'}")
    assert sorted(p.relative_to(folders[0]).as_posix() for p in folders[0].rglob("*") if p.is_file()) == [
        "checkpoints/best.safetensors", "eval.csv", "result.json"
    ]  # fmt: skip
    assert not (tmp_path / "x").exists(), "nothing is written but what a run has"
    assert [len(list(folder.glob(".seen-*"))) for folder in folders] == [0, 0, 0, 0, 1]
    assert launcher.ended() == []
    launcher.stop()
    assert (ray.cancelled, ray.ended) == (["task 5"], 1)
    assert ray.waited[-1] == (["task 5"], {"num_returns": 1, "timeout": 60})
    assert not list(tmp_path.rglob(".seen-*"))
    assert launcher.ended() == []


def test_a_launcher_without_runs_leaves_the_cluster_at_once(ray: FakeRay):
    ray_cluster.RayLauncher().stop()
    assert (ray.cancelled, ray.waited, ray.ended) == ([], [], 1)


def test_the_files_of_a_run_arrive_with_the_result_as_the_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    order = []
    monkeypatch.setattr(ray_cluster, "write_bytes", lambda path, content: order.append(path.name))
    ray_cluster.receive(tmp_path, {"zero.csv": b"", "result.json": b"", "versions.txt": b"", "config.yaml": b""})
    assert sorted(order[:-1]) == ["config.yaml", "versions.txt", "zero.csv"]
    assert order[-1] == "result.json"


def test_a_machine_elsewhere_trains_in_its_cache_and_sends_what_a_report_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(ray_cluster, "cache_folder", lambda: tmp_path / "cache")
    (row,), here, asked = few(1), tmp_path / "here", []
    place = tmp_path / "cache" / "sweeps" / row.config.digest()

    def command(folder: Path, zero: bool) -> list[str]:
        asked.append((folder, zero))
        return fake_words(folder, "well")

    files = ray_cluster.train_there(str(here), "no-marker", plain(row.config), command)
    assert asked == [(place, True)], "zero correction is evaluated unless that is not wanted"
    assert set(files) == {"config.yaml", "versions.txt", "result.json", "progress.csv", "eval.csv", "zero.csv", LOG}
    assert not here.exists()
    (place / "checkpoints").mkdir(exist_ok=True)
    (place / "checkpoints" / "best.safetensors").write_bytes(b"best")
    again = ray_cluster.train_there(str(here), "no-marker", plain(row.config), command, False)
    assert len(asked) == 1, "it has ended already"
    assert again == files | {"checkpoints/best.safetensors": b"best"}
    ray_cluster.receive(here, files)
    assert states(Sweep([row], tmp_path / "out", [here])) == [State.DONE]


def test_a_run_that_fails_on_a_machine_of_the_cluster_says_why(tmp_path: Path):
    (row,) = few(1)
    (tmp_path / "seen").touch()
    asked = []

    def command(folder: Path, zero: bool) -> list[str]:
        asked.append(zero)
        return fake_words(folder, "fails") if len(asked) == 1 else [*fake_words(folder, "well")[:-1], wrong]

    with pytest.raises(RuntimeError, match=r"^status 1: the disk is full$"):
        ray_cluster.train_there(str(tmp_path), "seen", plain(row.config), command, False)
    assert asked == [False]
    wrong = fake_words(tmp_path, "well")[-1].replace(row.config.digest(), "0" * 12)
    with pytest.raises(RuntimeError, match=rf"^{NOT_THE_RUN}$"):
        ray_cluster.train_there(str(tmp_path), "seen", plain(row.config), command, False)


def test_a_run_that_another_process_trains_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (row,) = few(1)
    (tmp_path / "seen").touch()
    locked, slept = [True, True, False], []
    monkeypatch.setattr(ray_cluster, "is_locked", lambda place: locked.pop(0))
    monkeypatch.setattr(ray_cluster, "time", SimpleNamespace(sleep=slept.append))
    begun = lambda folder, zero: fake_words(folder, "well") if not locked else []  # noqa: E731
    assert ray_cluster.train_there(str(tmp_path), "seen", plain(row.config), begun) == {}
    assert slept == [ray_cluster.LOCK_SECONDS] * 2


def test_a_task_that_is_cancelled_lets_its_run_save_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    RunFolder(tmp_path).create(few(1)[0].config)
    waited, popen, processes = [], ray_cluster.subprocess.Popen, []

    class Interrupted(popen):
        def wait(self, timeout: float | None = None) -> int:
            waited.append(timeout)
            if len(waited) > 1:
                return super().wait(timeout)
            processes.append(self)
            deadline = time.monotonic() + 20
            while not (tmp_path / "progress.csv").exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            assert os.getsid(self.pid) == self.pid, "Ctrl-C reaches it once"
            raise KeyboardInterrupt

    monkeypatch.setattr(ray_cluster.subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        ray_cluster._trained(tmp_path, fake_words(tmp_path, "slow"))
    assert len(waited) == 2
    assert processes[0].returncode in (130, -signal.SIGINT)
    assert not (tmp_path / "result.json").exists()
