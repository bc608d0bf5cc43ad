"""Robots as data: descriptions, URDF, collision shapes and kinematics, without a simulator."""

from dora.robot.description import (
    Contact,
    Coupling,
    Finger,
    JointGroup,
    Posture,
    RobotDescription,
)
from dora.robot.kinematics import SerialChain
from dora.robot.loading import available_robots, load_robot
from dora.robot.shapes import Shape

__all__ = [
    "Contact",
    "Coupling",
    "Finger",
    "JointGroup",
    "Posture",
    "RobotDescription",
    "SerialChain",
    "Shape",
    "available_robots",
    "load_robot",
]
