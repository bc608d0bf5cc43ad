"""The benchmark of environments works for ids of ManiSkill, too, on a machine without a Vulkan driver."""

import json

import gymnasium as gym
import pytest
from pictures import run_without_driver

from dora.errors import InputError
from dora.tools.env_benchmark import _Measurement


@pytest.mark.slow
def test_a_stock_id_is_measured_without_a_driver():
    arguments = ["env", "--env", "PickCube-v1", "--num-envs", "4", "--workers", "1", "--seconds", "0.5", "--json"]
    program = f"""
import sys
from dora.commands.bench import main
if __name__ == "__main__":
    sys.argv[1:] = {arguments!r}
    main()
"""
    result = run_without_driver(program)
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout.splitlines()[-1])
    assert report["env_steps_per_second"] > 0
    assert report["reference_env_steps_per_second"] > 0
    assert sum(report["shares"].values()) == pytest.approx(1, abs=0.01)


def test_files_that_are_missing_are_named_where_nobody_answers(monkeypatch: pytest.MonkeyPatch):
    """ManiSkill asks whether to fetch them."""

    def ask(*_: object, **__: object) -> None:
        raise EOFError("EOF when reading a line")

    monkeypatch.setattr(gym, "make", ask)
    with pytest.raises(InputError, match=r"python -m mani_skill.utils.download_asset OpenCabinetDrawer-v1"):
        _Measurement("OpenCabinetDrawer-v1", "state", 2, 1.0, None)
