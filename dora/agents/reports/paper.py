"""What the paper prints, as it is printed: success rates, minutes, claims, and how its set-up differs from ours."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Printed:
    """A cell of the paper's tables II, III or IV.

    Attributes:
        success: overall success rate [%].
        deviation: that stands behind it [%].
        minutes: of training, headless; None where the paper gives none.
    """

    success: float
    deviation: float
    minutes: float | None = None


Cell = tuple[str, str, str]
"""Task id, learner in capitals, guidance."""
PAPER: dict[Cell, Printed] = {
    ("DoraCube-v1", "PPO", "none"): Printed(55.3, 1.8, 119.3),
    ("DoraCube-v1", "SAC", "none"): Printed(51.8, 1.3, 141.5),
    ("DoraCube-v1", "PPO", "affordance"): Printed(73.2, 1.1, 115.8),
    ("DoraCube-v1", "SAC", "affordance"): Printed(68.3, 0.5, 136.8),
    ("DoraJug-v1", "PPO", "none"): Printed(37.9, 0.5, 122.3),
    ("DoraJug-v1", "SAC", "none"): Printed(28.3, 1.1, 145.2),
    ("DoraJug-v1", "PPO", "affordance"): Printed(65.6, 1.1, 118.7),
    ("DoraJug-v1", "SAC", "affordance"): Printed(57.9, 0.7, 137.8),
    ("DoraHammer-v1", "PPO", "none"): Printed(68.6, 0.5, 156.7),
    ("DoraHammer-v1", "SAC", "none"): Printed(75.0, 1.2, 178.9),
    ("DoraHammer-v1", "PPO", "affordance"): Printed(69.3, 0.6, 142.5),
    ("DoraHammer-v1", "SAC", "affordance"): Printed(75.1, 1.1, 166.2),
    ("DoraMicrowave-v1", "HAPPO", "none"): Printed(52.7, 0.9),
    ("DoraMicrowave-v1", "MAPPO", "none"): Printed(23.2, 0.7),
    ("DoraMicrowave-v1", "HAPPO", "affordance"): Printed(68.1, 1.0),
    ("DoraMicrowave-v1", "MAPPO", "affordance"): Printed(55.0, 0.3),
}
"""Tables II (tasks 1 to 3), III (minutes) and IV (task 4)."""
ONE_ARM = ("DoraCube-v1", "DoraJug-v1", "DoraHammer-v1")
"""Tasks 1 to 3."""
BETTER = {"DoraCube-v1": "PPO", "DoraJug-v1": "PPO", "DoraHammer-v1": "SAC"}
"""The learner that is better with guidance, by task, in table I."""
MEAN_GAIN = 15.4
"""Mean gain of affordance over tasks 1 to 3 and both learners, as printed [points]; its table gives 15.4 as well."""
JUG_GAIN = 27.7
"""Gain of affordance on the jug with PPO, as printed [points]."""

DIFFERENCES = (
    ("simulator", "Isaac Gym on an RTX 4090", "SAPIEN (PhysX 5) on two cores"),
    ("success",
     "tasks 1 to 3: overlap is not mentioned; task 4: the robot \"often exploits mesh penetration\", and it is not "
     "said that such episodes fail",
     "an overlap above 3 mm (cube) or 5 mm in any physics step makes an episode a failure"),
    ("without affordance", "not said what is left out, and whether the candidates are",
     "none leaves out candidates, reference and residual action as well; grasps is the same motion without regions"),
    ("action", "change of the wrist's pose, hand joints", "the same as a residual on a scripted reference"),
    ("randomisation", "not said", "size, mass, friction, pose, candidate error, observation noise (docs/guidance.md)"),
    ("training", "up to 10,000 epochs with batches of 32", ""),
    ("evaluation",
     "mean over three seeds, smoothed by a Gaussian of sigma 200; not said what the ± is, and of how many episodes",
     ""),
)  # fmt: skip
"""What, in the paper, here; nothing where it is of the runs."""
