"""Callbacks after every physics step, also on the batched back end, which makes many steps per call of `step`."""

from collections.abc import Callable
from typing import Any

from mani_skill.envs.scene import ManiSkillScene

from dora.sim.batch.scene import BatchScene


def watch_physics(scene: ManiSkillScene, watch: Callable[[int], None]) -> None:
    """Registers a function that is called after each physics step of each environment, for the life of the scene.

    Args:
        scene: the scene of all environments, on a CPU (single or batched).
        watch: called with the index of the environment, 0 on a single one. It may read and write SAPIEN's objects of
            that environment directly.
    """
    if isinstance(scene, BatchScene):
        scene.px.stepper.watchers.append(watch)
        return
    step = scene.step

    def step_and_watch() -> None:
        step()
        watch(0)

    scene.step = step_and_watch


def watch_contacts(
    scene: ManiSkillScene, watch: Callable[[int, list], None], drop: Callable[[int], None] | None = None
) -> None:
    """Registers a function that is shown the contacts of each physics step of each environment.

    Args:
        scene: as for `watch_physics`.
        watch: called with the index of the environment and SAPIEN's contacts, which it must not keep: SAPIEN frees
            them in the next step. The contacts are those of the poses before the step; their impulses are the step's.
        drop: called with the index of an environment whose last contacts do not count, because its simulation became
            bad and was put back.
    """
    if isinstance(scene, BatchScene):
        scene.px.stepper.contact_watchers.append(watch)
        if drop is not None:
            scene.px.stepper.droppers.append(drop)
    else:
        system: Any = scene.px
        watch_physics(scene, lambda environment: watch(environment, system.get_contacts()))
