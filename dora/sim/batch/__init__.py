"""Batched CPU physics: ManiSkill's GPU interface, implemented by one `PhysxCpuSystem` per environment."""
