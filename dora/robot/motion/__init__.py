"""Motion of the arm: inverse kinematics, collisions, planning, and rollouts of the wrist controller."""
