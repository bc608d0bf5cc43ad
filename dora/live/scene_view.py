"""The scene of a live page: robots, objects with their affordance maps, ghosts of candidates, contact forces."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from dora.affordance.hand.link_meshes import face_colours, joined, link_meshes, painted
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.solids import shape_mesh
from dora.affordance.views.hands import Hands
from dora.affordance.views.surface import Surface, unshared
from dora.live.state import Forces, Goal, LiveState, Poses, Setup
from dora.sim.shapes import DrawnShape

GHOST = ((0, 130, 60), 0.45)
"""Colour and opacity of the ghost of a candidate's hand."""
GREY = (0.72, 0.72, 0.74)
"""Colour of an object without its affordance map."""
LENGTH, LONGEST = 0.02, 0.25
"""Length of an arrow for each newton [m/N], and its largest length [m]."""
ON_HAND, ON_OBJECT = (200, 0, 0), (0, 50, 220)
"""Colours of forces on a hand and on an object: red, green, blue, 0 to 255."""
SHAFT, HEAD, POINT = 0.0025, 0.006, 0.014
"""Radii of an arrow's shaft and head, and length of its head [m]."""
HIDDEN = np.array([[[0.0, 0.0, -10.0], [0.0, 0.0, -10.001]]], np.float32)
"""An arrow far below the floor, shown where there is no force; without any the page would keep the last ones."""


class SceneView:
    """What a page shows of a session, moved by its states.

    Args:
        scene: of viser's server.
        setup: of the environment.
    """

    def __init__(self, scene: Any, setup: Setup):
        self._scene, self._setup = scene, setup
        self._bodies: dict[Hashable, Any] = {}
        self._poses: dict[Hashable, Float[np.ndarray, " 7"]] = {}
        for arm, robot in setup.robots.items():
            meshes = link_meshes(robot, robot.model.links)
            for link, mesh in meshes.items():
                self._add(("link", arm, link), f"/robots/{arm}/{link}", unshared(mesh, face_colours(mesh)))
        for name, shapes in setup.fixtures.items():
            self._add(("fixture", name), f"/fixtures/{name}", _solid(shapes))
        self._maps, self._plain = {}, {}
        for name in setup.objects:
            surface = Surface(load_object(name))
            self._bodies["object", name] = scene.add_frame(f"/objects/{name}", show_axes=False)
            grey = painted(surface.mesh, GREY)
            self._maps[name] = scene.add_mesh_trimesh(f"/objects/{name}/map", surface.painted(surface.regions()))
            self._plain[name] = scene.add_mesh_trimesh(
                f"/objects/{name}/plain", unshared(grey, face_colours(grey)), visible=False
            )
        self._ghosts = {arm: Hands(scene, r, 1, f"/ghosts/{arm}", GHOST) for arm, r in setup.robots.items()}
        self._asked: dict[str, bytes] = {}
        self.arrows = scene.add_arrows(
            "/forces", HIDDEN, np.array([ON_HAND], np.uint8), shaft_radius=SHAFT, head_radius=HEAD, head_length=POINT
        )

    def _add(self, key: Hashable, name: str, mesh: trimesh.Trimesh) -> None:
        self._bodies[key] = self._scene.add_mesh_trimesh(name, mesh)

    def update(self, state: LiveState, poses: Poses) -> None:
        """Shows a state, with the bodies at other poses: those of a physics step on the way to it."""
        for (arm, link), pose in poses.links.items():
            self._move(("link", arm, link), pose)
        for name, pose in poses.fixtures.items():
            self._move(("fixture", name), pose)
        for name, pose in poses.objects.items():
            self._move(("object", name), pose)
            for handle in (self._maps[name], self._plain[name]):
                if handle.scale != state.scales[name]:
                    handle.scale = state.scales[name]
        for arm, goal in state.goals.items():
            self._haunt(arm, goal)
        self.arrows.points, self.arrows.colors = arrows(state.forces, state.setup.objects)

    def _move(self, key: Hashable, pose: Float[np.ndarray, " 7"]) -> None:
        """Puts a body where it is, unless it is there already or is not drawn."""
        handle, before = self._bodies.get(key), self._poses.get(key)
        if handle is None or (before is not None and np.array_equal(before, pose)):
            return
        self._poses[key] = pose
        handle.position, handle.wxyz = pose[:3], pose[3:]

    def _haunt(self, arm: str, goal: Goal) -> None:
        """Puts the ghost of a hand where the candidate asks for it."""
        ghost, joints = self._ghosts[arm], goal.joints.tobytes()
        if self._asked.get(arm) != joints:
            self._asked[arm] = joints
            wrist = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
            ghost.show(*wrist, torch.from_numpy(goal.joints)[None])
        ghost.frame.position, ghost.frame.wxyz = goal.wrist[:3], goal.wrist[3:]

    def show(self, *, maps: bool, ghosts: bool, forces: bool) -> None:
        """Shows or hides the affordance maps, the ghosts of the candidates, and the contact forces."""
        for name in self._setup.objects:
            self._maps[name].visible, self._plain[name].visible = maps, not maps
        for ghost in self._ghosts.values():
            ghost.frame.visible = ghosts
        self.arrows.visible = forces


def arrows(forces: Forces, objects: Iterable[str]) -> tuple[Float[np.ndarray, "k 2 3"], np.ndarray]:
    """Arrows that begin where something is pressed and point where the force on it points.

    Args:
        forces: of the contacts.
        objects: names of the objects; a force on anything else is one on a hand.

    Returns:
        First and last points [m], and colours (k, 3) of the arrows; one hidden arrow where there is no force.
    """
    if not forces.pairs:
        return HIDDEN, np.array([ON_HAND], np.uint8)
    size = np.linalg.norm(forces.forces, axis=-1, keepdims=True)
    along = forces.forces / size * np.minimum(LENGTH * size, LONGEST)
    colours = [ON_OBJECT if pressed in objects else ON_HAND for pressed, _ in forces.pairs]
    return np.stack([forces.points, forces.points + along], 1).astype(np.float32), np.array(colours, np.uint8)


def _solid(shapes: Iterable[DrawnShape]) -> trimesh.Trimesh:
    """Shapes of one body as a mesh in their colours."""
    mesh = joined([painted(shape_mesh(drawn.shape), drawn.colour[:3]) for drawn in shapes])
    return unshared(mesh, face_colours(mesh))
