"""Trained policies that come with Dora, one for each task, and what is known of each."""
