"""Objects as data: ours, those of users, and what is computed from their surfaces."""
