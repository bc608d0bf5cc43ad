"""Mutants: small deliberate faults of the source, and whether the tests notice them."""
