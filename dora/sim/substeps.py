"""Being called after every physics step, which on the batched back end are many per call of `step`."""

from collections.abc import Callable

from mani_skill.envs.scene import ManiSkillScene

from dora.sim.batch.scene import BatchScene


def watch_physics(scene: ManiSkillScene, watch: Callable[[int], None]) -> None:
    """Calls `watch` with the number of an environment after each physics step of that environment.

    It may read and write SAPIEN's objects of that environment directly, and is forgotten with the scene.

    Args:
        scene: the scene of all environments, on a CPU (single or batched).
        watch: called with 0 on a single environment.
    """
    if isinstance(scene, BatchScene):
        scene.px.stepper.watchers.append(watch)
        return
    step = scene.step

    def step_and_watch() -> None:
        step()
        watch(0)

    scene.step = step_and_watch
