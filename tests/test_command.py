"""The command `dora`: help at once, one word per command, completion, and registration when it is needed."""

import importlib
import os
import re
import resource
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from dora import __main__ as command
from dora import errors
from dora.quiet_start import UNREAD, UNWRITTEN, printing
from dora.version import source_commit, version_line

HELP_SECONDS = 0.5
"""Longest time of --help and --version, of the processor [s]."""
IMPORT_SECONDS = 0.5
"""Longest time of `import dora` beyond that of ManiSkill's tasks, of the processor [s]."""
TRIES = 5
"""Tries of which the quickest counts; with the time of the processor, so that other work on the machine does not."""
MODULE = (sys.executable, "-m", "dora")
printed = pytest.mark.parametrize(
    ("words", "unbuffered"), [(("--help",), ""), (("--help",), "1"), (("play", "--help"), "")]
)
"""What Dora and what a command prints, at its end and line by line."""


def run(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, cwd=cwd)


def quickest(*words: str) -> float:
    """Time of the processor of the quickest of some calls [s]."""
    seconds = []
    for _ in range(TRIES):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run(*words).returncode == 0
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(seconds)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_come_at_once(option: str):
    assert quickest(*MODULE, option) < HELP_SECONDS


def test_the_version_names_the_commit():
    shown = run(*MODULE, "--version").stdout.strip()
    assert shown == version_line()
    assert str(source_commit()) in shown


def test_a_wheel_names_the_commit_that_it_was_made_from(tmp_path: Path):
    (tmp_path / "_commit").write_text("0123456789ab\n")
    assert source_commit(tmp_path) == "0123456789ab"


def test_without_git_and_wheel_no_commit_is_named(tmp_path: Path):
    (tmp_path / "dora").mkdir()
    assert source_commit(tmp_path / "dora") is None


def test_every_command_is_listed_and_has_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    assert command.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name, what in command.COMMANDS.items():
        assert name in shown
        assert what in shown
        monkeypatch.setattr(sys, "argv", ["dora"])
        with pytest.raises(SystemExit) as status:
            command.main([name, "--help"])
        assert status.value.code == 0
        assert f"dora {name}" in capsys.readouterr().out


@pytest.mark.parametrize(("typed", "meant"), [("rum", "'run'"), ("grasp", "'grasps'")])
def test_a_typo_gets_a_suggestion(capsys: pytest.CaptureFixture[str], typed: str, meant: str):
    assert command.main([typed]) == command.BAD_INPUT
    assert f"did you mean {meant}" in capsys.readouterr().err


def test_without_a_command_the_usage_is_shown(capsys: pytest.CaptureFixture[str]):
    assert command.main([]) == command.BAD_INPUT
    assert "usage: dora COMMAND" in capsys.readouterr().out


@printed
def test_a_reader_that_goes_away_ends_it_without_a_traceback(words: tuple[str, ...], unbuffered: str):
    """As `dora play --help | head -1`; here nobody reads from the beginning, so that each write fails."""
    reading, writing = os.pipe()
    os.close(reading)
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run([*MODULE, *words], stdout=writing, stderr=subprocess.PIPE, text=True, env=environment)
    os.close(writing)
    assert done.returncode == UNREAD
    assert "Traceback" not in done.stderr
    assert "BrokenPipeError" not in done.stderr


