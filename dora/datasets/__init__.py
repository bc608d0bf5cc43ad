"""Datasets of demonstrations and of policies, in the formats of LeRobot, Minari and ManiSkill."""
