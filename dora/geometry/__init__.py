"""Rotations and rigid poses as batched tensors; no robot, no simulator."""
