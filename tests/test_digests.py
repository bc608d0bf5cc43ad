"""Digests count values, not the names of classes; what is stored under them still loads."""

from dataclasses import dataclass, field, make_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import hand_digest
from dora.affordance.objects.catalogue import available_objects, own_objects
from dora.affordance.reach.feasibility_table import file_name
from dora.agents.checkpoint import read_checkpoint
from dora.digests import KEY, digest_of
from dora.robot import load_robot
from dora.tasks import make_task

POLICIES = sorted((Path(__file__).parents[1] / "results").rglob("policy.safetensors"))


@dataclass(frozen=True)
class Numbers:
    """Settings before a renaming."""

    reach: float = 0.5
    name: str = "a"


def test_the_name_of_a_class_does_not_count_and_a_renamed_field_keeps_its_key():
    renamed = make_dataclass(
        "Others", [("far", float, field(default=0.5, metadata={KEY: "reach"})), ("name", str, "a")]
    )
    assert digest_of(Numbers()) == digest_of(renamed()) == digest_of({"name": "a", "reach": 0.5})


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Numbers(), replace(Numbers(), reach=0.25)),
        (["ab", "c"], ["a", "bc"]),
        ([1], [1.0]),
        ([True], [1]),
        ([None], ["None"]),
        ([[1], 2], [1, [2]]),
        (b"1", "1"),
        (np.zeros(2, np.float32), np.zeros(2, np.float64)),
        (torch.zeros(2, 3), torch.zeros(3, 2)),
        ({"a": 1, "b": 2}, {"a": 2, "b": 1}),
    ],
)
def test_different_values_have_different_digests(one: object, other: object):
    assert digest_of(one) != digest_of(other)


def test_order_of_keys_and_sets_does_not_count():
    assert digest_of({"a": 1, "b": {3, 1, 2}}) == digest_of({"b": {2, 3, 1}, "a": 1})
    assert digest_of(torch.arange(3)) == digest_of(np.arange(3))


def test_what_cannot_be_hashed_by_value_is_refused():
    with pytest.raises(TypeError, match="object"):
        digest_of({"a": object()})


@pytest.mark.parametrize("name", available_objects())
def test_bundled_grasps_fit_object_and_hand(name: str):
    assert len(load_candidates(name)) > 0


def test_the_hands_digest_is_the_one_that_the_bundled_grasps_have():
    """Written down, so that a change of the digest cannot go unnoticed."""
    assert hand_digest(load_robot("diana7_hit")).startswith("75529b8f286bda69")


@pytest.mark.parametrize("env_id", ["DoraCube-v1", "DoraJug-v1"])
def test_bundled_tables_of_feasibility_are_found(env_id: str):
    task = make_task(env_id, 1)
    table = task.arm.reach_table
    task.close()
    assert table is not None
    assert (own_objects() / task.arm.spec.object / file_name(table.digest)).is_file()


@pytest.mark.parametrize("path", POLICIES, ids=lambda p: p.parent.name)
def test_committed_policies_load(path: Path):
    assert read_checkpoint(path).tensors


def test_texts_have_the_same_digest_whatever_unicode_a_version_of_python_knows():
    assert digest_of("runs/\U0001fae8") == "0ac60ac89469a266e4d65265b72fc7f4a839117291d477865c9a1123f1a1dee1"
