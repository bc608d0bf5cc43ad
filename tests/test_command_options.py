"""Options out of range are refused in one sentence before any work, by every command."""

import dataclasses
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest
from commands import call, load_command

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.limits import MOST_LAYERS, MOST_TRANSITIONS, WIDEST, check
from dora.errors import InputError

RUN = "--env DoraCube-v1 --agent ppo --workers 0"
RESULTS = Path(__file__).parents[1] / "results" / "tasks" / "DoraCube-v1" / "ppo-affordance-s10"
JUG = Path(__file__).parents[1] / "objects" / "jug" / "grasps.safetensors"
EVALUATION = f"--eval-only --checkpoint {RESULTS}/policy.safetensors"
HUGE = "1" + "0" * 30
NUMBERS = {
    "seed": ("-1", HUGE), "total-steps": ("0", "-5", HUGE), "num-envs": ("0", HUGE), "workers": ("-1", HUGE),
    "learner-threads": ("0", HUGE), "eval-every": ("0", HUGE), "eval-episodes": ("0", HUGE), "episodes": ("0", "10001"),
    "eval-envs": ("0", HUGE), "stop-success": ("2", "-0.1", "nan"), "checkpoint-seconds": ("-1", "nan", "inf"),
    "normaliser-samples": ("-1", HUGE), "learner.rollout": ("0", HUGE), "learner.epochs": ("0", HUGE),
    "learner.minibatch": ("0",), "learner.gamma": ("nan", "-1", "1", "2"), "learner.gae-lambda": ("1.1",),
    "learner.clip": ("0", "inf"), "learner.entropy": ("nan", "1e9"), "learner.value": ("-1",), "learner.bound": ("-1",),
    "learner.grad-norm": ("0",), "learner.learning-rate": ("0", "nan", "1e9"), "learner.learning-rate-min": ("-1",),
    "learner.learning-rate-max": ("inf",), "learner.target-kl": ("0",), "learner.log-std": ("1e9", "nan"),
    "learner.log-std-min": ("-1e9",), "learner.noise-correlation": ("1", "-1"), "learner.hidden": ("0", HUGE),
    "task.lift": ("nan", "-1", "1e300"), "task.control-frequency": ("0", HUGE), "task.physics-frequency": ("0", HUGE),
    "task.solver-iterations": ("0", "256"), "task.randomisation.delay": ("-1", "100000"),
    "task.randomisation.size": ("1", "-1"), "task.randomisation.mass": ("nan",), "task.residual.position": ("-1",),
}  # fmt: skip
"""Options of run.py with values that make no sense."""
CASES = [(name, value) for name, values in NUMBERS.items() for value in values]


def one_sentence(capsys: pytest.CaptureFixture[str], words: str) -> None:
    """The command printed one line about what is wrong, and nothing else."""
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.strip().splitlines()) == 1, printed.err
    assert re.search(words, printed.err), printed.err


@pytest.mark.parametrize(("option", "value"), CASES)
def test_numbers_of_a_run(option: str, value: str):
    with pytest.raises(InputError) as caught:
        load_command("run").parse([*RUN.split(), f"--{option}", value])
    name = option.partition(".")[2].replace("-", "_") or option
    assert name in str(caught.value) or option in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_number_of_a_run_has_a_range():
    """A new setting without a range is noticed here."""
    from dora.agents.config import LEARNER_CONFIGS, RunConfig
    from dora.agents.limits import LEARNER
    from dora.agents.limits import RUN as RANGES

    own = RunConfig("x", "ppo")
    optional = {"stop_success", "after_success"}
    assert {n for n, v in vars(own).items() if type(v) in (int, float)} - optional == set(RANGES) - optional
    for cls in LEARNER_CONFIGS.values():
        assert {n for n, v in vars(cls()).items() if type(v) in (int, float)} <= set(LEARNER)


