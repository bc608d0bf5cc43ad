"""Convex decomposition of meshes by CoACD, cached on disk, and its deviation from the mesh."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float

from dora.affordance.objects.signed_distance import ExactDistance
from dora.affordance.objects.solids import hull_of
from dora.containers import check_triangles
from dora.digests import digest_of
from dora.errors import InputError
from dora.files import read_tensors, stored_or_made, write_tensors

THRESHOLD = 0.05
"""Default largest concavity of a hull relative to the mesh's size; see `decompose` [1]."""
LARGEST_THRESHOLD = 1.0
"""Concavity that yields a single hull [1]."""
ITERATIONS, DEPTH = 60, 2
"""Effort of CoACD's tree search for each cut; its defaults 150 and 3 take twice as long without better hulls."""
HULL_VERTICES = 200
"""Largest number of vertices of a hull: PhysX's limit is 255, and contacts cost more with each."""
SAMPLES = 20_000
"""Number of surface points at which the deviation is measured."""
TOUCHING = 1e-5
"""Distance to another hull below which a point lies on a cut between hulls, not on the union's surface [m]."""
CACHE_VARIABLE = "DORA_CACHE"
"""Environment variable with the folder of cached files."""
FORMAT = "dora-hulls 1"
"""Format and version of a file of hulls."""


@dataclass(frozen=True)
class Deviation:
    """Deviation of a union of convex hulls from the mesh that it approximates.

    Attributes:
        outward: largest distance of the union's surface outside the mesh [m].
        inward: largest distance of the mesh's surface outside the union [m].
        mean: mean distance of the union's surface from the mesh [m].
    """

    outward: float
    inward: float
    mean: float


def cache_folder() -> Path:
    """Folder of cached files: $DORA_CACHE, else ~/.cache/dora, for who has no home a folder of temporary files. What
    cannot be stored there is made each time."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given)
    try:
        return Path.home() / ".cache" / "dora"
    except RuntimeError:
        return Path(tempfile.gettempdir()) / f"dora-cache-{os.getuid()}"


def decompose(
    mesh: trimesh.Trimesh, threshold: float = THRESHOLD, cache_dir: Path | str | None = None
) -> list[trimesh.Trimesh]:
    """Approximate convex decomposition of a mesh by CoACD; read from the cache if computed before.

    X. Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search",
    ACM Transactions on Graphics 41(4), 2022. Holes stay open, unlike with a single hull.

    Args:
        mesh: watertight mesh [m].
        threshold: largest concavity of a hull relative to the mesh's size, 0.01 (fine) to 1 (a single hull) [1].
        cache_dir: folder of the cache; `cache_folder()` if None.

    Raises:
        InputError: the threshold is out of range, or the mesh is not watertight.
    """
    if not 0.01 <= threshold <= LARGEST_THRESHOLD:
        raise InputError(f"the threshold of a decomposition must lie in .01 to {LARGEST_THRESHOLD}, not {threshold}.")
    if not mesh.is_watertight:
        raise InputError("only a closed surface can be decomposed: fill the holes of the mesh first.")
    path = (Path(cache_dir) if cache_dir else cache_folder()) / "hulls" / f"{_digest(mesh, threshold)}.safetensors"
    return stored_or_made(path, _load, lambda: _run(mesh, threshold), _save)


def deviation(mesh: trimesh.Trimesh, hulls: Sequence[trimesh.Trimesh], seed: int = 0) -> Deviation:
    """Deviation of the union of hulls from a watertight mesh, measured at random points of both surfaces."""
    surface = trimesh.sample.sample_surface(mesh, SAMPLES, seed=seed)[0]
    uncovered = np.min([ExactDistance(hull)(surface) for hull in hulls], axis=0)
    areas = np.array([hull.area for hull in hulls])
    counts = np.maximum(SAMPLES * areas / areas.sum(), 1).astype(int)
    clouds = [trimesh.sample.sample_surface(h, n, seed=seed)[0] for h, n in zip(hulls, counts, strict=True)]
    union = np.concatenate([_outside_of_others(hulls, i, cloud) for i, cloud in enumerate(clouds)])
    apart = ExactDistance(mesh)(union)
    return Deviation(
        outward=max(float(apart.max()), 0.0), inward=max(float(uncovered.max()), 0.0), mean=float(np.abs(apart).mean())
    )


def _outside_of_others(
    hulls: Sequence[trimesh.Trimesh], own: int, cloud: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "m 3"]:
    """Those points (m, 3) of one hull's surface that lie in no other hull [m]."""
    for other, hull in enumerate(hulls):
        if other != own and len(cloud):
            cloud = cloud[ExactDistance(hull)(cloud) > TOUCHING]
    return cloud


def _run(mesh: trimesh.Trimesh, threshold: float) -> list[trimesh.Trimesh]:
    """Runs CoACD without its voxel preprocessing, which would blur a watertight mesh."""
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
    names = [f"{i}/{part}" for i in range(len(tensors) // 2) for part in ("vertices", "faces")]
    if metadata.get("count") != len(tensors) / 2 or not tensors or set(names) != set(tensors):
        raise InputError(f"{path} holds no hulls: delete it.")
    hulls = []
    for vertices, faces in zip(names[::2], names[1::2], strict=True):
        corners, triangles = tensors[vertices].numpy(), tensors[faces].numpy()
        check_triangles(path, corners, triangles)
        hulls.append(trimesh.Trimesh(corners, triangles, process=False))
    return hulls
