"""Show an object, its regions and its grasps on a web page.

    dora view jug                                  # an object with its bundled grasps
    dora view runs/grasps/jug.safetensors          # what dora grasps wrote
    dora view my/mug                               # the folder of an object of your own
    dora view mug.glb --labels mug.yaml            # the regions of your own mesh
    dora view runs/grasps/mug.safetensors --mesh mug.glb --labels mug.yaml
    dora view jug --pictures runs/pictures         # PNG files instead of a page
    dora view --pictures runs/pictures             # one PNG of all objects

Runs until Ctrl-C.
"""

import os
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dora.affordance.bundled_sets import GRASPS_FILE
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.objects.importing import import_object
from dora.affordance.views.album import write_album, write_objects
from dora.affordance.views.page import GraspPage
from dora.configs import check_ranges
from dora.errors import InputError, command
from dora.quiet_start import show_any_script
from dora.robot import RobotDescription, load_robot

RANGES = {"port": (1, 65_535), "scale": (1e-9, 1e9)}
"""Lowest and highest value of options."""
FOR_MESHES = ("labels", "scale", "units")
"""Options for a mesh file."""
GRASPS = ".safetensors"
"""Suffix of a file of grasps."""


@dataclass
class Args:
    """Show an object, its regions and its grasps on a web page."""

    source: tyro.conf.Positional[str | None] = None
    """Name of an object, the path of an object's folder, a file of grasps (.safetensors) or a mesh file; none with
    --pictures: all objects that have a name."""
    port: int = 8080
    """TCP port of the page."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines see the page."""
    mesh: Path | None = None
    """Mesh, or folder of the object, of a file of grasps whose object has no name in objects/ or DORA_OBJECTS."""
    labels: Path | None = None
    """Regions of the mesh, as for `dora grasps`."""
    scale: float = 1.0
    """Factor of all lengths of --mesh."""
    units: Literal["m", "cm", "mm", "in"] = "m"
    """Unit of length of --mesh; GLB files are in metres."""
    pictures: Path | None = None
    """Folder: write PNGs of regions, of four grasps and of their contact semantic maps there, or one of all objects
    (objects.png), and serve no page."""
    robot: str = "diana7_hit"
    """Robot whose hand is shown: a folder name in robots/ or a path."""


def changed(args: Args, names: Iterable[str]) -> list[str]:
    """Which of some options have another value than if they are left out."""
    return [name for name in names if getattr(args, name) != getattr(Args, name)]


def content(args: Args) -> tuple[AffordanceObject, GraspCandidates | None]:
    """The object to show and its grasps, if there are any."""
    robot = load_robot(args.robot)
    if args.source is None:
        raise InputError("Say what to show: an object, a file of grasps or a mesh file, for example jug.")
    path = Path(args.source)
    if path.suffix != GRASPS or args.source in available_objects():
        if args.mesh is not None:
            raise InputError(f"--mesh belongs to a file of grasps ({GRASPS}), and {args.source} is none: leave it out.")
        return with_bundle(opened(args, args.source), robot)
    name = GraspCandidates.load(path).object
    if args.mesh is not None:
        obj = opened(args, str(args.mesh))
    elif name in available_objects():
        if changed(args, FOR_MESHES):
            raise InputError(f"--labels, --scale and --units belong to --mesh: give it with {path}, or leave them out.")
        obj = load_object(name)
    else:
        raise InputError(f"{path} holds grasps of {name!r}: give its mesh with --mesh, and --labels if it has any.")
    return obj, GraspCandidates.load(path, obj, robot)


def opened(args: Args, source: str) -> AffordanceObject:
    """An object by its name or folder, or from a mesh file with the options for meshes."""
    if os.path.isfile(source) and source not in available_objects():
        return import_object(source, labels=args.labels, scale=args.scale, units=args.units)
    if changed(args, FOR_MESHES):
        raise InputError(f"--labels, --scale and --units belong to a mesh, and {source} is none: leave them out.")
    return load_object(source)


def with_bundle(obj: AffordanceObject, robot: RobotDescription) -> tuple[AffordanceObject, GraspCandidates | None]:
    """An object and the grasps in its folder, if there are any."""
    path = None if obj.folder is None else obj.folder / GRASPS_FILE
    return obj, None if path is None or not os.path.isfile(path) else GraspCandidates.load(path, obj, robot)


@command
def main() -> int:
    """Serve the page until Ctrl-C; returns the exit status."""
    description = f"{__doc__}\nObjects: {', '.join(available_objects())}."
    show_any_script()
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=description)
    check_ranges(args, RANGES, lambda name: f"--{name}")
    if args.source is None and args.pictures is not None:
        if given := changed(args, (*FOR_MESHES, "mesh", "robot")):
            raise InputError(f"--{given[0]} has no effect on a picture of all objects: name one, or leave it out.")
        print(write_objects(args.pictures))
        return 0
    obj, candidates = content(args)
    if args.pictures is not None:
        print(*write_album(obj, candidates, load_robot(args.robot), args.pictures), sep="\n")
        return 0
    page = GraspPage(obj, candidates, load_robot(args.robot), args.port, args.host)
    print(page.url, flush=True)
    try:
        threading.Event().wait()
    finally:
        page.server.stop()
    return 0
