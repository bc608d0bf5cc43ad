"""What a task is made of that is pure: snapshot, stages, reward terms, observations, randomisation."""
