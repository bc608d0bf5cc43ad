"""What a task's scripted solution makes of other physics settings: success, overlaps, tunnelling and cost."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from dora.errors import InputError, shown
from dora.parallel import one_thread
from dora.sim.grasp_tests.test_scene import Physics
from dora.tasks import find_task, make_task
from dora.tasks.mdp.randomisation import find_preset
from dora.tools.episodes import play_out

MOST_RATE, MOST_ITERATIONS, MOST_OFFSET = 100_000.0, 255, 1.0
"""Largest rate [Hz], number of position iterations [1] (PhysX's limit) and contact offset [m]."""
WHAT = ("rate in Hz", "number of iterations", "contact offset in m")
"""How messages call these."""
MOST_STARTS = 100_000
"""Largest number of starts [1]."""
TUNNELLED = 0.010
"""Overlap that counts as tunnelling: about the radius of a finger or a handle [m]."""


@dataclass(frozen=True)
class PhysicsRow:
    """Outcome of one `Physics`.

    Attributes:
        physics: the settings.
        success: share of the starts that succeed.
        stages: mean number of stages done.
        overlap_median_mm, overlap_p95_mm: median and 95th percentile over the starts of the largest overlap [mm].
        tunnelled: share of starts with an overlap of more than 10 mm.
        microseconds: processor time of one control step of one environment [us].
    """

    physics: Physics
    success: float
    stages: float
    overlap_median_mm: float
    overlap_p95_mm: float
    tunnelled: float
    microseconds: float


def parse_physics(text: str) -> Physics:
    """Settings from `FREQUENCY:OFFSET:ITERATIONS`, in Hz, mm and a number; raises InputError."""
    try:
        frequency, offset, iterations = text.split(":")
        numbers = float(int(frequency)), int(iterations), float(offset) / 1000
    except (ValueError, OverflowError):
        raise InputError(f"{shown(text)} is not FREQUENCY:OFFSET_MM:ITERATIONS, such as 240:10:8") from None
    for number, most, what in zip(numbers, (MOST_RATE, MOST_ITERATIONS, MOST_OFFSET), WHAT, strict=True):
        if not 0 < number <= most:
            raise InputError(f"{text!r} has the {what} {number:g}, which has to be above 0 and at most {most:g}")
    return Physics(rate=numbers[0], position_iterations=numbers[1], contact_offset=numbers[2])


def measure_physics(
    env_id: str,
    settings: Sequence[Physics],
    starts: int = 64,
    preset: str = "none",
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[PhysicsRow]:
    """Execute the uncorrected reference from the same starts under each of the settings.

    Args:
        env_id: a Dora id.
        settings: what to compare; rates must be multiples of the task's control frequency.
        starts: initial states, executed in one batch.
        preset: preset of their randomisation.
        seed: of the initial states.
        progress: called with the settings done and their number.

    Raises:
        InputError: for an unknown id or preset, no start, or a rate that is no multiple of the control's.
    """
    if not 1 <= starts <= MOST_STARTS:
        raise InputError(f"--starts is {starts}; physics is compared on 1 to {MOST_STARTS} starts")
    find_preset(preset)
    control = find_task(env_id).CONFIG().control_frequency
    for physics in settings:
        if physics.rate % control:
            raise InputError(f"{physics.rate:g} Hz is no multiple of the {control} Hz at which {env_id} is controlled")
    rows = []
    for physics in settings:
        progress(len(rows), len(settings))
        rows.append(_executed(env_id, physics, starts, preset, seed))
    progress(len(rows), len(settings))
    return rows


@one_thread()
def _executed(env_id: str, physics: Physics, starts: int, preset: str, seed: int) -> PhysicsRow:
    config = {
        "physics_frequency": int(physics.rate),
        "contact_offset": physics.contact_offset,
        "solver_iterations": physics.position_iterations,
    }
    task = make_task(env_id, starts, preset=preset, config=config)
    try:
        task.reset(seed=seed)
        begun = time.process_time()
        won, _, info = play_out(task, lambda _: torch.zeros(starts, task.action_size))
        spent = time.process_time() - begun
        max_penetration = task.snapshot.max_penetration
    finally:
        task.close()
    median, high = (1000 * max_penetration.quantile(q).item() for q in (0.5, 0.95))
    tunnelled = (max_penetration > TUNNELLED).float().mean().item()
    cost = 1e6 * spent / (starts * task.max_steps)
    success, stage = won.float().mean().item(), info["stage"].float().mean().item()
    return PhysicsRow(physics, success, stage, median, high, tunnelled, cost)