@printed
def test_a_full_disk_under_what_is_printed_ends_it_with_a_sentence(words: tuple[str, ...], unbuffered: str):
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run([*MODULE, *words], stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert done.returncode == UNWRITTEN
    assert done.stderr.splitlines()[-1].startswith("What is printed cannot be written (No space left on device)")
    assert "Traceback" not in done.stderr


def test_something_else_that_cannot_be_written_is_told():
    def full() -> int:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        printing(full)


def test_letters_that_a_terminal_lacks_are_shown_as_escapes():
    code = "import sys; from dora.quiet_start import printing; sys.exit(printing(lambda: print('a ü ─ \\udce9') or 0))"
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == "a \\xfc \\u2500 \\udce9\n", done.stderr


def test_a_pipe_of_something_else_that_breaks_is_told(capfd: pytest.CaptureFixture[str]):
    with pytest.raises(BrokenPipeError, match="of a worker"):
        printing(_broken)


def _broken() -> int:
    raise BrokenPipeError("of a worker")


def test_a_command_runs_in_any_folder(tmp_path: Path):
    """As a process, where Dora registers its tasks only when the command is known."""
    done = run(*MODULE, "run", "--env", "DoraCube-v2", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "DoraCube-v1" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_the_import_adds_little_to_that_of_maniskill():
    code = "import mani_skill.envs, time; start = time.process_time(); import dora; print(time.process_time() - start)"
    assert min(float(run(sys.executable, "-c", code).stdout) for _ in range(TRIES)) < IMPORT_SECONDS


@pytest.mark.slow
def test_the_import_registers_everything_elsewhere(tmp_path: Path):
    """Also in a module that is started by -m, and in a script whose name begins like the command's."""
    body = "import dora, gymnasium as gym; gym.spec('DoraCube-v1'); gym.spec('PickCube-v1'); print('found')"
    for name in ("other", "dora_script"):
        (tmp_path / f"{name}.py").write_text(body)
        assert run(sys.executable, "-m", name, cwd=tmp_path).stdout.endswith("found\n")
    assert run(sys.executable, "dora_script.py", cwd=tmp_path).stdout.endswith("found\n")


SPAWNING = """
import sys
from multiprocessing import get_context

if __name__ == "__main__":
    check = "import dora, gymnasium; gymnasium.spec('DoraCube-v1')"
    child = get_context("spawn").Process(target=exec, args=(check,))
    child.start()
    child.join()
    sys.exit(child.exitcode)
"""
"""A program that looks at the registry in a process of its own."""


@pytest.mark.parametrize("words", [[], pytest.param(["run", "--total-steps", "1000"], marks=pytest.mark.slow)])
def test_the_import_registers_everything_in_a_process_that_a_command_starts(tmp_path: Path, words: list[str]):
    """Whose own command line may be shorter than the arguments that it gets."""
    (tmp_path / "dora").write_text(SPAWNING)
    result = subprocess.run([sys.executable, tmp_path / "dora", *words], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr


SCRIPTS = sorted((Path(command.__file__).parents[1] / "experiments").glob("*.py"))
"""Files of `experiments/`, each of which is a command."""


@pytest.mark.parametrize("script", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_a_script_is_its_command(script: Path, monkeypatch: pytest.MonkeyPatch):
    started = []
    monkeypatch.setattr(command, "start", lambda words: started.append(words) or 3)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as status:
        runpy.run_path(str(script), run_name="__main__")
    assert status.value.code == 3
    assert started == [[script.stem, "--help"]]
    assert script.stem in command.COMMANDS


def test_a_script_answers_signals_before_it_imports_what_does_the_work():
    """So that Ctrl-C during the imports shows a line and no traceback, as with `dora`."""
    shown = run(sys.executable, "-X", "importtime", str(SCRIPTS[0]), "--help").stderr
    imported = [line.rpartition("|")[2].strip() for line in shown.splitlines()]
    assert imported.index("dora.quiet_start") < imported.index("torch")


@pytest.mark.parametrize("shell", command.SHELLS)
def test_completion_knows_commands_and_options(capsys: pytest.CaptureFixture[str], shell: str):
    assert command.main(["--completion", shell]) == 0
    script = capsys.readouterr().out
    for word in (*command.COMMANDS, "zero-correction", "any-region", "num-envs", "pictures"):
        assert word in script


def test_without_maniskill_one_sentence_says_how_to_add_it(tmp_path: Path):
    code = "import sys; sys.modules['mani_skill'] = None; "
    (tmp_path / "dora").write_text(f"{code} from dora.__main__ import start; sys.exit(start(['run']))")
    call = run(sys.executable, str(tmp_path / "dora"))
    assert call.returncode == errors.BAD_INPUT
    assert call.stderr.startswith("ManiSkill is not installed: add it by `pip install --no-deps mani-skill==")
    assert call.stderr.count("\n") == 1
    imported = run(sys.executable, "-c", f"{code} import dora")
    assert "ManiSkillMissingError: ManiSkill is not installed" in imported.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("module", "command"), [("sapien", "run"), pytest.param("torchrl", "bench", marks=pytest.mark.slow)]
)
def test_without_a_library_of_the_system_one_sentence_says_how_to_add_it(tmp_path: Path, module: str, command: str):
    reason = "libX11.so.6: cannot open shared object file: No such file or directory"
    (tmp_path / f"{module}.py").write_text(f"raise ImportError({reason!r})")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); "
    (tmp_path / "dora").write_text(f"{code} from dora.__main__ import start; sys.exit(start([{command!r}, '--help']))")
    call = run(sys.executable, str(tmp_path / "dora"))
    assert call.returncode == errors.BAD_INPUT
    assert call.stderr.splitlines()[-1].startswith(f"A library of the system is missing ({reason})")
    assert "apt-get install libgl1" in call.stderr
    assert "Traceback" not in call.stderr
    if module == "sapien":
        imported = run(sys.executable, "-c", f"{code} import dora")
        assert "LibraryMissingError: A library of the system is missing" in imported.stderr.splitlines()[-1]


def test_a_module_that_is_missing_is_no_library_of_the_system():
    with pytest.raises(ModuleNotFoundError, match="nothing_of_the_kind"), errors.naming_libraries():
        importlib.import_module("nothing_of_the_kind")


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script that completes in bash."""
    path = tmp_path_factory.mktemp("completion") / "dora.bash"
    path.write_text(run(*MODULE, "--completion", "bash").stdout)
    return path


def completed(script: Path, *typed: str) -> list[str]:
    """What bash offers in the place of the last word."""
    words = " ".join(shlex.quote(word) for word in ("dora", *typed))
    ask = (
        f"source {script}; COMP_WORDS=({words}); COMP_CWORD={len(typed)}; COMP_LINE={shlex.quote(words)}; "
        "COMP_POINT=${#COMP_LINE}; $(complete -p dora | sed 's/.*-F \\([^ ]*\\).*/\\1/'); "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    return run("bash", "-c", ask).stdout.split()


@pytest.mark.parametrize(
    ("typed", "wanted"), [(("gr",), "grasps"), (("run", "--zero"), "--zero-correction"), (("bench", "ph"), "physics")]
)
def test_bash_completes_a_command_and_an_option(bash_script: Path, typed: tuple[str, ...], wanted: str):
    assert wanted in completed(bash_script, *typed)


def test_bash_completes_every_measurement_of_bench(bash_script: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        command.main(["bench", "--help"])
    listed = re.search(r"dora bench \[-h\] \{([\w,]+)\}", capsys.readouterr().out)
    assert listed is not None
    offered = {word for word in completed(bash_script, "bench", "") if not word.startswith("-")}
    assert offered == set(listed[1].split(","))


def test_completion_of_an_unknown_shell_is_refused(capsys: pytest.CaptureFixture[str]):
    assert command.main(["--completion", "tsch"]) == command.BAD_INPUT
    assert "bash, zsh, fish" in capsys.readouterr().err


@pytest.mark.parametrize(("returned", "status"), [(None, 0), (0, 0), (3, 3)])
def test_what_a_command_returns_is_its_status(returned: int | None, status: int):
    assert errors.command(lambda: returned)() == status


def test_a_command_says_in_one_line_what_is_wrong_with_its_input(capsys: pytest.CaptureFixture[str]):
    @errors.command
    def refuse(name: str) -> None:
        raise errors.InputError(f"no object {name!r}")

    assert refuse("spoon") == errors.BAD_INPUT == 2
    assert capsys.readouterr() == ("", "no object 'spoon'\n")
    with pytest.raises(ValueError, match="a mistake of ours"):
        errors.command(_mistake)()


def test_a_file_that_cannot_be_looked_at_is_told_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    @errors.command
    def look() -> None:
        (tmp_path / ("x" * 300)).read_text()

    assert look() == errors.BAD_INPUT
    assert capsys.readouterr().err.endswith("cannot be used: File name too long.\n")


def _mistake() -> None:
    raise ValueError("a mistake of ours")
