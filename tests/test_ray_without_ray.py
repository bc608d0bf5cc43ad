"""What is asked of a Ray cluster and what is made of its answers, with a cluster that is made up."""

import os
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torchrl.collectors.distributed as distributed
from fake_task import PointMass
from tensordict import TensorDict

from dora.agents.collecting.ray_collector import FOREVER, ActorCollector, explained, ray_collector, whole_batch
from dora.agents.collecting.task_env import TaskEnv, TrainingRules
from dora.agents.config import PPOConfig
from dora.agents.learners.ppo import PPO
from dora.errors import InputError, WorkerFailure


class Cluster(SimpleNamespace):
    """As the module `ray`."""

    cores: float = 2.0
    running = False
    begun: Any = None
    error: Exception | None = None

    def is_initialized(self) -> bool:
        return self.running

    def init(self, **options: Any) -> None:
        if self.error is not None:
            raise self.error
        self.begun = options

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.cores} if self.cores else {}


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    made = Cluster()
    monkeypatch.setitem(sys.modules, "ray", made)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(distributed, "RayCollector", lambda *given, **options: (given, options), raising=False)
    return made


def collector(seeds: list[int], make: Any = PointMass) -> Any:
    policy = PPO(PPOConfig(hidden=(8,)), 4, 2, 1000).policy
    rules = TrainingRules(stagger=True, after_success=3)
    return ray_collector(make, policy, frames=64, seeds=seeds, rules=rules), policy


def test_each_worker_is_an_actor_with_a_core_and_a_seed_of_its_own(cluster: Cluster, monkeypatch: pytest.MonkeyPatch):
    ((factories, acting), options), policy = collector([3, 4], lambda: PointMass(16))
    assert acting is policy
    assert cluster.begun == {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    assert (options["frames_per_batch"], options["total_frames"]) == (64, FOREVER)
    assert options["remote_configs"] == {"num_cpus": 1, "num_gpus": 0}
    assert options["collector_class"] is ActorCollector
    assert options["collector_kwargs"] == {"auto_register_policy_transforms": False}
    assert options["sync"]
    assert options["trust_policy"]
    threads, before = torch.get_num_threads(), torch.get_rng_state()
    monkeypatch.delenv("OMP_NUM_THREADS")
    try:
        torch.set_num_threads(2)
        for seed, factory in zip((3, 4), factories, strict=True):
            env = factory()
            assert torch.get_num_threads() == 1
            assert os.environ["OMP_NUM_THREADS"] == "1"
            assert torch.initial_seed() == seed
            assert isinstance(env, TaskEnv)
            assert env.rules == TrainingRules(stagger=True, after_success=3)
            alone = TaskEnv(PointMass(16), seed=seed)
            assert torch.equal(env.reset()["observation"], alone.reset()["observation"])
    finally:
        torch.set_num_threads(threads)
        torch.set_rng_state(before)


def test_a_cluster_that_is_there_is_used_as_it_is(cluster: Cluster):
    cluster.running = True
    collector([1])
    assert cluster.begun is None


@pytest.mark.parametrize(
    ("cores", "workers", "fits"), [(2.0, 2, True), (2.0, 3, False), (0.0, 1, False), (1.0, 1, True)]
)
def test_there_are_no_more_workers_than_cores(cluster: Cluster, cores: float, workers: int, fits: bool):
    cluster.cores = cores
    if fits:
        ((factories, _), _), _ = collector(list(range(workers)))
        assert len(factories) == workers
    else:
        words = f"has {cores:.0f} cores, and --workers is {workers}: use at most {cores:.0f}"
        with pytest.raises(InputError, match=words):
            collector(list(range(workers)))


@pytest.mark.parametrize("kind", [ConnectionError, ValueError, RuntimeError])
def test_a_cluster_that_does_not_answer_is_told_in_a_sentence(cluster: Cluster, kind: type[Exception]):
    cluster.error = kind("first line\nsecond line")
    with pytest.raises(InputError, match=rf"No Ray cluster answers \({kind.__name__}: first line\): start one") as met:
        collector([1])
    assert "\n" not in str(met.value)


def test_without_ray_it_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match="pip install ray"):
        collector([1])


def test_a_collector_without_end_is_true():
    assert bool(ActorCollector.__new__(ActorCollector))


def test_batches_of_workers_are_joined_and_one_that_is_whole_stays():
    rows = torch.arange(24.0).reshape(2, 3, 4)
    stacked = TensorDict({"x": rows}, [2, 3, 4])
    assert torch.equal(whole_batch(stacked)["x"], rows.reshape(6, 4))
    assert whole_batch(stacked).shape == (6, 4)
    single = TensorDict({"x": rows[0]}, [3, 4])
    assert whole_batch(single) is single


def test_errors_of_a_cluster_are_told_and_others_left_alone():
    error: Any = type("RayTaskError", (Exception,), {"__module__": "ray.exceptions"})
    died, failed, refused = error(), error(), error()
    failed.cause, refused.cause = KeyError("x"), InputError("The action is NaN.")
    assert explained(ValueError("x")) is None
    for given, kind, words in (
        (died, WorkerFailure, "A worker of the cluster died (RayTaskError)."),
        (refused, InputError, "The action is NaN."),
    ):
        found = explained(given)
        assert (type(found), str(found)) == (kind, words)
    found = explained(failed)
    assert isinstance(found, WorkerFailure)
    assert str(found).startswith("A worker of the cluster failed with KeyError")
