"""How a session stands, as HTML: verdict, stages, time, what was finished so far, what could not be done."""

from __future__ import annotations

from html import escape

from dora.live.state import LiveState

GOOD, BAD, ACTIVE, QUIET = "#2b8a3e", "#c92a2a", "#1971c2", "#868e96"
"""Colours of what is done or succeeds, of what has failed, of what is under way, and of the rest."""


def status(state: LiveState) -> str:
    """HTML about a state; text of others is escaped."""
    episode, setup = state.episode, state.setup
    colour = GOOD if episode.success else BAD if episode.over else ACTIVE
    ladders = map(_ladder, setup.ladders, episode.stages)
    rate = f"{state.rate:.2f} of real time" if state.rate else "stands still"
    lines = [
        f'<div style="color: {colour}; font-weight: 700">{escape(episode.verdict)}</div>',
        *(f"<div>{ladder}</div>" for ladder in ladders),
        f"<div>{episode.time:.2f} s of {setup.max_steps * setup.dt:.0f} s, seed {episode.seed}, {rate}</div>",
        f"<div>{state.successes} of {state.episodes} episodes succeeded; {escape(_candidates(state))}</div>",
    ]
    if state.message:
        lines.append(f'<div style="color: {BAD}">{escape(state.message)}</div>')
    return f'<div style="padding: 0.3em 1em; line-height: 1.6; font-size: 0.9em">{"".join(lines)}</div>'


def _ladder(stages: tuple[str, ...], active: int) -> str:
    """The stages of one arm, or of all: those done, the active one, and the rest."""
    colours = [GOOD if k < active else ACTIVE if k == active else QUIET for k in range(len(stages))]
    return "".join(map(_box, stages, colours))


def _box(text: str, colour: str) -> str:
    style = f"background: {colour}; color: white; border-radius: 3px; padding: 0 0.5em; margin-right: 0.3em"
    return f'<span style="{style}">{escape(text)}</span>'


def _candidates(state: LiveState) -> str:
    """The chosen candidate, and how many can be reached."""
    names, episode = state.setup.candidates, state.episode
    if not names:
        return f"candidates {', '.join(str(index) for index in episode.chosen.values())}"
    (chosen,) = episode.chosen.values()
    return f"candidate {names[chosen]}; {len(episode.reachable)} of {len(names)} can be reached"
