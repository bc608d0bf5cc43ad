"""The benchmark of environments works for ids of ManiSkill, too, on a machine without a Vulkan driver."""

import json

import pytest
from pictures import run_without_driver


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
