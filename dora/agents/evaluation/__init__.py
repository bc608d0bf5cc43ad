"""Episodes on fixed seeds with a policy that does not explore, on several cores; films."""
