"""ManiSkill's viewer of robots, `mani_skill.examples.demo_robot`, with Dora's robots known to it.

    python examples/demo_robot.py -r diana7_hit -k home

It needs a screen and a Vulkan driver (docs/rendering.md). All options are ManiSkill's; the robot is Dora's by default.
"""

import sys

import tyro
from mani_skill.examples import demo_robot

import dora  # noqa: F401  registers the robots
from dora.sim import can_render


def main() -> None:
    """Opens the viewer, or says in one sentence why it cannot."""
    args = tyro.cli(demo_robot.Args, default=demo_robot.Args(robot_uid="diana7_hit"))
    if not can_render():
        print("SAPIEN finds no Vulkan driver, which the viewer needs: see docs/rendering.md", file=sys.stderr)
        sys.exit(2)
    demo_robot.main(args)


if __name__ == "__main__":
    main()
