"""A run from its settings to its folder: training loop, checkpoints, logs, results, reports."""
