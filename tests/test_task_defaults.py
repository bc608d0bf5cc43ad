"""What a task gets where its class says nothing itself."""

from types import SimpleNamespace
from typing import Any

import pytest

from dora.tasks.env.task import Task
from dora.tasks.guidance.grasp_and_lift import GraspReference, GraspSettings


@pytest.mark.parametrize(
    ("given", "hover"), [({}, 0.0), ({"reference": GraspSettings(hover=0.06)}, 0.06), ({"reference": "another"}, 0.0)]
)
def test_the_reference_has_the_numbers_of_the_configuration(given: dict[str, Any], hover: float):
    task: Any = SimpleNamespace(config=SimpleNamespace(dt=0.05, **given))
    scene: Any = SimpleNamespace(num_envs=2, device="cpu")
    reference: Any = Task.make_reference(task, scene, "arm")
    assert isinstance(reference, GraspReference)
    assert reference.hover == hover
    assert reference.dt == 0.05
