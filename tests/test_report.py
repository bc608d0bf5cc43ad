"""Reports are made from result files, and say so when there are none."""

import dataclasses
import json
import re
from pathlib import Path

import imageio.v2 as imageio
import pytest

from dora.agents.reports.report import PAGE, pooled, tables, write_report
from dora.agents.reports.run_results import find_runs, grouped, zero_shares
from dora.agents.reports.section import Section
from dora.agents.runs.progress_table import ProgressTable
from dora.errors import InputError
from dora.tables import html_page, with_code


def write_run(
    folder: Path,
    seed: int,
    success: float,
    guidance: str = "affordance",
    finished: bool = True,
    steps: int = 1000,
    env: str = "Toy-v1",
    episodes: int | None = None,
    **task: object,
) -> None:
    folder.mkdir(parents=True)
    result = {
        "env": env, "agent": "ppo", "guidance": guidance, "seed": seed, "env_steps": steps, "wall_seconds": 90.0,
        "success_rate": success, "zero_success_rate": 0.5 if guidance == "affordance" else None,
        "penetration_p95_mm": 2.0, "finished": finished, "task": task,
    }  # fmt: skip
    result |= {} if episodes is None else {"eval_episodes": episodes}
    (folder / "result.json").write_text(json.dumps(result))
    head = "env_steps,wall_seconds,success_rate,return_mean,penetration_p95_mm,training_success_rate"
    (folder / "curve.csv").write_text(f"{head}\n500,45,0.1,3,2,0.1\n1000,90,{success},9,2,0.4\n")


def test_seeds_of_a_group_make_one_row(tmp_path: Path):
    write_run(tmp_path / "a", 0, 0.9)
    write_run(tmp_path / "b", 1, 1.0)
    write_run(tmp_path / "c", 0, 0.2, "none")
    write_run(tmp_path / "d", 2, 0.0, finished=False)
    write_run(tmp_path / "e", 0, 0.4, preset="hard")
    write_run(tmp_path / "f", 0, 0.3, guidance_parts=["observation", "filter", "prior"])
    write_run(tmp_path / "g", 0, 0.7, steps=10_000)
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert rows[0].startswith("| Toy-v1 | hard | PPO | affordance | 1 | **40.0** |")
    assert rows[1].startswith("| Toy-v1 | standard | PPO | affordance | 2 | **95.0** | 90.0, 100.0 | 50.0 |")
    assert rows[2].startswith("| Toy-v1 | standard | PPO | affordance | 1 | **70.0** |")
    assert "| 10k |" in rows[2]
    assert rows[3].startswith("| Toy-v1 | standard | PPO | affordance (observation, filter, prior) | 1 | **30.0** |")
    assert rows[4].startswith("| Toy-v1 | standard | PPO | none | 1 | **20.0** | 20.0 | - |")
    assert len(rows) == 5


def test_runs_of_earlier_rules_of_a_task_stand_apart(tmp_path: Path):
    """A result without a definition is of the first one."""
    for seed, definition in enumerate(({}, {"definition": 1}, {"definition": 2})):
        write_run(tmp_path / str(seed), seed, 0.2 * seed)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": definition}))
    for rules, guidance in (({"Toy-v1": 2}, ["affordance", "affordance, earlier rules"]), ({"Toy-v2": 2}, None)):
        rows = [row.split(" | ")[3:5] for row in tables(find_runs(tmp_path, rules)).splitlines()[2:]]
        if guidance:
            assert rows == [[guidance[0], "1"], [guidance[1], "2"]]
        else:
            assert not any("earlier" in row[0] for row in rows)
    write_report(tmp_path, tmp_path / "out", {"Toy-v1": 2})
    assert "earlier rules': what counts as a success has changed" in (tmp_path / "out" / "tables.md").read_text()


def test_runs_of_tasks_with_other_numbers_are_not_averaged(tmp_path: Path):
    """All that differs is named: rows that differ in more than a switch are not to look like variants of one task."""
    numbers = [
        {"optimised": False, "weights": {"lift": 3.0}, "same": 1},
        {"optimised": False, "weights": {"lift": 3.0}, "same": 1},
        {"optimised": True, "weights": {"lift": 2.0}, "same": 1},
    ]
    for seed, each in enumerate(numbers):
        write_run(tmp_path / str(seed), seed, 0.2 * seed)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": each}))
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert [row.split(" | ")[3:5] for row in rows] == [
        ["affordance, grasp made by hand", "2"], ["affordance, grasps of the search, weights.lift 2.0", "1"],
    ]  # fmt: skip
    path = tmp_path / "1" / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": numbers[0] | {"weights": {"lift": 1.0}}}))
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert [row.split(" | ")[3] for row in rows] == [
        "affordance, grasp made by hand, weights.lift 1.0", "affordance, grasp made by hand, weights.lift 3.0",
        "affordance, grasps of the search, weights.lift 2.0",
    ]  # fmt: skip


