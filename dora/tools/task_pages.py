"""Tables of tasks and presets, written from the code: `python -m dora.tools.task_pages` refreshes docs/.

Each page keeps its hand-written part; what stands between the two marks is replaced.
"""

import sys
from pathlib import Path

from dora.tables import markdown_table
from dora.tasks import make_task, task_ids
from dora.tasks.env.description import config_rows, limit_rows, observation_rows, stage_rows, term_rows
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.task import short_name
from dora.tasks.mdp.randomisation import PRESETS

BEGIN, END = "<!-- generated: begin -->", "<!-- generated: end -->"
"""Marks on a page between which its generated part stands."""


TITLES = {
    "Observation ({size} numbers with guidance)": observation_rows,
    "Action ({actions} numbers in [-1, 1])": None,
    "Stages": stage_rows,
    "Reward terms": term_rows,
    "Limits": limit_rows,
    "Numbers": config_rows,
}
"""Sections of a page; the action is told in words."""
ACTION = (
    "0-2 wrist translation, 3-5 wrist rotation, then hand joints thumb to pinky. With guidance: the residual action on "
    "the reference, in units of its bounds, in the hand frame."
)
"""What an action is."""


def tables(task: DoraEnv) -> str:
    """Markdown tables of observation, action, stages, reward terms, limits and numbers of a guided task."""
    size = task.single_observation_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
    sections = []
    for title, rows in TITLES.items():
        sections.append(f"### {title.format(size=size, actions=task.action_size)}")
        if rows is None:
            sections.append(ACTION)
        else:
            head, *body = rows(task)
            sections.append(markdown_table(head, body))
    return "\n\n".join(sections)


def _plus_minus(value: float, unit: str, factor: float = 1.0) -> str:
    return f"+-{factor * value:g}{unit}" if value else "none"


def preset_table() -> str:
    """Markdown table of all presets."""
    delays = [f"{p.delay} control step{'s' * (p.delay > 1)}" if p.delay else "none" for p in PRESETS.values()]
    pushes = [f"{p.push:g} N s, {p.push_rate:g} a second" if p.push else "none" for p in PRESETS.values()]
    rows = {
        "size": [_plus_minus(p.size, " %", 100.0) for p in PRESETS.values()],
        "mass": [_plus_minus(p.mass, " %", 100.0) for p in PRESETS.values()],
        "friction": [
            f"{low:g} to {high:g}" if low < high else f"{low:g}" for p in PRESETS.values() for low, high in [p.friction]
        ],
        "candidate: position": [_plus_minus(p.candidate_position, " mm", 1000.0) for p in PRESETS.values()],
        "candidate: orientation": [_plus_minus(p.candidate_rotation, " rad") for p in PRESETS.values()],
        "candidate: finger joints": [_plus_minus(p.candidate_joint, " rad") for p in PRESETS.values()],
        "observed object position": [_plus_minus(p.observed_position, " mm", 1000.0) for p in PRESETS.values()],
        "observed object orientation": [_plus_minus(p.observed_rotation, " rad") for p in PRESETS.values()],
        "observed hand joints": [_plus_minus(p.observed_joint, " rad") for p in PRESETS.values()],
        "delay of the action": delays,
        "pushes": pushes,
    }
    names = [f"`{name}`" for name in PRESETS]
    return markdown_table(["what", *names], [[what, *values] for what, values in rows.items()])


def refreshed(page: str, generated: str) -> str:
    """The page with its generated part replaced; ValueError if the marks are missing."""
    head, mark, rest = page.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"the page lacks the marks {BEGIN} and {END}")
    return f"{head}{BEGIN}\n\n{generated}\n\n{END}{tail}"


def page_of(env_id: str, docs: Path) -> Path:
    """Path of the page of a Dora id: DoraCube-v1 -> docs/tasks/cube.md."""
    return docs / "tasks" / f"{short_name(env_id)}.md"


def main(docs: Path) -> None:
    """Refreshes the page of every registered task, and the presets on the page about guidance."""
    page = docs / "guidance.md"
    page.write_text(refreshed(page.read_text(), preset_table()))
    for env_id in task_ids():
        task = make_task(env_id, 1, sim_backend="physx_cpu")
        path = page_of(env_id, docs)
        path.write_text(refreshed(path.read_text(), tables(task)))
        task.close()
        print(f"{path}: {env_id}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs"))
