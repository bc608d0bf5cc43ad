"""Adding a task is one file, one object folder with its grasps, and one page: toy tasks are added so, and tested."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from live import free_port

from dora.affordance.candidates import hand_digest
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.importing import import_object
from dora.robot import load_robot
from dora.tasks.cube import hand_made_candidates

TOYS = Path(__file__).parent / "toys"
"""Files of toy tasks."""
EDGE = 0.06
"""Edge of the block [m]."""
PLUGIN = '''"""Puts the toy tasks beside the others, as if their files were in dora/tasks/."""

def pytest_sessionstart():
    import dora.tasks

    dora.tasks.__path__.append({folder!r})
    dora.tasks.discover()
'''
"""A module that pytest loads, and whose function a program can call."""
PAGE = "# Block\n\n<!-- generated: begin -->\n<!-- generated: end -->\n"
"""A page before its tables are written."""


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> tuple[Path, dict[str, str]]:
    """Folder of what was added, and the environment of a process that sees it."""
    root = tmp_path_factory.mktemp("added")
    shutil.copytree(TOYS, root / "tasks", ignore=shutil.ignore_patterns("__pycache__"))
    trimesh.creation.box((EDGE,) * 3).export(root / "block.stl")
    block = import_object(root / "block.stl", mass=0.12)
    write_object_folder(block, root / "objects" / "block")
    robot, block = load_robot("diana7_hit"), load_object(root / "objects" / "block")
    grasps = hand_made_candidates("block")
    fits = {"digest": block.digest, "robot": robot.name, "robot_digest": hand_digest(robot)}
    replace(grasps, **fits).save(root / "objects" / "block" / "grasps.safetensors")
    (root / "plugin").mkdir()
    (root / "plugin" / "toy_plugin.py").write_text(PLUGIN.format(folder=str(root / "tasks")))
    paths = os.pathsep.join([str(root / "plugin"), str(project_root), os.environ.get("PYTHONPATH", "")])
    return root, os.environ | {"PYTHONPATH": paths, "DORA_OBJECTS": str(root / "objects")}


@pytest.mark.slow
@pytest.mark.parametrize("toy", ["DoraBlock", "DoraPair"])
def test_all_tests_of_tasks_pass_on_it(added: tuple[Path, dict[str, str]], project_root: Path, toy: str):
    """The second one has two arms that stand opposite each other, and two objects."""
    options = ["-p", "toy_plugin", "-p", "no:cacheprovider", "-n", "0", "-m", "", "-k", toy, "tests/test_tasks.py"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options], cwd=project_root, env=added[1], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:]
    count = int(done.stdout.split(" passed")[0].split()[-1])
    assert count >= 17, done.stdout[-500:]


@pytest.mark.slow
def test_its_page_and_its_settings_follow_from_the_file(added: tuple[Path, dict[str, str]]):
    root, env = added
    page = root / "block.md"
    page.write_text(PAGE)
    program = f"""
import toy_plugin
toy_plugin.pytest_sessionstart()
from pathlib import Path
from dora.commands.run import parse
from dora.tasks import make_task
from dora.tools.task_pages import refreshed, tables
task = make_task("DoraBlock-v1", 1)
page = Path({str(page)!r})
page.write_text(refreshed(page.read_text(), tables(task)))
config = parse(["--env", "DoraBlock-v1", "--task.lift", "0.12"]).run
print(config.agent, config.task["lift"])
"""
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, text=True)
    assert done.stdout.split() == ["ppo", "0.12"], done.stderr[-2000:]
    text = page.read_text()
    assert "| `lift` | task | 3 |" in text
    assert "`tips_in_block`" in text
    assert "| lift | 0.1 |" in text


def test_options_that_do_not_fit_two_arms_are_refused(added: tuple[Path, dict[str, str]]):
    program = """
import toy_plugin
toy_plugin.pytest_sessionstart()
from dora.affordance.bundled_sets import load_candidates
from dora.tasks import make_task
for options in {"grasps": load_candidates("cube")}, {"robot_uids": ("diana7_hit",)}:
    try:
        make_task("DoraPair-v1", 1, **options)
    except ValueError as error:
        print(type(error).__name__, error)
"""
    done = subprocess.run([sys.executable, "-c", program], env=added[1], capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert [line.partition(" ")[0] for line in lines] == ["InputError"] * 2, done.stderr[-2000:]
    assert "grasps must be a dictionary by arm, and there are left, right" in lines[0]
    assert "one robot for each of 2 arms, not 1" in lines[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("toy", "shown"),
    [
        ("DoraBlock-v1", "['arm'] ['block'] ['x', 'y', 'yaw'] 4"),
        ("DoraPair-v1", "['left', 'right'] ['jug', 'cube'] [] 0"),
    ],
)
def test_it_can_be_watched_live_without_a_further_line(added: tuple[Path, dict[str, str]], toy: str, shown: str):
    """With two arms neither starts nor candidates can be chosen."""
    program = f"""
import toy_plugin
toy_plugin.pytest_sessionstart()
from dora.live.page import Page
from dora.live.players import zero_correction
from dora.live.session import Session
session = Session({toy!r}, [zero_correction({{}})], preset="none", clock=iter(range(1000)).__next__)
page = Page(session, {free_port()})
while session.state.episode.step < 5:
    session.turn()
page.update()
state = session.state
for arm, goal in state.goals.items():
    assert abs(page.view._ghosts[arm].frame.position - goal.wrist[:3]).max() < 1e-6
print(list(state.goals), list(state.objects), [n.name for n in state.setup.numbers], len(state.setup.candidates))
page.stop()
"""
    done = subprocess.run([sys.executable, "-c", program], env=added[1], capture_output=True, text=True)
    assert shown in done.stdout, done.stderr[-2000:]
