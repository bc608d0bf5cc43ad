"""TorchRL learners: environments, collectors, PPO, SAC, evaluation, logging and checkpoints.

Nothing here imports ManiSkill or SAPIEN: a task is whatever follows `dora.agents.collecting.task_env.Task`.
"""
