"""The algorithms, each readable from top to bottom, with their networks and the replay buffer."""
