"""What `dora play`, `dora demos`, `dora report` and `dora view` are asked for, and what they hand on."""

import functools
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import call, load_command, refusal

from dora.affordance.objects.catalogue import load_object
from dora.commands import demos, play, report, view
from dora.datasets.episodes import Plan
from dora.errors import InputError
from dora.live.players import ZERO, Player
from dora.policies.policy import bundled_files, load_policy
from dora.tasks import present_rules


def names(**options: Any) -> list[str]:
    return [player.name for player in play.find_players(play.Args("DoraCube-v1", **options))]


def test_who_is_asked_for_acts_first():
    assert names() == [play.POLICY, ZERO]
    assert names(zero_correction=True) == [ZERO, play.POLICY]


def test_a_task_without_a_policy_is_played_by_the_zero_action(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(play, "bundled_ids", lambda: ["DoraJug-v1"])
    assert play.find_policy("DoraCube-v1", None) is None
    assert names() == names(zero_correction=True) == [ZERO]


def test_a_policy_of_another_task_is_refused(tmp_path: Path):
    (tmp_path / "jug.safetensors").write_bytes(bundled_files("DoraJug-v1")[0].read_bytes())
    with pytest.raises(InputError, match=r"jug\.safetensors is a policy of DoraJug-v1, not of DoraCube-v1"):
        play.find_policy("DoraCube-v1", tmp_path / "jug.safetensors")
    found = play.find_policy("DoraJug-v1", tmp_path / "jug.safetensors")
    assert found is not None
    assert found.card is None, "it is that of the file"
    own = play.find_policy("DoraJug-v1", None)
    assert own is not None
    assert own.card == load_policy("DoraJug-v1").card


def test_a_recording_is_played_first_if_it_is_of_the_task(monkeypatch: pytest.MonkeyPatch):
    recording = SimpleNamespace(env_id="DoraCube-v1")
    monkeypatch.setattr(play.Recording, "open", lambda path: recording)
    monkeypatch.setattr(play, "recorded", lambda found: Player("recording", {}, lambda observation: observation))
    assert names(recording=Path("r.h5")) == ["recording", play.POLICY, ZERO]
    assert names(recording=Path("r.h5"), zero_correction=True) == ["recording", ZERO, play.POLICY]
    recording.env_id = "DoraJug-v1"
    with pytest.raises(InputError, match=r"r\.h5 is of DoraJug-v1, not of DoraCube-v1"):
        names(recording=Path("r.h5"))


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What `dora play` serves or films."""
    served: list[Any] = []
    monkeypatch.setattr(play, "find_players", lambda args: [f"who acts in {args.env}"])
    monkeypatch.setattr(play, "Session", lambda env, players, preset, seed: (env, *players, preset, seed))
    monkeypatch.setattr(play, "serve", lambda session, port, host: served.append((*session, port, host)))
    monkeypatch.setattr(play, "film", lambda args, player: served.append((args.episodes, player)) or args.video)
    return served


def test_a_page_is_served_unless_a_film_is_asked_for(
    served: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    threads = []
    monkeypatch.setattr(play.torch, "set_num_threads", threads.append)
    assert call(play, monkeypatch, "DoraCube-v1", "--seed", "3", "--port", "65535") == 0
    assert call(play, monkeypatch, "DoraJug-v1", "--preset", "none", "--port", "1", "--host", "0.0.0.0") == 0
    film = str(tmp_path / "film.mp4")
    assert call(play, monkeypatch, "DoraJug-v1", "--video", film, "--episodes", "1000") == 0
    assert served == [
        ("DoraCube-v1", "who acts in DoraCube-v1", "standard", 3, 65_535, "127.0.0.1"),
        ("DoraJug-v1", "who acts in DoraJug-v1", "none", 0, 1, "0.0.0.0"),
        (1000, "who acts in DoraJug-v1"),
    ]
    assert threads == [1, 1, 1]
    assert capsys.readouterr().out == f"{film}\n"
    for words, said in (("--episodes 2", "--episodes is the length"), ("--port 65536", "--port is 65536"),
                        (f"--video {film} --episodes 1001", "--episodes is 1001")):  # fmt: skip
        assert said in refusal(play, monkeypatch, capsys, f"DoraCube-v1 {words}")


@pytest.mark.parametrize("breaks", ["session", "page"])
def test_a_page_lasts_until_it_or_its_session_breaks(
    breaks: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    things = {name: SimpleNamespace(error=None, url="http://page") for name in ("session", "page")}

    @contextmanager
    def page(session: Any, port: int, host: str) -> Iterator[Any]:
        yield things["page"]

    slept = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        assert len(slept) <= 3, "it has not noticed"
        if len(slept) == 3:
            things[breaks].error = ValueError("no\nmemory")

    monkeypatch.setattr(play, "served", page)
    monkeypatch.setattr(play, "time", SimpleNamespace(sleep=sleep))
    serve: Any = inspect.unwrap(play.serve)  # whose types are not checked
    with pytest.raises(RuntimeError, match=r"^the page has ended: no\nmemory$"):
        serve(things["session"], 8080, "localhost")
    assert slept == [play.LOOK] * 3
    assert capsys.readouterr().out == "http://page\n"


def test_a_film_is_of_the_policy_in_one_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made: list[Any] = []
    monkeypatch.setattr(play, "can_render", lambda: True)
    monkeypatch.setattr(
        play, "record", lambda make, act, path, episodes, seed: made.append((make, path, episodes, seed))
    )
    player = play.find_players(play.Args("DoraCube-v1"))[0]
    args = play.Args("DoraCube-v1", video=tmp_path / "new" / "cube.mp4", episodes=2, seed=5, preset="hard")
    assert play.film(args, player) == args.video
    ((make, *rest),) = made
    assert rest == [args.video, 2, 5]
    assert isinstance(make, functools.partial)
    assert make.args == ("DoraCube-v1", 1)
    assert (make.keywords["preset"], make.keywords["render_mode"]) == ("hard", "rgb_array")
    assert (tmp_path / "new").is_dir()
    monkeypatch.setattr(play, "can_render", lambda: False)
    with pytest.raises(InputError, match="finds no Vulkan driver"):
        play.film(args, player)


# ------------------------------------------------------------ the other commands


def test_a_report_is_written_where_the_runs_are_unless_another_folder_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked = []

    def written(runs: tuple[Path, ...], out: Path, rules: Any) -> list[Path]:
        asked.append((runs, out, rules))
        return [out / "tables.md", out / "report.html"]

    monkeypatch.setattr(report, "write_report", written)
    assert call(report, monkeypatch, "runs") == 0
    assert capsys.readouterr().out == "runs/tables.md\nruns/report.html\n"
    assert call(report, monkeypatch, "runs", "--out", "here") == 0
    assert call(report, monkeypatch, "runs", "others", "more") == 0
    one, three = (Path("runs"),), (Path("runs"), Path("others"), Path("more"))
    outs = Path("runs"), Path("here"), Path("runs")
    assert asked == [(runs, out, present_rules()) for runs, out in zip((one, one, three), outs, strict=True)]


def test_demonstrations_are_recorded_as_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked, times, threads = [], [100.0, 112.4], []

    def recorded(kind: str, source: Any, plan: Plan, out: Path, pictures: bool, update: Any) -> Any:
        asked.append((kind, source.name, plan, out, pictures))
        update(1, 1)
        return SimpleNamespace(episodes=3, successes=2, steps=1234)

    monkeypatch.setattr(demos, "record_dataset", recorded)
    monkeypatch.setattr(demos, "check_possible", lambda *given: None)
    monkeypatch.setattr(demos, "time", SimpleNamespace(monotonic=lambda: times.pop(0)))
    monkeypatch.setattr(demos.torch, "set_num_threads", threads.append)
    words = ("DoraCube-v1", "--out", str(tmp_path / "out"), "--episodes", "3", "--seed", "7", "--num-envs", "1024")
    assert call(demos, monkeypatch, *words, "--only-successes", "--format", "maniskill") == 0
    assert capsys.readouterr().out == (f"3 episodes, 2 of them a success, 1,234 steps, in 12 s\n{tmp_path / 'out'}\n")
    assert asked == [("maniskill", "scripted", Plan(3, 7, True, 1024), tmp_path / "out", False)]
    assert threads == [1]


def test_what_a_view_shows_is_what_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    mesh = load_object("cube").folder
    assert mesh is not None
    (tmp_path / "cube.ply").write_bytes((mesh / "mesh.ply").read_bytes())
    obj, grasps = view.content(view.Args(str(tmp_path / "cube.ply"), scale=0.5))
    assert grasps is None
    side = load_object("cube").mesh.extents
    assert obj.mesh.extents == pytest.approx(side / 2)
    obj, grasps = view.content(view.Args("cube"))
    assert obj.name == "cube"
    assert grasps is not None
    with pytest.raises(InputError, match="Say what to show"):
        view.content(view.Args())
    assert view.changed(view.Args("jug", port=1, units="mm"), ("labels", "units", "scale", "port")) == ["units", "port"]


@pytest.mark.parametrize("source", ["jug", None])
def test_pictures_are_written_instead_of_a_page(
    source: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    module: Any = load_command("view")
    monkeypatch.setattr(module, "GraspPage", lambda *_: pytest.fail("a page is served"))
    monkeypatch.setattr(module, "write_album", lambda obj, grasps, robot, out: [out / obj.name, out / "maps.png"])
    monkeypatch.setattr(module, "write_objects", lambda out: out / "objects.png")
    words = [source] if source else []
    assert call(module, monkeypatch, *words, "--pictures", str(tmp_path)) == 0
    shown = ["jug", "maps.png"] if source else ["objects.png"]
    assert capsys.readouterr().out.splitlines() == [str(tmp_path / name) for name in shown]
