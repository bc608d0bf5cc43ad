"""Motion feasibility: which candidates the arm can reach, and along which approach."""
