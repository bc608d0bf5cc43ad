"""Objects of our own, each built by code; lengths in m, masses in kg."""
