"""Affordance maps of objects, contact semantic maps of hands, and the vote for the region that a hand holds."""
