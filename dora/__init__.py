"""Dora: affordance-guided dexterous manipulation on ManiSkill and TorchRL.

`import dora` adds `sim_backend="physx_cpu_batch"` to ManiSkill; the task ids are registered on first use, or with
`import dora.tasks`.
"""
