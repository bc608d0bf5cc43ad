"""Named rows of environments: written in place, cleared, saved and restored by rows."""

import pytest
import torch

from dora.tasks.mdp.buffers import Buffers


@pytest.fixture
def buffers() -> Buffers:
    made = Buffers(3, "cpu", depth=(), pose=(2, 2))
    made.update(depth=torch.tensor([1.0, 2.0, 3.0]), pose=torch.arange(12.0).reshape(3, 2, 2))
    return made


def test_they_begin_at_zero():
    made = Buffers(3, "cpu", depth=(), pose=(2, 2))
    assert made.names == ("depth", "pose")
    assert made.depth.tolist() == [0.0] * 3
    assert made.pose.shape == (3, 2, 2)
    assert "depth" in made
    assert "speed" not in made


def test_they_are_written_in_place(buffers: Buffers):
    depth = buffers.depth
    buffers.update(depth=torch.tensor([4.0, 5.0, 6.0]))
    buffers.write(torch.tensor([0, 2]), depth=7.0, pose=torch.ones(2, 2, 2))
    assert depth.tolist() == [7.0, 5.0, 7.0]
    assert buffers.pose[1].tolist() == [[4.0, 5.0], [6.0, 7.0]]
    assert buffers.pose[[0, 2]].eq(1).all()
    with pytest.raises(AttributeError, match=r"'depth' is written in place"):
        buffers.depth = depth
    with pytest.raises(AttributeError, match="no buffer 'speed'; there are depth, pose"):
        _ = buffers.speed


def test_only_the_rows_that_are_named_are_cleared(buffers: Buffers):
    buffers.clear(torch.tensor([1]))
    assert buffers.depth.tolist() == [1.0, 0.0, 3.0]
    assert buffers.pose.sum((1, 2)).tolist() == [6.0, 0.0, 38.0]


def test_a_state_is_a_copy_and_comes_back_by_rows(buffers: Buffers):
    state = buffers.get_state()
    buffers.clear(torch.tensor([0, 1, 2]))
    assert state["depth"].tolist() == [1.0, 2.0, 3.0]
    rows = torch.tensor([2, 0])
    buffers.set_state({"depth": state["depth"][rows, None], "pose": state["pose"][rows].flatten(1)}, rows)
    assert buffers.depth.tolist() == [1.0, 0.0, 3.0]
    assert buffers.pose[0].tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert not buffers.pose[1].any()
    buffers.set_state(state, slice(None))
    assert torch.equal(buffers.pose, state["pose"])
