"""An energy of your own in the grasp search: the fingers are to point along the object's x axis, away from the robot.

Run it with `python examples/own_energy.py`.
"""

import torch

from dora.affordance.objects.catalogue import load_object
from dora.affordance.search.grasp_state import GraspState
from dora.affordance.search.optimise import Settings, optimise
from dora.robot import load_robot


def pointing(state: GraspState) -> torch.Tensor:
    """1 - cosine (c,) between the hand's lengthwise axis and the object's x axis: from 0 to 2."""
    along = state.wrist[:, :3, :3] @ state.wrist.new_tensor(state.hand.palm_frame.along)
    return 1 - along[:, 0]


def main() -> None:
    """Search without and with it."""
    cube, robot, settings = load_object("cube"), load_robot("diana7_hit"), Settings(starts=16)
    for weight in (0.0, 200.0):
        energies = {"pointing": (weight, pointing)}
        found = optimise(cube, robot, 16, 0, None, settings, kinematics="pytorch_kinematics", extra_energies=energies)
        print(f"with weight {weight:g} the energy is {float(found.energy['pointing'].mean()):.2f} on average")


if __name__ == "__main__":
    main()
