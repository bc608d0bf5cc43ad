"""Comparing settings of the physics on a task's scripted solution."""

import pytest

from dora.errors import InputError
from dora.sim.grasp_tests.test_scene import Physics
from dora.tools.physics_benchmark import measure_physics, parse_physics


def test_settings_are_read_in_hertz_and_millimetres():
    assert parse_physics("240:2.5:8") == Physics(240.0, 8, contact_offset=0.0025)


@pytest.mark.parametrize("text", ["240:10", "fast:10:8", "240:-1:8", "0:1:8", "240:10:8:1"])
def test_settings_that_make_no_sense_are_refused(text: str):
    with pytest.raises(InputError, match=text):
        parse_physics(text)


@pytest.mark.slow
def test_settings_reach_the_simulation():
    """A coarse solver that sees contacts late lets the cube and the fingers overlap more."""
    seen = []
    fine, coarse = measure_physics(
        "DoraCube-v1", [parse_physics("200:5:12"), parse_physics("40:0.5:1")], 4, progress=lambda *x: seen.append(x)
    )
    assert coarse.overlap_median_mm > 2 * fine.overlap_median_mm
    assert fine.success >= 0.75
    assert fine.microseconds > coarse.microseconds > 0
    assert seen[-1] == (2, 2)


def test_bad_requests_are_refused():
    with pytest.raises(InputError, match="no multiple of the 20 Hz"):
        measure_physics("DoraCube-v1", [parse_physics("110:5:4")], 1)
    with pytest.raises(InputError, match="1 to 100000 starts"):
        measure_physics("DoraCube-v1", [], 0)
    with pytest.raises(InputError, match="DoraCube-v1"):
        measure_physics("DoraCub-v1", [parse_physics("100:5:4")], 1)
