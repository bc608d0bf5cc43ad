"""An object as data: its labelled surface, its mass and inertia, and its convex collision shapes."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int

from dora.errors import InputError
from dora.robot.shapes import Shape

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Resting orientation (wxyz) of an object that stands on a table as it was modelled."""
Placement = Literal["table", "air", "fixture"]
"""Where an object is before it is grasped: on a table, in the air (it is caught), or as a part of something fixed."""
FRICTION = 0.7
"""Nominal coefficient of friction where none is given."""
HOME = "home"
"""Posture of the arm before a grasp where none is given."""
DIGEST_LENGTH = 1e-7
"""Unit to which lengths in a digest are rounded [m]."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One convex collision shape in the object frame: a primitive, or a convex hull as a mesh [m].

    Attributes:
        label: region to which the piece belongs; one of the object's labels.
        shape: the primitive with its pose, or the hull [m].
    """

    label: str
    shape: Shape | trimesh.Trimesh

    def moved(self, offset: Float[np.ndarray, " 3"]) -> Piece:
        """A copy of the piece, translated by `offset` (3,) [m]."""
        if isinstance(self.shape, Shape):
            x, y, z = (float(v) for v in np.asarray(self.shape.position) + offset)
            return replace(self, shape=replace(self.shape, position=(x, y, z)))
        return replace(self, shape=moved(self.shape, offset))


@dataclass(frozen=True, eq=False)
class AffordanceObject:
    """A rigid object with a labelled surface. Its frame is that of its mesh [m], with the origin at the centre of mass.

    Attributes:
        name: "jug", or the stem of a user's file.
        mesh: watertight surface with outward faces.
        face_labels: (F,) index into `labels` of every face.
        labels: names of the regions.
        classes: grasp class of each region, such as "HandleGrasp".
        target: region that a task wants held.
        solid: watertight mesh without cavities, which the hand must not enter.
        mass: mass [kg].
        inertia: (3, 3) about the origin [kg m^2].
        pieces: convex collision shapes; each costs simulation time.
        support: height of the origin above the table on which the object rests [m].
        rest: orientation of the object frame at rest on a horizontal table, wxyz.
        digest: sha256 of the labelled surface, see `surface_digest`.
        friction: nominal coefficient, static and dynamic.
        placement: where it is before it is grasped.
        start_posture: name of the robot's posture from which an arm sets out to grasp it.
        folder: that it was read from, with its grasps and reach tables; None for an object that has none.
    """

    name: str
    mesh: trimesh.Trimesh
    face_labels: Int[np.ndarray, " f"]
    labels: tuple[str, ...]
    classes: tuple[str, ...]
    target: str
    solid: trimesh.Trimesh
    mass: float
    inertia: Float[np.ndarray, "3 3"]
    pieces: tuple[Piece, ...]
    support: float
    rest: tuple[float, float, float, float]
    digest: str
    friction: float = FRICTION
    placement: Placement = "table"
    start_posture: str = HOME
    folder: Path | None = None

    @property
    def on_table(self) -> bool:
        """Whether a hand that grasps it has to keep above a table."""
        return self.placement == "table"

    @property
    def target_class(self) -> str:
        """Grasp class of the region that a task wants held."""
        return self.classes[self.labels.index(self.target)]

    def label_index(self, label: str) -> int:
        """Index of a region.

        Raises:
            InputError: the object has no such region.
        """
        if label not in self.labels:
            raise InputError(f"{self.name} has no region {label!r}; choose one of: {', '.join(self.labels)}.")
        return self.labels.index(label)

    def region(self, label: str) -> trimesh.Trimesh:
        """The surface of one region as an open mesh in the object frame [m].

        Raises:
            InputError: the object has no such region.
        """
        faces = np.flatnonzero(self.face_labels == self.label_index(label))
        part = self.mesh.submesh([faces], append=True)
        assert isinstance(part, trimesh.Trimesh)
        return part

    def centroid(self, label: str) -> Float[np.ndarray, " 3"]:
        """Area-weighted centre (3,) of a region in the object frame [m].

        Raises:
            InputError: the object has no such region.
        """
        faces = self.face_labels == self.label_index(label)
        return np.average(self.mesh.triangles_center[faces], axis=0, weights=self.mesh.area_faces[faces])


