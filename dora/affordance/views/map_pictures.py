"""Pictures and glTF files of affordance maps."""

from pathlib import Path
from typing import cast

import numpy as np
import torch
import trimesh
from trimesh.visual import ColorVisuals

from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.objects.palette import PALETTE, colours, legend_of
from dora.affordance.views.rasteriser import Camera, render
from dora.affordance.views.sheet import Panel, write_sheet
from dora.files import write_bytes

VIEWS = ((-1.0, 0.35), (2.4, 0.35))
"""Azimuth and elevation of the views [rad]."""
PLAIN = (225, 225, 225, 255)
"""Colour of the surface under the points: red, green, blue, opacity, 0 to 255."""
DISC_CORNERS, DISC_SHARE, DISC_LIFT = 8, 0.85, 2e-4
"""Corners of a point's disc, ratio of its radius to that of a disc of the point's area, height over the surface [m]."""


def painted(map: AffordanceMap) -> trimesh.Trimesh:
    """The surface in the object frame [m], each face in the colour of its region."""
    rgba = colours(map.face_labels, PALETTE)
    return trimesh.Trimesh(map.mesh.vertices, map.mesh.faces, face_colors=rgba, process=False)


def discs(map: AffordanceMap) -> trimesh.Trimesh:
    """Each point as a disc, about as large as the area that it represents, in the colour of its region [m]."""
    angle = torch.linspace(0, 2 * torch.pi, DISC_CORNERS + 1)[:-1]
    first = torch.linalg.cross(map.normals, torch.eye(3)[map.normals.abs().argmin(1)])
    first = torch.nn.functional.normalize(first, dim=-1)
    second = torch.linalg.cross(map.normals, first)
    radius = (map.areas / torch.pi).sqrt()[:, None, None]
    ring = angle.cos()[:, None] * first[:, None] + angle.sin()[:, None] * second[:, None]
    corners = (map.points + DISC_LIFT * map.normals)[:, None] + DISC_SHARE * radius * ring
    fan = torch.tensor([[0, i, i + 1] for i in range(1, DISC_CORNERS - 1)])
    faces = fan + DISC_CORNERS * torch.arange(len(map))[:, None, None]
    colors = np.repeat(colours(map.labels.numpy(), PALETTE), len(fan), axis=0)
    vertices = corners.reshape(-1, 3).numpy()
    return trimesh.Trimesh(vertices, faces.reshape(-1, 3).numpy(), face_colors=colors, process=False)


def picture_map(map: AffordanceMap, path: Path | str, size: int = 400) -> None:
    """Write a PNG: the painted surface from the front and from behind, and the points as discs on it.

    Args:
        map: the map to draw.
        path: path of the file.
        size: side of each of the three views [pixels].

    Raises:
        InputError: the file cannot be written.
    """
    own = map.to("cpu")
    plain = trimesh.Trimesh(map.mesh.vertices, map.mesh.faces, process=False)
    plain.visual = ColorVisuals(plain, face_colors=PLAIN)
    shown = {
        "regions, from the front": ([painted(own)], VIEWS[0]),
        "from behind": ([painted(own)], VIEWS[1]),
        f"the {len(map)} points of the map": ([plain, discs(own)], VIEWS[0]),
    }
    panels = [
        Panel(render(meshes, Camera.around([map.mesh], *view), size, size), title)
        for title, (meshes, view) in shown.items()
    ]
    write_sheet(panels, path, len(panels), legend_of(map.names), map.name)


def export_glb(map: AffordanceMap, path: Path | str) -> None:
    """Write the coloured surface as binary glTF [m].

    Raises:
        InputError: the file cannot be written.
    """
    write_bytes(Path(path), cast(bytes, trimesh.Scene(painted(map)).export(file_type="glb")))
