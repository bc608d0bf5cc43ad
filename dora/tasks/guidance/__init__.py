"""What affordances add to a task: candidates, the reference that follows them, the residual action."""
