"""Motion feasibility: which candidates the arm can carry out, and from which side."""
