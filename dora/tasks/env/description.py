"""The tables in force of an environment: observation, stages, reward terms, limits, numbers; as rows, and as text."""

from dataclasses import fields, is_dataclass
from typing import Any

from docstring_parser import parse_from_object

from dora.configs import flat, plain
from dora.tables import text_table

Rows = list[list[str]]
"""Cells of a table, a list for each row; the first row is the head."""


def observation_rows(env: Any) -> Rows:
    """Entries of the observation: columns, name, size, unit, meaning, with what they exist, which stay beside pictures
    when the state is not observed."""
    s, start = env.observed, 0
    rows = [["index", "entry", "size", "unit", "meaning", "exists", "beside pictures"]]
    for name, entry in env.observation_entries.items():
        size = entry.value(s).shape[-1]
        who, stays = "prior" if entry.prior else _with(entry), "yes" if entry.sensed else ""
        rows.append([f"{start}-{start + size - 1}", f"`{name}`", str(size), entry.unit, entry.doc, who, stays])
        start += size
    return rows


def _with(part: Any) -> str:
    """With what guidance a term or entry exists."""
    return "affordance" if part.region else "guided" if part.guided else "always"


def stage_rows(env: Any) -> Rows:
    """The stages with the time for which each has to hold, and where it falls back to."""
    rows = [["stage", "held for [s]", "falls back to"]]
    for stage in env.machine.stages:
        held = f"{max(stage.hold, env.config.dt):g}"
        rows.append([f"`{stage.name}`", held, f"`{stage.back_to}`" if stage.back_to else "never"])
    return rows


def term_rows(env: Any) -> Rows:
    """The reward's terms in force."""
    rows = [["term", "part", "weight", "meaning", "exists"]]
    for name, term in env.terms.terms.items():
        rows.append([f"`{name}`", term.part, f"{term.weight:g}", term.doc, _with(term)])
    return rows


def limit_rows(env: Any) -> Rows:
    """Rates and limits of an episode."""
    c, steps = env.config, env.max_steps
    return [
        ["what", "value"],
        ["control / physics", f"{c.control_frequency} / {c.physics_frequency} Hz"],
        ["episode", f"{steps} steps, {steps * c.dt:g} s"],
        ["solver position iterations", str(c.solver_iterations)],
        ["largest penetration of a success", f"{c.penetration_limit * 1000:g} mm"],
        ["control steps that ranking the candidates took", str(env.ranking_steps or "unknown")],
    ]


def config_rows(env: Any) -> Rows:
    """The numbers in force and what they mean, under the names with which they can be overridden."""
    meanings = dict(flat(_meanings(env.config)))
    rows = ([name, _text(value), meanings.get(name, "")] for name, value in flat(plain(env.config)))
    return [["number", "value", "meaning"], *rows]


def _meanings(config: Any) -> dict[str, Any]:
    """What the docstrings of a configuration say of its fields, by name, nested as the fields are."""
    documented = [cls for cls in reversed(type(config).__mro__) if is_dataclass(cls)]
    texts = {p.arg_name: p.description or "" for cls in documented for p in parse_from_object(cls).params}
    return {
        field.name: _meanings(value) if is_dataclass(value) else " ".join(texts.get(field.name, "").split())
        for field in fields(config)
        for value in (getattr(config, field.name),)
    }


def _text(value: Any) -> str:
    """A number, a switch, a name or several of them, as they are written on the command line."""
    if isinstance(value, list):
        return ", ".join(map(_text, value))
    return str(value) if isinstance(value, bool | str) else f"{value:g}"


TABLES = {
    "stages": stage_rows,
    "reward terms": term_rows,
    "observation": observation_rows,
    "limits": limit_rows,
    "numbers": config_rows,
}
"""What is told about an environment, in order."""


def describe(env: Any) -> str:
    """The tables in force as text."""
    parts = ", ".join(sorted(env.parts)) or "none"
    head = f"{type(env).__name__}: {env.num_envs} environments, guidance {parts}"
    if not hasattr(env, "arms"):
        return head
    sections = [head]
    for title, rows in TABLES.items():
        first, *others = ([cell.replace("`", "") for cell in row] for row in rows(env))
        sections.append(f"{title}\n{text_table(first, others)}")
    return "\n\n".join(sections)