def test_as_many_transitions_as_are_allowed_are():
    most = RunConfig("x", "ppo", num_envs=1000, workers=0, learner=PPOConfig(rollout=MOST_TRANSITIONS // 1000))
    check(most)
    with pytest.raises(InputError, match="transitions at once"):
        check(dataclasses.replace(most, num_envs=1001))


@pytest.mark.parametrize("hidden", [(1,), (WIDEST,), (1,) * MOST_LAYERS])
def test_as_many_and_as_wide_layers_as_are_allowed_are(hidden: tuple[int, ...]):
    run = RunConfig("x", "ppo", learner=PPOConfig(hidden=hidden))
    check(run)
    for wrong in ((*hidden[1:], 0), (*hidden[1:], WIDEST + 1), (1,) * (MOST_LAYERS + 1)):
        with pytest.raises(InputError, match=r"--learner.hidden has to be"):
            check(dataclasses.replace(run, learner=PPOConfig(hidden=wrong)))


def test_transitions_of_an_iteration_are_bounded():
    with pytest.raises(InputError, match="transitions at once"):
        load_command("run").parse([*RUN.split(), "--num-envs", "100000", "--learner.rollout", "100000"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{RUN} --stop-success 2", "--stop-success is 2.0 and has to be from 0 to 1"),
        ("--evn DoraCube-v1", "add --env instead of --evn"),
        ("--env DoraCub-v1", "did you mean 'DoraCube-v1'"),
        (f"{EVALUATION} --num-envs 7", "--num-envs has no effect on an evaluation"),
        (f"{EVALUATION} --learner-threads 7", "--learner-threads has no effect on an evaluation"),
        (f"{EVALUATION} --collector ray", "--collector has no effect on an evaluation"),
        (f"{RUN} --learner.learning-rate-min 1e-2", "--learner.learning-rate-min is 0.01 and"),
        (f"{RUN} --learner.log-std -4", "--learner.log-std-min is -3.0 and --learner.log-std -4.0: the first"),
        (f"{RUN} --agent sac --learner.capacity 1", "--learner.capacity is 1, and an iteration"),
        (f"{RUN} --preset standrd", "did you mean 'standard'"),
        (f"{RUN} --agent sacc", "use --agent with one of"),
        (f"{RUN} --collector ray", "--collector ray needs workers, and --workers is 0"),
        ("--resume x --out y", "--out does not go with --resume"),
        ("--resume x --eval-only", "--eval-only does not go with --resume"),
        (f"{RUN} --out {RESULTS}", "holds a run already"),
        (f"{RUN} --out {RESULTS}/result.json", "nothing can be written|holds a run|Cannot make"),
        (f"{RUN} --out /proc/nope/run", "Cannot make the run folder"),
        (f"--eval-only --checkpoint {RESULTS}/policy.safetensors --out {RESULTS}", "holds a run already"),
        (f"--eval-only --zero-correction --env DoraCube-v1 --out {RESULTS}", "holds a run already"),
    ],
)
def test_runs_are_refused_at_once(
    words: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    command = load_command("run")
    monkeypatch.setattr(command, "task_maker", lambda config: pytest.fail("work has begun"))
    assert call(command, monkeypatch, *words.split()) == 2
    one_sentence(capsys, message)


def test_a_folder_of_checkpoints_holds_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "checkpoints").mkdir()
    shutil.copy(RESULTS / "policy.safetensors", tmp_path / "checkpoints" / "best.safetensors")
    command = load_command("run")
    monkeypatch.setattr(command, "task_maker", lambda config: pytest.fail("work has begun"))
    words = ["--eval-only", "--checkpoint", str(tmp_path), "--out", str(tmp_path)]
    assert call(command, monkeypatch, *words) == 2
    one_sentence(capsys, "holds a run already")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--object cube --seed -1 --num 8 --baselines 0", "--seed is -1"),
        (f"--object cube --seed {HUGE}", "--seed"),
        ("--object cube --num 0", "--num is 0"),
        (f"--object cube --num {HUGE}", "--num"),
        ("--object cube --baselines -1", "--baselines is -1"),
        ("--object cube --by-region -1", "--by-region is -1"),
        ("--object cube --by-region 5", "give --validate sapien"),
        ("--mesh x.stl --scale nan", "--scale is nan"),
        ("--mesh x.stl --scale -1", "--scale is -1.0"),
        ("--mesh x.stl --scale 1e300", "--scale is 1e"),
        ("--object cub", "did you mean 'cube'"),
        ("--object cube --robot nothing", "unknown robot 'nothing'"),
        ("--object cube --region nothing", "no region 'nothing'"),
        ("--make-bundle --object cube --seed -1", "--seed is -1"),
        ("--object cube --out /proc/nope/a.safetensors", "Cannot write into"),
    ],
)
def test_searches(words: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    command = load_command("grasps")
    monkeypatch.setattr(command, "generate", lambda *_, **__: pytest.fail("work has begun"))
    monkeypatch.setattr(command, "make_bundle", lambda *_, **__: pytest.fail("work has begun"))
    assert call(command, monkeypatch, *words.split()) == 2
    one_sentence(capsys, message)


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("view", "jug --port 70000", "--port is 70000"),
        ("view", "jug --port 0", "--port is 0"),
        ("view", "x.stl --scale nan", "--scale is nan"),
        ("view", "jug --scale 2", "belong to a mesh"),
        ("view", "jug --mesh x.stl", "--mesh belongs to a file of grasps"),
        ("view", f"{JUG} --units mm --scale 3", "belong to --mesh"),
        ("view", f"{JUG} --labels nope.yaml", "belong to --mesh"),
        ("view", "--pictures /proc/nope --mesh x.stl", "--mesh has no effect"),
        ("view", "--pictures /proc/nope --labels x.yaml", "--labels has no effect"),
        ("view", "--pictures /proc/nope --units mm", "--units has no effect"),
        ("play", "DoraCube-v1 --video film.xyz", "let it end in one of .mp4"),
        ("play", "DoraCube-v1 --video film", "let it end in one of .mp4"),
        ("play", "DoraCube-v1 --episodes 3", "give --video"),
        ("sweep", "--address ray://x:1 --dry-run", "add --launcher ray"),
        ("view", "jug --host nowhere.invalid", "--host is 'nowhere.invalid'"),
        ("view", "jug --host 192.0.2.1", "--host is '192.0.2.1', which is no address of this machine"),
        ("view", "jug --pictures /proc/nope", "Cannot make the folder"),
        ("bench", "env --seconds nan", "--seconds is nan"),
        ("bench", "env --seconds -1", "--seconds is -1"),
        ("bench", "env --seconds inf", "--seconds is inf"),
        ("bench", "env --num-envs 0", "--num-envs is 0"),
        ("bench", f"env --num-envs {HUGE}", "--num-envs"),
        ("bench", "env --workers -1", "--workers is -1"),
        ("bench", f"env --workers {HUGE}", "--workers"),
        ("bench", "env --env PickCub-v1", "did you mean 'PickCube-v1'"),
        ("bench", "filter --episodes 0", "--episodes is 0"),
        ("bench", f"filter --episodes {HUGE}", "--episodes"),
        ("bench", "filter DoraHammer-v1 --policy", "no task of one arm with a table of f_reach"),
        ("bench", "filter DoraCub-v1", "did you mean 'DoraCube-v1'"),
        ("bench", "page --seconds 0", "--seconds is 0"),
        ("bench", "learner --seconds 0", "--seconds is 0"),
        ("bench", "learner --seconds nan", "--seconds is nan"),
        ("bench", "page DoraCub-v1", "did you mean 'DoraCube-v1'"),
        ("bench", "grasp --object cub", "did you mean 'cube'"),
        ("bench", "grasp --robot nothing", "unknown robot"),
        ("bench", "physics --starts 0", "--starts is 0"),
        ("bench", f"physics --starts {HUGE}", "--starts"),
        ("bench", "physics --settings 240:nan:8", "contact offset"),
        ("bench", "physics --settings", "at least one FREQUENCY"),
        ("bench", "physics --settings 240:10:1000", "number of iterations 1000"),
        ("bench", f"physics --settings {HUGE}:10:8", "rate in Hz"),
        ("bench", "physics --settings 240:10", "is not FREQUENCY"),
        ("bench", "physics --preset nothing", "unknown preset"),
        ("bench", "physics --env nothing", "unknown environment"),
        ("report", "/nowhere", "no finished run"),
        ("report", f"{RESULTS} --out {RESULTS}/result.json", "Cannot make the folder"),
        ("report", f"{RESULTS} --out /proc/nope", "Cannot make the folder"),
    ],
)
def test_other_commands(
    command: str, words: str, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    body = load_command(command)
    if command == "view":
        monkeypatch.setattr(body, "threading", SimpleNamespace(Event=lambda: pytest.fail("the page is there")))
    if command == "play":
        monkeypatch.setattr(body, "find_players", lambda args: pytest.fail("work has begun"))
    if command == "bench":
        monkeypatch.setattr(sys, "argv", ["bench", *words.split()])
        assert body.main() == 2
    else:
        assert call(body, monkeypatch, *words.split()) == 2
    one_sentence(capsys, message)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"guidnce": "none"}, "did you mean 'guidance'"),
        ({"num_envs": 10**9}, "num_envs must be a whole number from 1 to 100000"),
        ({"config": {"lfit": 0.1}}, "did you mean 'lift'"),
        ({"config": {"randomisation": {"friction": (2.0, 1.0)}}}, "lowest and a highest"),
        ({"preset": "hrd"}, "did you mean 'hard'"),
    ],
)
def test_keywords_of_a_task(options: dict, message: str):
    with pytest.raises(InputError, match=message):
        gym.make("DoraCube-v1", **options)


@pytest.mark.parametrize("damaged", [False, True])
def test_a_cache_is_done_without(damaged: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One that cannot be written, and one with a damaged file."""
    import trimesh

    from dora.affordance.objects import decomposition

    box = trimesh.creation.box((0.1, 0.1, 0.1))
    made = []
    monkeypatch.setattr(decomposition, "_run", lambda mesh, threshold: made.append(1) or [box])
    monkeypatch.setenv("DORA_CACHE", str(tmp_path) if damaged else "/proc/nope")
    for count in (1, 2):
        assert len(decomposition.decompose(box)) == 1
        assert len(made) == count
        for path in tmp_path.rglob("*.safetensors"):
            path.write_bytes(path.read_bytes()[:-1])