def test_what_most_runs_have_goes_without_saying(tmp_path: Path):
    """Only a value that is rarer than another is named; of two that are as frequent both are."""
    usual = {"reorient": "wrist", "weights": {"penetration": -2.0}, "after_overlap": 0.3, "placed_after_overlap": 0.0}
    without = {"weights": {"penetration": 0.0}, "after_overlap": 1.0, "placed_after_overlap": 1.0}
    others = [usual | {"reorient": "in_hand"}, usual | without]
    for seed, each in enumerate([usual, usual, others[0], others[1], others[1]]):
        write_run(tmp_path / str(seed), seed, 0.2 * seed)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": each}))
    terms = r"affordance, after\_overlap 0.3, placed\_after\_overlap 0.0, {}, weights.penetration -2.0"
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert [row.split(" | ")[3:5] for row in rows] == [
        [terms.format("reorient wrist"), "2"], [terms.format("turned in the hand"), "1"],
        ["affordance, reorient wrist, reward without overlap", "2"],
    ]  # fmt: skip
    write_run(tmp_path / "5", 5, 0.5)
    path = tmp_path / "5" / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": usual}))
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert [row.split(" | ")[3:5] for row in rows] == [
        ["affordance", "3"], ["affordance, reward without overlap", "2"], ["affordance, turned in the hand", "1"],
    ]  # fmt: skip


def test_numbers_that_earlier_versions_lacked_make_no_rows_where_they_change_nothing(tmp_path: Path):
    for seed, each in enumerate([{"lift": 0.1}, {"lift": 0.1, "arm_effort": 1.0}, {"lift": 0.1, "arm_effort": 0.5}]):
        write_run(tmp_path / str(seed), seed, 0.5)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": each}))
    rows = tables(find_runs(tmp_path)).splitlines()[2:]
    assert sorted(row.split(" | ")[4] for row in rows) == ["1", "2"]


@pytest.mark.parametrize(("loads", "mark"), [([0.0, 0.1], ""), ([0.05, 0.4], " †"), ([0.0, None], " ?")])
def test_minutes_beside_other_programs_are_marked(tmp_path: Path, loads: list[float | None], mark: str):
    for seed, load in enumerate(loads):
        write_run(tmp_path / str(seed), seed, 0.5)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"other_load": load}))
    assert tables(find_runs(tmp_path)).splitlines()[2].endswith(f"| 1.5 ± 0.0{mark} |")


def test_success_has_the_interval_of_all_episodes_and_zero_correction_that_of_each_start_once(tmp_path: Path):
    write_run(tmp_path / "a", 0, 0.9, episodes=200)
    write_run(tmp_path / "b", 1, 1.0, episodes=200)
    write_run(tmp_path / "c", 0, 0.0, "none", episodes=100)
    runs = find_runs(tmp_path)
    rows = tables(runs).splitlines()[2:]
    assert "| 2 | **95.0 [92.4, 96.7]** | 90.0, 100.0 | 50.0 [43.1, 56.9] | 2.0 ± 0.0 |" in rows[0]
    assert "| 1 | **0.0 [0.0, 3.7]** | 0.0 | - |" in rows[1]
    again = dataclasses.replace(
        runs[0], result=runs[0].result | {"first_seed": 1_500_010_000, "zero_success_rate": 0.6}
    )
    assert zero_shares([*runs, again]) == [(0.5, 200), (0.6, 200)]
    assert pooled(zero_shares([*runs, again])) == "55.0 [50.1, 59.8]"


def test_runs_of_another_reward_and_policies_evaluated_again_have_rows_of_their_own(tmp_path: Path):
    write_run(tmp_path / "a", 0, 0.9)
    for name, key, value in (
        ("b", "reward", "paper"), ("c", "checkpoint", "best.safetensors"), ("d", "overlap_share", 0.1),
    ):  # fmt: skip
        write_run(tmp_path / name, 0, 0.9)
        path = tmp_path / name / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    rows = [row.split(" | ") for row in tables(find_runs(tmp_path)).splitlines()[2:]]
    assert [row[2] for row in rows] == ["PPO", "PPO", "PPO, evaluated again", "PPO, paper's reward"]
    assert [row[3] for row in rows] == ["affordance", "affordance, overlap eased", "affordance", "affordance"]


def test_training_is_drawn_where_runs_have_a_table_of_it(tmp_path: Path):
    for seed, name in enumerate("ab"):
        write_run(tmp_path / "runs" / name, seed, 0.9)
    figure = write_report(tmp_path / "runs", tmp_path / "without")[-1]
    table = ProgressTable(tmp_path / "runs" / "a" / "progress.csv", ["reach"])
    for step in range(10, 1010, 10):
        table.add({"env_steps": step, "episodes": step % 3, "success_rate": step / 1000 if step % 3 else float("nan")})
    drawn = write_report(tmp_path / "runs", tmp_path / "with")[-1]
    heights = [imageio.imread(path).shape[0] for path in (figure, drawn)]
    assert heights[1] > 1.5 * heights[0]


