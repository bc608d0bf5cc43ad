"""Our tasks and ManiSkill's, as other libraries of reinforcement learning take them; each module needs its library."""