def assemble(
    name: str,
    mesh: trimesh.Trimesh,
    face_labels: Int[np.ndarray, " f"],
    regions: dict[str, str],
    target: str,
    weights: Sequence[tuple[trimesh.Trimesh, float]],
    pieces: Sequence[Piece],
    solid: trimesh.Trimesh | None = None,
    rest: tuple[float, float, float, float] = UPRIGHT,
    friction: float = FRICTION,
    placement: Placement = "table",
    start_posture: str = HOME,
) -> AffordanceObject:
    """An object from parts given in one common frame; moves the origin to the centre of mass.

    Args:
        name: name of the object.
        mesh: watertight surface [m].
        face_labels: (F,) index into `regions` of every face.
        regions: grasp class by label, in the order of the indices.
        target: label that a task wants held.
        weights: watertight bodies of uniform density with their masses [kg]; they need not be `mesh`.
        pieces: convex collision shapes.
        solid: `mesh` without cavities; `mesh` itself if None.
        rest: orientation at rest on a table, wxyz.
        friction: nominal coefficient [1].
        placement: where it is before it is grasped.
        start_posture: name of the arm's posture before a grasp.
    """
    mass, center, inertia = mass_properties(weights)
    mesh = moved(mesh, -center)
    return AffordanceObject(
        name=name,
        mesh=mesh,
        face_labels=face_labels,
        labels=tuple(regions),
        classes=tuple(regions.values()),
        target=target,
        solid=mesh if solid is None else moved(solid, -center),
        mass=mass,
        inertia=inertia,
        pieces=tuple(piece.moved(-center) for piece in pieces),
        support=support_height(mesh, rest),
        rest=rest,
        digest=surface_digest(mesh, face_labels, tuple(regions)),
        friction=friction,
        placement=placement,
        start_posture=start_posture,
    )


def moved(mesh: trimesh.Trimesh, offset: Float[np.ndarray, " 3"]) -> trimesh.Trimesh:
    """A copy of a mesh, translated by `offset` (3,) [m]."""
    return trimesh.Trimesh(mesh.vertices + offset, mesh.faces, process=False)


def support_height(mesh: trimesh.Trimesh, rest: tuple[float, float, float, float]) -> float:
    """Height of the origin above the lowest point of a mesh in the orientation `rest` (wxyz) [m]."""
    turn = trimesh.transformations.quaternion_matrix(rest)[:3, :3]
    return float(-(corners(mesh) @ turn[2]).min())


def corners(mesh: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """The vertices (n, 3) of a mesh that belong to a triangle; editors of meshes leave others behind."""
    return mesh.vertices[np.unique(mesh.faces)]


def mass_properties(
    weights: Sequence[tuple[trimesh.Trimesh, float]],
) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Mass [kg], centre of mass (3,) [m] and inertia (3, 3) about it [kg m^2] of bodies of uniform density.

    Args:
        weights: watertight meshes [m] with their masses [kg].

    The inertia follows the parallel axis theorem, I = sum I_k + m_k (|r_k|^2 1 - r_k r_k^T).
    """
    masses = np.array([mass for _, mass in weights])
    centers = np.stack([body.center_mass for body, _ in weights])
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for (body, mass), arm in zip(weights, centers - center, strict=True):
        inertia += body.moment_inertia * (mass / body.volume) + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return float(masses.sum()), center, inertia


def surface_digest(mesh: trimesh.Trimesh, face_labels: Int[np.ndarray, " f"], labels: tuple[str, ...]) -> str:
    """sha256 of a labelled surface: area, centroid and second moments of every region, with the region's name.

    The moments are rounded, and do not depend on the order of faces or the triangulation of flat parts. The digest of
    an object built by code is therefore the same on processors whose sine differs in the last bit.
    """
    digest = hashlib.sha256()
    for index, label in enumerate(labels):
        triangles = mesh.triangles[face_labels == index]
        digest.update(label.encode() + b"\0" + _moments(triangles).tobytes())
    return digest.hexdigest()


def _moments(triangles: Float[np.ndarray, "n 3 3"]) -> Int[np.ndarray, " 10"]:
    """Area, centroid and second moments of triangles in units of `DIGEST_LENGTH`, rounded.

    The quadrature at edge midpoints is exact for quadratic functions.
    """
    area = trimesh.triangles.area(triangles) / 3
    middles = (triangles + np.roll(triangles, 1, axis=1)) / 2
    first = np.einsum("n,nkd->d", area, middles)
    second = np.einsum("n,nki,nkj->ij", area, middles, middles)
    total = max(3 * area.sum(), DIGEST_LENGTH**2)
    values = np.concatenate([[3 * area.sum()], first / total, second[np.triu_indices(3)] / total])
    units = np.repeat([DIGEST_LENGTH, DIGEST_LENGTH, DIGEST_LENGTH], [1, 3, 6])
    return np.round(values / units).astype(np.int64)
