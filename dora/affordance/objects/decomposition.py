"""Convex decomposition of meshes, kept on disk, and how far it is from the mesh."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import torch
import trimesh
from jaxtyping import Float

from dora.affordance.objects.solids import hull_of
from dora.digests import digest_of
from dora.errors import InputError
from dora.files import read_tensors, write_tensors

THRESHOLD = 0.05
"""Default concavity of a hull; see `decompose`."""
LARGEST_THRESHOLD = 1.0
ITERATIONS, DEPTH = 60, 2
"""Effort of CoACD's search for each cut; its own 150 and 3 take twice as long for hulls no nearer to our objects."""
HULL_VERTICES = 200
"""Most vertices of a hull: PhysX takes 255, and a contact costs more with each."""
SAMPLES = 20_000
"""Points of a surface at which the deviation is measured."""
TOUCHING = 1e-5
"""Points of one hull nearer to another hull (m) lie on a cut between the two, not on the surface of the union."""
CACHE_VARIABLE = "DORA_CACHE"
FORMAT = "dora-hulls 1"
"""Format and version of a file of hulls."""


@dataclass(frozen=True)
class Deviation:
    """Distance (m) between a mesh and the union of convex hulls that stands for it.

    Attributes:
        outward: farthest point of the union outside the mesh.
        inward: deepest point of the mesh's surface that no hull covers.
        mean: mean over the union's surface of the distance to the mesh.
    """

    outward: float
    inward: float
    mean: float


def cache_folder() -> Path:
    """Where decompositions are kept: $DORA_CACHE, else ~/.cache/dora."""
    return Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "dora")


def decompose(
    mesh: trimesh.Trimesh, threshold: float = THRESHOLD, cache_dir: Path | str | None = None
) -> list[trimesh.Trimesh]:
    """Convex hulls that together stand for a mesh, by CoACD; read from the disk if done before.

    X. Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search",
    ACM Transactions on Graphics 41(4), 2022. Holes stay open, unlike with a single hull.

    Args:
        mesh: watertight (m).
        threshold: largest concavity of a hull, as a share of the mesh's size; .01 is fine, 1 is a single hull.
        cache_dir: where to keep the hulls; `cache_folder()` if None.

    Raises:
        InputError: the threshold is out of range, or the mesh is not watertight.
    """
    if not 0.01 <= threshold <= LARGEST_THRESHOLD:
        raise InputError(f"the threshold of a decomposition must lie in .01 to {LARGEST_THRESHOLD}, not {threshold}.")
    if not mesh.is_watertight:
        raise InputError("only a closed surface can be decomposed: fill the holes of the mesh first.")
    path = (Path(cache_dir) if cache_dir else cache_folder()) / "hulls" / f"{_digest(mesh, threshold)}.safetensors"
    if path.is_file():
        return _load(path)
    hulls = _run(mesh, threshold)
    path.parent.mkdir(parents=True, exist_ok=True)
    _save(path, hulls)
    return hulls


def deviation(mesh: trimesh.Trimesh, hulls: Sequence[trimesh.Trimesh], seed: int = 0) -> Deviation:
    """How far the union of hulls is from a mesh, both watertight; measured at random points of both surfaces."""
    surface = trimesh.sample.sample_surface(mesh, SAMPLES, seed=seed)[0]
    uncovered = np.min([_signed_distance(hull, surface) for hull in hulls], axis=0)
    areas = np.array([hull.area for hull in hulls])
    counts = np.maximum(SAMPLES * areas / areas.sum(), 1).astype(int)
    clouds = [trimesh.sample.sample_surface(h, n, seed=seed)[0] for h, n in zip(hulls, counts, strict=True)]
    union = np.concatenate([_outside_of_others(hulls, i, cloud) for i, cloud in enumerate(clouds)])
    apart = _signed_distance(mesh, union)
    return Deviation(
        outward=max(float(apart.max()), 0.0), inward=max(float(uncovered.max()), 0.0), mean=float(np.abs(apart).mean())
    )


def _outside_of_others(
    hulls: Sequence[trimesh.Trimesh], own: int, cloud: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "m 3"]:
    """The points of one hull's surface that lie in no other hull."""
    for other, hull in enumerate(hulls):
        if other != own and len(cloud):
            cloud = cloud[_signed_distance(hull, cloud) > TOUCHING]
    return cloud


def _signed_distance(mesh: trimesh.Trimesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance (m) to a watertight surface, negative inside."""
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    signed = igl.signed_distance(np.array(points), vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    return np.asarray(signed[0])


def _run(mesh: trimesh.Trimesh, threshold: float) -> list[trimesh.Trimesh]:
    """CoACD, without the voxel preprocessing that would blur a watertight mesh."""
    import coacd

    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=threshold,
        preprocess_mode="off",
        mcts_iterations=ITERATIONS,
        mcts_max_depth=DEPTH,
        seed=0,
    )
    return [hull_of(np.asarray(vertices), HULL_VERTICES) for vertices, _ in parts]


def _digest(mesh: trimesh.Trimesh, threshold: float) -> str:
    """sha256 of all on which the hulls depend."""
    settings = [FORMAT, threshold, HULL_VERTICES, ITERATIONS, DEPTH]
    return digest_of([*settings, np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)])


def _save(path: Path, hulls: Sequence[trimesh.Trimesh]) -> None:
    tensors = {f"{i}/vertices": torch.tensor(np.array(hull.vertices)) for i, hull in enumerate(hulls)}
    tensors |= {f"{i}/faces": torch.tensor(np.array(hull.faces)) for i, hull in enumerate(hulls)}
    write_tensors(path, FORMAT, tensors, {"count": len(hulls)})


def _load(path: Path) -> list[trimesh.Trimesh]:
    tensors, metadata = read_tensors(path, FORMAT)
    return [
        trimesh.Trimesh(tensors[f"{i}/vertices"].numpy(), tensors[f"{i}/faces"].numpy(), process=False)
        for i in range(metadata["count"])
    ]
