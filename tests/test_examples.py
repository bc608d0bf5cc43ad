"""Every file in `examples/` runs; ManiSkill's `demo_robot` shows the robot, and `demo_random_action` moves it."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from dora.sim import can_render

DEMO = Path(__file__).parent.parent / "examples" / "demo_robot.py"
EXAMPLES = {
    "demo_robot": (["--help"], "--keyframe-actions"),  # it wants a screen: more of it is tried above
    "gymnasium_films": (["--films", "films"], "in a batch: observations (8, 211)"),
    "maniskill_tools": (["--out", "recorded"], "Replayed 1 episodes, 1/1=100.00% demos saved"),
    "own_energy": ([], "with weight 200 the energy is 0."),
    "pettingzoo_arms": (["--episodes", "1"], "agents: left, right; state of"),
    "read_dataset": (["--out", "cube"], " frames at 20 Hz: observation.state, action"),
    "skrl_ppo": (["--steps", "256", "--num-envs", "4", "--episodes", "4"], "after 256 steps: return"),
    "stable_baselines": (["--steps", "256", "--num-envs", "4", "--episodes", "4"], "of 4 episodes"),
    "third_party_task": ([], "4 of 4 palms came to their cubes"),
    "torchrl_collector": (["--num-envs", "4"], "4 episodes, 4 of them a success"),
}
"""Arguments of every example, and something that it prints."""


def run(*arguments: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a new Python process prints."""
    environment = os.environ | environment
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=300, cwd=cwd, env=environment
    )


WITHOUT_SCREEN = """
import runpy, sys
import dora, dora.sim
import mani_skill.render.utils
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import sapien_utils

FRAMES, DRIVER = 8, {driver}

class Window:
    # The only stand-in where there is a driver: a viewer without a window, which ends the programme after some frames.
    frames, paused, env = 0, False, None

    def render(self):
        self.frames += 1
        if self.frames < FRAMES:
            return
        print("steps", int(self.env.elapsed_steps[0]), "moving", float(self.env.agent.robot.qvel.abs().max()) > 0)
        if DRIVER:
            picture = self.env.render_rgb_array()
            print("picture", tuple(picture.shape), "of something", float(picture.float().std()) > 5)
        sys.exit(0)

    def close(self):
        pass

def show(env):
    env._viewer.env = env

sapien_utils.create_viewer = lambda config: Window()
BaseEnv._setup_viewer = show
if not DRIVER:  # what ManiSkill would find out by an error, and what it makes only where it can render
    mani_skill.render.utils.can_render = lambda device: False
    BaseEnv._viewer_camera_config = None
"""
STOCK = "runpy.run_module('mani_skill.examples.demo_robot', run_name='__main__')"
OURS = f"dora.sim.can_render = lambda: True; runpy.run_path({str(DEMO)!r}, run_name='__main__')"


@pytest.mark.parametrize(
    "way", [STOCK, pytest.param(OURS, marks=pytest.mark.slow)], ids=["ManiSkill's module", "our example"]
)
def test_maniskills_demo_shows_the_robot(way):
    """All of `demo_robot` runs but its window, which needs a screen, and without a Vulkan driver its pictures."""
    code = WITHOUT_SCREEN.format(driver=can_render()) + way
    result = run("-c", code, "-r", "diana7_hit", "-k", "home", "--random-actions")
    assert result.returncode == 0, result.stderr
    assert "Selected robot diana7_hit. Control mode: pd_joint_pos" in result.stdout
    assert "Viewing keyframe home" in result.stdout
    assert "steps 6 moving True" in result.stdout  # two frames are drawn before the first step
    assert can_render() == ("of something True" in result.stdout)


def test_every_example_is_run():
    assert {path.stem for path in DEMO.parent.glob("*.py")} == set(EXAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs(name, tmp_path):
    """In a folder of its own, as files may be written there."""
    arguments, printed = EXAMPLES[name]
    result = run(str(DEMO.parent / f"{name}.py"), *arguments, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert printed in result.stdout


@pytest.mark.slow
def test_a_dataset_that_is_read_back_holds_the_frames_of_its_episodes(tmp_path):
    result = run(str(DEMO.parent / "read_dataset.py"), "--out", "cube", cwd=tmp_path)
    (counts,) = re.findall(r"(\d+) episodes, (\d+) frames at 20 Hz", result.stdout)
    steps = [int(count) for count in re.findall(r"seed \d+: (\d+) steps", result.stdout)]
    assert (len(steps), sum(steps)) == tuple(map(int, counts))
    assert min(steps) > 20


@pytest.mark.slow
@pytest.mark.skipif(not can_render(), reason="needs a Vulkan driver: docs/rendering.md")
@pytest.mark.skipif(find_spec("moviepy") is None, reason="RecordVideo needs moviepy: pip install 'gymnasium[other]'")
def test_gymnasium_films_where_there_is_a_driver(tmp_path):
    result = run(str(DEMO.parent / "gymnasium_films.py"), "--films", "films", cwd=tmp_path)
    assert "a film is in films" in result.stdout, result.stderr
    (film,) = (tmp_path / "films").glob("*.mp4")
    assert film.stat().st_size > 1000


@pytest.mark.slow
def test_maniskills_demo_of_random_actions_runs_a_batch(tmp_path):
    words = ("-m", "mani_skill.examples.demo_random_action", "-e", "dora:DoraCube-v1", "-n", "2", "-s", "0")
    result = run(*words, "--render-mode", "none", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "Control mode wrist_delta_hand_pos" in result.stdout
    assert "truncated tensor([True, True])" in result.stdout
    quiet = run(*words, "--quiet", cwd=tmp_path)  # with the render mode of its own, for which there may be no driver
    assert quiet.returncode == 0, quiet.stderr
    assert "reward" not in quiet.stdout


def test_without_a_driver_the_demo_says_so():
    result = run(str(DEMO), VK_ICD_FILENAMES="/dev/null", VK_DRIVER_FILES="/dev/null")
    assert result.returncode == 2
    assert result.stderr.strip().splitlines()[-1].endswith("see docs/rendering.md")
