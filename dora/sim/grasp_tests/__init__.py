"""Grasps put to the test in simulation by a hand without an arm: shaken, lifted, ranked, bundled."""
