"""Grasp tests in simulation by a hand without an arm: shaking, lifting, ranking, and the making of bundled sets."""
