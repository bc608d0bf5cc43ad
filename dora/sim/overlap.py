"""Overlap of bodies in every physics step: the largest of each environment, and the two bodies of it."""

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dora.sim.batch.scene import BatchScene
from dora.sim.substeps import watch_contacts


class OverlapMonitor:
    """The largest overlap that PhysX finds in any physics step between certain bodies and whatever they touch.

    PhysX reports the contacts of the poses before a step, so each pose that was reached is looked at, the last one of
    a control step in the next. Overlap that a solver step makes and undoes again would be missed by looking at the
    last step of a control step only.

    Args:
        scene: the ManiSkill scene of the bodies; a reconfiguration requires a new monitor.
        bodies: actors and links that are watched, against each other and against everything else.
    """

    def __init__(self, scene: Any, bodies: Iterable[Any]):
        self._scene, self._count = scene, scene.num_envs
        self.known = isinstance(scene, BatchScene) or not scene.gpu_sim_enabled
        """Whether the simulator reports overlap; a GPU does not."""
        self._kept_alive = [body for member in bodies for body in member._bodies]  # ids stay unique
        self._watched = {id(body) for body in self._kept_alive}
        self._names: list[tuple[str, str] | None] = [None] * self._count
        self._lowest = [0.0] * self._count
        if self.known:
            watch_contacts(scene, self._watch, self._drop)

    def _watch(self, environment: int, contacts: list) -> None:
        lowest = self._lowest[environment]
        for contact in contacts:
            for point in contact.points:  # few points lower the minimum, so the bodies are looked up for those alone
                if point.separation < lowest:
                    one, other = contact.bodies
                    if id(one) in self._watched or id(other) in self._watched:
                        self._lowest[environment] = lowest = point.separation
                        self._names[environment] = (one.entity.name, other.entity.name)

    def _drop(self, environment: int) -> None:
        self._lowest[environment], self._names[environment] = 0.0, None

    def take(self) -> Float[Tensor, " n"]:
        """Largest overlap in the physics steps since the last `take` [m], 0 without any; NaN where `known` is False."""
        if not self.known:
            return torch.full((self._count,), torch.nan, device=self._scene.device)
        if isinstance(self._scene, BatchScene):
            self._scene.px.stepper.flush()
        depth = -torch.tensor(self._lowest, device=self._scene.device)
        self._lowest = [0.0] * self._count
        return depth

    def max_penetration_pair(self, environment: int) -> tuple[str, str] | None:
        """Names of the two bodies of the largest overlap found last in an environment; None without any."""
        return self._names[environment]
