"""Batched CPU physics: ManiSkill's GPU interface served from one `PhysxCpuSystem` per environment."""