def test_each_sub_task_of_training_has_its_own_curves(tmp_path: Path):
    """In rows of three below the others, also where a run has one more than those beside it."""
    heights = []
    for stages in ((), ("reach",), ("reach", "grasp", "lift", "turn")):
        place = tmp_path / str(len(stages))
        for name, learner, own in (("a", "affordance", stages), ("b", "none", stages[:3])):
            write_run(place / "runs" / name, 0, 0.5, guidance=learner)
            table = ProgressTable(place / "runs" / name / "progress.csv", list(own))
            for step in range(10, 500, 10):
                shares = {f"stage/{each}": step / 500 for each in own}
                table.add({"env_steps": step, "episodes": 1, "success_rate": 0.1} | shares)
        figure = next(path for path in write_report(place / "runs", place / "out") if path.name == "Toy-v1.png")
        heights.append(imageio.imread(figure).shape[0])
    two, three, four = heights
    assert three - two == pytest.approx(four - three, abs=2)
    assert three - two == pytest.approx(two / 2, rel=0.2)


def test_a_report_has_a_table_a_page_and_a_figure(tmp_path: Path):
    write_run(tmp_path / "runs" / "a", 0, 0.9)
    write_run(tmp_path / "runs" / "b", 0, 0.5, preset="hard")
    write_run(tmp_path / "runs" / "c", 0, 0.1, guidance="none")
    paths = write_report(tmp_path / "runs", tmp_path / "out")
    assert {p.name for p in paths} == {"tables.md", "comparison.md", "report.html", "Toy-v1.png", "Toy-v1-hard.png"}
    assert all(p.stat().st_size > 100 for p in paths)
    assert "Toy-v1.png" in (tmp_path / "out" / "report.html").read_text()


def test_code_in_a_note_is_shown_as_code_and_the_rest_is_text():
    assert with_code("see `a<b` & <i>") == "see <code>a&lt;b</code> &amp; &lt;i&gt;"
    assert with_code("a lone ` <b>") == "a lone ` &lt;b&gt;"
    section = Section("`a`", ("`b`",), [], "`c`")
    page = html_page(PAGE, root="runs", head=(), rows=[], note="`d`", figures=[], sections=[section])
    assert all(f"<code>{letter}</code>" in page for letter in "abcd")


def test_no_figure_takes_the_place_of_another(tmp_path: Path):
    """Toy with the preset hard and the task Toy-hard would have the same name."""
    write_run(tmp_path / "runs" / "a", 0, 0.9, preset="hard")
    write_run(tmp_path / "runs" / "b", 0, 0.5, env="Toy-v1-hard")
    names = [path.name for path in write_report(tmp_path / "runs", tmp_path / "out") if path.suffix == ".png"]
    assert len(set(names)) == 2
    assert all(name.startswith("Toy-v1-hard") for name in names)


def test_names_from_files_are_text_in_a_report(tmp_path: Path):
    name = '<script>alert("$1|2")</script>'
    write_run(tmp_path / "runs" / "a", 0, 0.9, env=name)
    table, _, page, figure = write_report(tmp_path / "runs", tmp_path / "out")
    for text in (table.read_text(), page.read_text()):
        assert "<script" not in text
        assert "&lt;script&gt;alert" in text
    assert "1\\|2" in table.read_text()
    assert figure.parent == tmp_path / "out"
    [shown] = re.findall('<img alt="(.*?)" src="data:', page.read_text())
    assert shown == figure.name


def test_no_runs_and_damaged_ones_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no finished run"):
        find_runs(tmp_path)
    (tmp_path / "result.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        find_runs(tmp_path)


@pytest.mark.parametrize(
    "entry",
    [
        {"learner_config": [1]}, {"task_config": "x"}, {"seed": [1]}, {"config_digest": {}}, {"num_envs": {}},
        {"workers": "2"}, {"policy_seed": -1}, {"policy_digest": 1},
    ],
)  # fmt: skip
def test_an_entry_of_another_type_is_named(tmp_path: Path, entry: dict[str, object]):
    for name in ("a", "b"):
        write_run(tmp_path / name, 0, 0.5)
        path = tmp_path / name / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | entry))
    with pytest.raises(InputError, match=rf"result\.json is damaged \({next(iter(entry))} is"):
        write_report(tmp_path, tmp_path / "out")


def test_results_without_a_seed_are_reported(tmp_path: Path):
    for name in ("a", "b"):
        write_run(tmp_path / name, 0, 0.5 if name == "a" else 0.6)
        path = tmp_path / name / "result.json"
        content = json.loads(path.read_text())
        del content["seed"]
        path.write_text(json.dumps(content))
    write_report(tmp_path, tmp_path / "out")
    assert "| 2 |" in (tmp_path / "out" / "tables.md").read_text()


def test_numbers_that_change_nothing_make_no_row_of_their_own(tmp_path: Path):
    """A later version stores how far a hammer is turned in the hand also where it is turned by the wrist."""
    for seed, task in enumerate(({"reorient": "wrist"}, {"reorient": "wrist", "turn": {"least": 0.7}}, {})):
        write_run(tmp_path / str(seed), seed, 0.9)
        path = tmp_path / str(seed) / "result.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"task_config": task}))
    assert [len(runs) for runs in grouped(find_runs(tmp_path)).values()] == [3]
