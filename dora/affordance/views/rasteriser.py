"""Rasteriser of coloured triangles with a depth buffer in NumPy, without GPU, graphics driver or window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from dora.affordance.hand.link_meshes import face_colours

OVERSAMPLING = 2
"""Pixels rendered along each side of a pixel shown, for antialiasing."""
DEPTHS = 1 << 40
"""Number of steps into which the inverse depth is quantised."""
CHUNK = 2_000_000
"""Pixels tested at once; bounds the memory."""
MARGIN = 1.06
"""Ratio of the width of a view to that of the meshes in it, for a margin [1]."""
LIGHT = (-0.35, 0.45, 0.82)
"""Direction towards the light, not normalised: components to the right, up, and towards the viewer."""
AMBIENT = 0.6
"""Brightness of a face that is turned away from the light, relative to its colour [1]."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: (x, y, z) position of the camera [m].
        target: (x, y, z) point at the picture's centre [m].
        up: direction that is up in the picture.
        field: full vertical opening angle [rad].
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    field: float = 0.6

    @classmethod
    def around(cls, meshes: Sequence[trimesh.Trimesh], azimuth: float, elevation: float, field: float = 0.6) -> Camera:
        """A camera at azimuth and elevation [rad] from the centre of meshes, as near as they fit a square picture."""
        points = np.concatenate([mesh.vertices for mesh in meshes])
        target = (points.min(0) + points.max(0)) / 2
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        seen = np.abs((points - target) @ cls(_triple(away), (0.0, 0.0, 0.0)).rotation.T)
        towards = (points - target) @ away
        distance = (towards + MARGIN * seen[:, :2].max(1) / np.tan(field / 2)).max()
        return cls(_triple(target + distance * away), _triple(target), field=field)

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Rotation matrix from the frame of the meshes to the camera: rows are right, up and towards the viewer."""
        back = np.subtract(self.eye, self.target)
        back /= np.linalg.norm(back)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back])


def render(
    meshes: list[trimesh.Trimesh],
    camera: Camera,
    width: int,
    height: int,
    background: tuple[int, int, int] = (255, 255, 255),
) -> UInt8[np.ndarray, "h w 3"]:
    """Picture of face-coloured meshes with diffuse light, both sides of a face shown.

    Args:
        meshes: face-coloured meshes in one frame, all in front of the camera [m].
        camera: the camera.
        width, height: size of the picture [pixels].
        background: red, green and blue, 0 to 255.

    Returns:
        (height, width, 3) red, green and blue, 0 to 255.
    """
    turn, corners = camera.rotation, _corners(meshes, camera)
    normals = np.concatenate([mesh.face_normals for mesh in meshes]) @ turn.T
    colors = np.concatenate([face_colours(mesh)[:, :3] for mesh in meshes]).astype(float)
    light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
    facing = np.where(np.einsum("nd,nd->n", normals, corners[:, 0]) > 0, -1.0, 1.0)
    shade = AMBIENT + (1 - AMBIENT) * np.clip(facing * (normals @ light), 0, 1)
    shown = np.vstack([colors * shade[:, None], np.asarray(background, dtype=float)])
    big = (height * OVERSAMPLING, width * OVERSAMPLING)
    nearest = _nearest_faces(_project(corners, camera.field, big), big)
    picture = shown[nearest].reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3).mean((1, 3))
    return picture.round().astype(np.uint8)


def seen(meshes: list[trimesh.Trimesh], camera: Camera, width: int, height: int) -> Int[np.ndarray, "h w"]:
    """Index of the face that is visible in every pixel, counted through all meshes; the number of faces where none is.

    Arguments as for `render`.
    """
    return _nearest_faces(_project(_corners(meshes, camera), camera.field, (height, width)), (height, width))


def _corners(meshes: list[trimesh.Trimesh], camera: Camera) -> Float[np.ndarray, "f 3 3"]:
    """Corners of all faces in the camera frame: to the right, up and towards the viewer, from the eye [m]."""
    return (np.concatenate([mesh.triangles for mesh in meshes]) - np.asarray(camera.eye)) @ camera.rotation.T


def _project(corners: np.ndarray, field: float, size: tuple[int, int]) -> Float[np.ndarray, "f 3 3"]:
    """Column, row [pixels] and inverse depth [1/m] of every corner of every face."""
    height, width = size
    inverse = 1 / -corners[..., 2]
    focal = height / 2 / np.tan(field / 2)
    column = width / 2 + focal * corners[..., 0] * inverse
    row = height / 2 - focal * corners[..., 1] * inverse
    return np.stack([column, row, inverse], -1)


def _nearest_faces(faces: Float[np.ndarray, "f 3 3"], size: tuple[int, int]) -> Int[np.ndarray, "h w"]:
    """Index of the face that is visible in every pixel; the number of faces where none is.

    The inverse depth is linear in the picture, so barycentric coordinates interpolate it exactly. Index and depth are
    packed into one integer, so that one maximum per pixel finds both.
    """
    height, width = size
    low = np.clip(np.ceil(faces[..., :2].min(1) - 0.5), 0, [width, height]).astype(np.int64)
    high = np.clip(np.floor(faces[..., :2].max(1) - 0.5) + 1, 0, [width, height]).astype(np.int64)
    span = np.maximum(high - low, 0)
    count = span[:, 0] * span[:, 1]
    best = np.zeros(height * width, dtype=np.int64)
    farthest = faces[..., 2].max() * 1.001
    for chunk in np.array_split(np.arange(len(faces)), max(1, -(-int(count.sum()) // CHUNK))):
        face = np.repeat(chunk, count[chunk])
        place = np.arange(len(face)) - np.repeat(np.cumsum(count[chunk]) - count[chunk], count[chunk])
        column = low[face, 0] + place % np.maximum(span[face, 0], 1)
        row = low[face, 1] + place // np.maximum(span[face, 0], 1)
        inside, inverse = _barycentric(faces[face], column + 0.5, row + 0.5)
        key = (inverse / farthest * DEPTHS).astype(np.int64) * (len(faces) + 1) + face + 1
        np.maximum.at(best, (row * width + column)[inside], key[inside])
    return np.where(best == 0, len(faces), best % (len(faces) + 1) - 1).reshape(height, width)


def _barycentric(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether points (x, y) [pixels] lie in their triangles, and the inverse depth there [1/m]."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        v = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (y - a[:, 1])) / area
        w = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])) / area
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        inverse = a[:, 2] + v * (b[:, 2] - a[:, 2]) + w * (c[:, 2] - a[:, 2])
    return inside, inverse


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
