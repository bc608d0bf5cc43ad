"""The wheel: what it holds and says of itself, and that it works in another folder; what the package says elsewhere."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
import yaml

import dora
from dora.policies.policy import BUNDLED
from dora.version import source_commit

ROOT = Path(__file__).parents[1]
INSTALL = ROOT / "docs" / "install.md"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def run(*words: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, cwd=cwd, env=os.environ | variables)


def five_lines() -> str:
    """The first block of Python in the README, which uses a trained policy."""
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert found is not None
    return found[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    done = run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT, cwd=folder)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the installed wheel and nothing else; what it depends on is that of this Python."""
    folder = tmp_path_factory.mktemp("installed")
    done = run(
        sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", folder, wheel, cwd=folder
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


def test_the_lines_of_the_readme_are_five() -> None:
    assert len([line for line in five_lines().splitlines() if line]) == 5
    assert "dora.load_policy" in five_lines()


@pytest.mark.slow
def test_the_wheel_holds_policies_objects_robots_and_its_commit(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        said = Parser().parsestr(archive.read(next(n for n in names if n.endswith(".dist-info/METADATA"))).decode())
        assert archive.read("dora/_commit").decode().strip() == source_commit()
    for path in BUNDLED.iterdir():
        assert f"dora/policies/bundled/{path.name}" in names
    assert {"dora/_objects/hammer/object.toml", "dora/_robots/diana7_hit/robot.toml"} <= names
    assert {"dora/_objects/SHA256SUMS", "dora/_robots/SHA256SUMS"} <= names
    assert not any(name.startswith(("tests/", "results/", "docs/")) for name in names)
    assert said["Name"] == PROJECT["name"]
    assert said["Version"] == dora.__version__
    assert said["Author"] == "The Dora authors"


@pytest.mark.slow
def test_the_lines_of_the_readme_work_from_the_wheel_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    code = f"{five_lines()}\nprint(dora.__file__)\nprint(policy.card)\nprint('success', bool(info['success']))"
    done = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(installed))
    assert done.returncode == 0, done.stderr
    assert str(installed) in done.stdout
    assert "what it fails at" in done.stdout
    assert done.stdout.splitlines()[-1] == "success True"


@pytest.mark.slow
def test_the_command_works_from_the_wheel_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    command = installed / "bin" / "dora"
    version = run(command, "--version", cwd=tmp_path, PYTHONPATH=str(installed))
    assert version.stdout == f"dora {dora.__version__} (commit {source_commit()})\n"
    shown = run(command, "run", "--help", cwd=tmp_path, PYTHONPATH=str(installed))
    assert shown.returncode == 0, shown.stderr
    assert "--zero-correction" in shown.stdout


@pytest.mark.slow
def test_the_wheel_works_in_a_virtual_environment(wheel: Path, tmp_path: Path) -> None:
    """As pip installs it, with its command, from an empty folder; what it depends on is that of this Python."""
    place, empty = tmp_path / "venv", tmp_path / "empty"
    empty.mkdir()
    python, alone = place / "bin" / "python", {"PYTHONPATH": ""}
    made = run(sys.executable, "-m", "venv", "--system-site-packages", place, cwd=empty, **alone)
    assert made.returncode == 0, made.stderr
    words = ("-m", "pip", "install", "-q", "--no-deps", "--ignore-installed", wheel)
    done = run(python, *words, cwd=empty, **alone)
    assert done.returncode == 0, done.stderr
    (site,) = place.glob("lib/python*/site-packages")
    if sys.prefix != sys.base_prefix:  # packages of another virtual environment are not the system's
        (site / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    version = run(place / "bin" / "dora", "--version", cwd=empty, **alone)
    assert version.stdout == f"dora {dora.__version__} (commit {source_commit()})\n"
    code = f"{five_lines()}\nprint(dora.__file__)\nprint('success', bool(info['success']))"
    played = run(python, "-c", code, cwd=empty, **alone)
    assert played.returncode == 0, played.stderr
    assert played.stdout.splitlines()[-2:] == [str(site / "dora" / "__init__.py"), "success True"]
    assert not any(empty.iterdir())


def test_the_citation_names_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(citation["version"]) == dora.__version__
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]


def test_python_versions_are_said_once_and_alike() -> None:
    """In classifiers as in what pip checks, and in the README."""
    names = [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if " :: 3." in name]
    low, high = re.findall(r"3\.(\d+)", PROJECT["requires-python"])
    assert names == [f"3.{minor}" for minor in range(int(low), int(high))]
    assert f"Python {', '.join(names[:-1])} or {names[-1]} on Linux" in (ROOT / "README.md").read_text()
    assert f"Linux, Python {', '.join(names[:-1])} or {names[-1]}." in INSTALL.read_text()


def test_the_page_about_installing_names_every_extra() -> None:
    table = INSTALL.read_text().partition("## Extras")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert sorted(name for row in rows for name in re.findall(r"`(\w+)`", row)) == sorted(
        PROJECT["optional-dependencies"]
    )
