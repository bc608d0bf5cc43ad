"""How the arm moves: inverse kinematics, collisions, planning, and the wrist controller without a simulator."""
