"""Bundled sets of candidates, ranked and refined by executing them in the task that uses their object."""
