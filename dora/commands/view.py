"""Show an object, its regions and its grasps on a web page.

    python experiments/view.py jug                                  # one of our objects with its shipped grasps
    python experiments/view.py runs/grasps/jug.safetensors          # what experiments/grasps.py wrote
    python experiments/view.py mug.glb --labels mug.yaml            # the regions of your own mesh
    python experiments/view.py runs/grasps/mug.safetensors --mesh mug.glb --labels mug.yaml
    python experiments/view.py jug --pictures runs/pictures         # PNG files instead of a page
    python experiments/view.py --pictures runs/pictures             # one PNG of all our objects

Runs until Ctrl-C.
"""

import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.objects.importing import import_object
from dora.affordance.views.album import write_album, write_objects
from dora.affordance.views.page import GraspPage
from dora.errors import InputError
from dora.robot import load_robot

BAD_INPUT = 2
"""Exit status after an `InputError`."""
GRASPS = ".safetensors"
"""Suffix of a file of grasps."""


@dataclass
class Args:
    """Show an object, its regions and its grasps on a web page."""

    source: tyro.conf.Positional[str | None] = None
    """An object (cube, jug, hammer, microwave), a file of grasps (.safetensors) or a mesh file; none with --pictures:
    all our objects."""
    port: int = 8080
    """TCP port of the page."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines see the page."""
    mesh: Path | None = None
    """Mesh of a file of grasps that is not of one of our objects."""
    labels: Path | None = None
    """Regions of the mesh, as for experiments/grasps.py."""
    scale: float = 1.0
    """Factor of all lengths of --mesh."""
    units: Literal["m", "cm", "mm", "in"] = "m"
    """Unit of length of --mesh; GLB files are in metres."""
    pictures: Path | None = None
    """Folder: write PNGs of regions, of four grasps and of their contact semantic maps there, or one of all our objects
    (objects.png), and serve no page."""
    robot: str = "diana7_hit"
    """Robot whose hand is shown: a folder name in robots/ or a path."""


def content(args: Args) -> tuple[AffordanceObject, GraspCandidates | None]:
    """The object to show and its grasps, if there are any."""
    robot = load_robot(args.robot)
    if args.source is None:
        raise InputError("Say what to show: an object, a file of grasps or a mesh file, for example jug.")
    if args.source in available_objects():
        return load_object(args.source), load_candidates(args.source, robot)
    path = Path(args.source)
    if not path.is_file():
        known = ", ".join(available_objects())
        raise InputError(f"{args.source} is neither an object ({known}) nor a file: give one of them.")
    if path.suffix != GRASPS:
        return import_object(path, labels=args.labels, scale=args.scale, units=args.units), None
    name = GraspCandidates.load(path).object
    if args.mesh is not None:
        obj = import_object(args.mesh, labels=args.labels, scale=args.scale, units=args.units)
    elif name in available_objects():
        obj = load_object(name)
    else:
        raise InputError(f"{path} holds grasps of {name!r}: give its mesh with --mesh, and --labels if it has any.")
    return obj, GraspCandidates.load(path, obj, robot)


def main() -> int:
    """Serve the page until Ctrl-C; returns the exit status."""
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    try:
        if args.source is None and args.pictures is not None:
            print(write_objects(args.pictures))
            return 0
        obj, candidates = content(args)
        if args.pictures is not None:
            print(*write_album(obj, candidates, load_robot(args.robot), args.pictures), sep="\n")
            return 0
        page = GraspPage(obj, candidates, load_robot(args.robot), args.port, args.host)
    except InputError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    print(page.url, flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        page.server.stop()
    return 0
