"""Several arms as one: the spaces of their actions."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dora.tasks.env.arm_group import ArmGroup


@pytest.mark.parametrize(("num_envs", "shape"), [(1, (5,)), (3, (3, 5))])
def test_actions_of_all_arms_are_from_minus_one_to_one(num_envs: int, shape: tuple[int, ...]):
    arms: Any = {"left": SimpleNamespace(action_size=3), "right": SimpleNamespace(action_size=2)}
    single, batch = ArmGroup(arms).action_spaces(num_envs)
    for space, expected in ((single, (5,)), (batch, shape)):
        assert space.shape == expected
        assert space.dtype == np.float32
        np.testing.assert_array_equal(space.low, -np.ones(expected))
        np.testing.assert_array_equal(space.high, np.ones(expected))
