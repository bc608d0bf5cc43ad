"""Draws docs/images/architecture.svg: `python docs/architecture_picture.py [FILE]`, needs matplotlib only.

Coordinates are pixels of a picture 900 wide, y downwards.
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

WIDTH, HEIGHT = 900, 1020
"""Size of the picture [pixels]."""
DPI = 100
"""Pixels per inch."""
LINE = 15
"""Distance of two lines of text [pixels]."""
INK, GREY = "#1d2733", "#5b6875"
"""Colours of names, and of everything that is said about them."""
OFFLINE, COMMAND, WORLD, READING, JUDGING = "#fff1d6", "#dcebff", "#e4e4e4", "#dff3e1", "#f3e2f5"
"""Colours of the boxes: made once, on the way to the motors, physics, on the way back, the MDP."""


@dataclass(frozen=True)
class Box:
    """A box with its middle at (x, y) [pixels]: names of the code above, words below."""

    x: float
    y: float
    width: float
    names: tuple[str, ...]
    words: tuple[str, ...]
    colour: str

    @property
    def height(self) -> float:
        """Height that the text needs [pixels]."""
        return LINE * (len(self.names) + len(self.words)) + 12

    @property
    def left(self) -> tuple[float, float]:
        """Middle of the left edge."""
        return self.x - self.width / 2, self.y

    @property
    def right(self) -> tuple[float, float]:
        """Middle of the right edge."""
        return self.x + self.width / 2, self.y

    @property
    def top(self) -> tuple[float, float]:
        """Middle of the upper edge."""
        return self.x, self.y - self.height / 2

    @property
    def bottom(self) -> tuple[float, float]:
        """Middle of the lower edge."""
        return self.x, self.y + self.height / 2


def draw_box(axes: Any, box: Box) -> None:
    """The box with its text."""
    corner = box.x - box.width / 2, box.y - box.height / 2
    style = "round,pad=0,rounding_size=6"
    axes.add_patch(
        FancyBboxPatch(corner, box.width, box.height, boxstyle=style, facecolor=box.colour, edgecolor=GREY, lw=0.8)
    )
    y = corner[1] + 6 + LINE / 2
    for k, line in enumerate((*box.names, *box.words)):
        name = k < len(box.names)
        family, weight = ("DejaVu Sans Mono", "bold") if name else ("DejaVu Sans", "normal")
        size, colour = (8.4, INK) if name else (8.0, GREY)
        axes.text(
            box.x, y + k * LINE, line, ha="center", va="center_baseline", family=family, weight=weight, size=size,
            color=colour,
        )  # fmt: skip


def draw_arrow(axes: Any, *points: tuple[float, float]) -> None:
    """A line through the points with a head at the last one."""
    for a, b in pairwise(points[:-1]):
        axes.plot([a[0], b[0]], [a[1], b[1]], color=INK, lw=1.1, solid_capstyle="round")
    head = {"arrowstyle": "-|>", "color": INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 10}
    axes.annotate("", xy=points[-1], xytext=points[-2], arrowprops=head)


def say(axes: Any, x: float, y: float, text: str, **style: Any) -> None:
    """Words beside an arrow."""
    axes.text(x, y, text, va="center", **{"color": GREY, "size": 8.0, "style": "italic", **style})


def draw_offline(axes: Any) -> Box:
    """From a mesh to candidates: two rows; returns the last box, the choice."""
    say(axes, 14, 16, "A mesh becomes candidates: once, stored in the object's folder", size=10.5, color=INK,
        style="normal", weight="bold")  # fmt: skip
    first = [
        Box(96, 72, 164, ("load_object",), ("mesh file or", "objects/<name>/"), OFFLINE),
        Box(278, 72, 158, ("AffordanceObject",), ("surface, regions, convex", "pieces, mass [kg]"), OFFLINE),
        Box(482, 72, 208, ("AffordanceMap", "SignedDistanceField"), ("points with labels; distance [m]",), OFFLINE),
        Box(745, 72, 270, ("optimise", "InitialPoses, GraspEnergy"),
            ("Descent, then close_hand (quasi-static)",), OFFLINE),
    ]  # fmt: skip
    second = [
        Box(745, 168, 270, ("pressed_contacts, vote",), ("contact points [m] vote", "for the grasp class"), OFFLINE),
        Box(482, 168, 208, ("validate, rank",), ("shake test of the hand alone,",
            "then lift test on a table"), OFFLINE),
        Box(278, 168, 158, ("rank_in_task",), ("whole episodes;", "share that succeeds"), OFFLINE),
        Box(96, 168, 164, ("GraspCandidates",), ("grasps.safetensors,", "best first"), OFFLINE),
    ]  # fmt: skip
    table = Box(109, 264, 190, ("ReachTable",), ("f_reach where the object", "stands: place [m], yaw [rad]"), OFFLINE)
    choice = Box(
        330, 264, 208, ("CandidateChoice",), ("at a reset: reachable, well", "ranked, near; with error"), COMMAND
    )
    for box in (*first, *second, table, choice):
        draw_box(axes, box)
    for a, b in pairwise(first):
        draw_arrow(axes, a.right, b.left)
    draw_arrow(axes, first[-1].bottom, second[0].top)
    for a, b in pairwise(second):
        draw_arrow(axes, a.left, b.right)
    draw_arrow(axes, second[-1].bottom, (second[-1].x, table.top[1]))
    draw_arrow(axes, table.right, choice.left)
    return choice


def draw_step(axes: Any, choice: Box) -> None:
    """One control step: down on the left to the motors, up on the right to the policy."""
    say(axes, 50, 328, "An action becomes motion, and comes back as an observation: every control step", size=10.5,
        color=INK, style="normal", weight="bold")  # fmt: skip
    left, right, middle = 226, 690, 450
    policy = Box(middle, 368, 150, ("policy",), ("network or script",), WORLD)
    down = [
        Box(left, 434, 300, ("DoraEnv.step",), ("checks the action (n, a) in [-1, 1]",), COMMAND),
        Box(left, 498, 300, ("Perturbations.delayed",), ("an earlier action, if the preset delays",), COMMAND),
        Box(left, 570, 300, ("ArmGroup.commands", "Arm.command"), ("each arm takes its part of the action",), COMMAND),
        Box(left, 658, 300, ("Guide.target",), ("Reference.target: wrist [m], wxyz; hand [rad]",
            "+ ResidualAction.apply: bounded, low-passed"), COMMAND),
        Box(left, 750, 300, ("world_wrist, wrist_step", "to_base_frame"), ("world target to a step in the base frame",),
            COMMAND),
        Box(left, 846, 300, ("WristHandController",), ("arm: dq = J^T (J J^T + 0.03² I)^-1 dx [rad]",
            "hand: joint targets [rad]"), COMMAND),
    ]  # fmt: skip
    target = down[3]
    physics = Box(
        middle, 979, 560, ("dora.sim.batch: BatchSystem, Stepper",),
        ("drives, arms, hands, objects: 5 (cube, jug) or 6 (hammer) physics steps",
         "of 1/100 or 1/240 s in each environment, one after the other"), WORLD,
    )  # fmt: skip
    up = [
        Box(right, 846, 330, ("ContactMonitor, StateReader.record",), ("impulses [N s], overlaps [m],",
            "contact points [m] of the last control step"), READING),
        Box(right, 754, 330, ("EpisodeMemory",), ("contacts, largest overlap, highest rise,",
            "last two actions"), READING),
        Box(right, 662, 330, ("StateReader.snapshot -> Snapshot",),
            ("hands, objects, goals: poses [m] wxyz in the world,",
             "joints [rad]; Task.extended adds its own"), READING),
        Box(609, 556, 168, ("Perturbations", ".observed"), ("adds noise of sensors",), READING),
        Box(609, 466, 168, ("observation_table",), ("entries, each a function", "of the observed state"), READING),
        Box(796, 556, 170, ("StageMachine", "Terms, Mdp"), ("judge the true state",), JUDGING),
    ]  # fmt: skip
    record, memory, snapshot, observed, entries, judges = up
    for box in (policy, *down, physics, *up):
        draw_box(axes, box)
    draw_arrow(axes, policy.left, (left, policy.y), down[0].top)
    say(axes, left + 8, policy.y - 10, "action (n, a)")
    for a, b in pairwise(down):
        draw_arrow(axes, a.bottom, b.top)
    draw_arrow(axes, down[-1].bottom, (left, physics.top[1]))
    say(axes, left + 8, 912, "joint targets [rad]; with a task's WRIST_MOTION")
    say(axes, left + 8, 927, "also joint velocities [rad/s]")
    draw_arrow(axes, (right, physics.top[1]), record.bottom)
    say(axes, right + 8, 919, "poses, joints, contacts")
    draw_arrow(axes, record.top, memory.bottom)
    draw_arrow(axes, memory.top, snapshot.bottom)
    draw_arrow(axes, (observed.x, snapshot.top[1]), observed.bottom)
    draw_arrow(axes, (judges.x, snapshot.top[1]), judges.bottom)
    draw_arrow(axes, observed.top, entries.bottom)
    draw_arrow(axes, entries.top, (entries.x, policy.y + 9), (policy.right[0], policy.y + 9))
    say(axes, entries.x + 8, 408, "observation (n, o)")
    draw_arrow(axes, judges.top, (judges.x, policy.y - 7), (policy.right[0], policy.y - 7))
    say(axes, judges.x - 8, policy.y - 18, "reward (n,), success, failure, info", ha="right")
    lane = 428
    draw_arrow(axes, observed.left, (lane, observed.y), (lane, target.y), target.right)
    for k, words in enumerate(("observed", "state, in the", "next step")):
        say(axes, lane + 6, observed.y + 40 + k * LINE, words)
    lane = 34
    draw_arrow(axes, choice.bottom, (choice.x, 306), (lane, 306), (lane, target.y), target.left)
    say(axes, lane + 6, target.y - 15, "goals")


def main(path: Path) -> None:
    """Draws the picture into `path`; its ending says the format."""
    plt.rcParams["svg.hashsalt"] = "dora"
    figure = plt.figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
    axes.axis("off")
    draw_step(axes, draw_offline(axes))
    figure.savefig(path, dpi=DPI, facecolor="white", metadata={"Date": None} if path.suffix == ".svg" else None)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images" / "architecture.svg")
