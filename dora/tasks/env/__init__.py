"""The environment around a task: scene, reading the simulator, memory of the episode, perturbations."""
