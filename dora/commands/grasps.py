"""Generate grasps of an object, judge them, and store them.

    python experiments/grasps.py --object jug --num 256 --validate sapien --out runs/jug.safetensors
    python experiments/grasps.py --object my/mug                 # the folder of an object of your own
    python experiments/grasps.py --mesh mug.glb --labels mug.yaml --units mm --region handle

Prints a table with baselines beside it (searches without E_DFC, without closing the hand around the object, and of one
iteration), and writes OUT (safetensors) and a .json beside it. `experiments/view.py OUT` shows the grasps.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dora.affordance.contact_maps import map_bundled_set
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.objects.importing import import_object
from dora.affordance.search.backends import Kinematics
from dora.configs import check_ranges
from dora.errors import InputError
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim.grasp_tests.bundle_maker import make_bundle
from dora.sim.grasp_tests.generation import baselines, by_region, generate, summary, voting_summary
from dora.sim.grasp_tests.report import check_out, print_agreement, print_report, write_report
from dora.tools.task_ranking import rank_bundled_set, tasks_of, usable_in_task

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
BAD_INPUT = 2
"""Exit status after an `InputError`."""
RANGES = {
    "num": (1, 100_000),
    "seed": (0, 2**31 - 1),
    "baselines": (0, 100_000),
    "by_region": (0, 100_000),
    "scale": (1e-9, 1e9),
}
"""Lowest and highest value of options."""
ANY = "any"
"""Value of --region for a search without a region."""


@dataclass
class Args:
    """Generate grasps of an object (--object) or of a mesh (--mesh)."""

    object: str | None = None
    """Name of an object in objects/ or in a folder of DORA_OBJECTS, or the path of an object's folder or mesh."""
    mesh: Path | None = None
    """Your own mesh: OBJ, STL, PLY or GLB, closed or nearly so."""
    labels: Path | None = None
    """Regions of --mesh: a file with one label per face, or a YAML of boxes and planes (docs/objects.md)."""
    num: int = 256
    """Candidates to search for."""
    seed: int = 0
    """Seed of all random draws."""
    region: str | None = None
    """Region to hold, or "any" (default: the target of --object, any of --mesh)."""
    scale: float = 1.0
    """Factor of all lengths of --mesh."""
    units: Literal["m", "cm", "mm", "in"] = "m"
    """Unit of length of --mesh; GLB files are in metres."""
    robot: str = "diana7_hit"
    """Robot whose hand grasps: a folder name in robots/ or a path."""
    out: Path | None = None
    """File to write (default runs/grasps/<object>.safetensors); the report goes beside it as .json."""
    validate: Literal["none", "sapien"] = "none"
    """Close the hand and pull along six directions in SAPIEN, or only measure penetration."""
    baselines: int = 64
    """Candidates of each baseline; 0 leaves the baselines out."""
    kinematics: Kinematics = "compiled"
    """Search in compiled loops, or by automatic differentiation through pytorch_kinematics (slower)."""
    by_region: int = 0
    """Candidates of a search for each other region and of a free one, simulated as well: how often each region is held
    with and without asking for it, and how well the vote tells (needs --validate sapien)."""
    make_bundle: bool = False
    """Make the bundled set of --object instead, grasps.safetensors in its folder: enough valid grasps, ranked by
    simulated lifts or holds; then what --rank-in-task does, where a task uses the object."""
    any_region: bool = False
    """With --make-bundle or --rank-in-task: the set of a search that knows no region, which guidance "grasps" uses."""
    rank_in_task: bool = False
    """Execute the bundled set of --object in the task that uses it, and rank it by the episodes that succeed."""
    contact_maps: bool = False
    """Make the contact semantic maps of the bundled set of --object anew, and print what they vote for."""


def target(args: Args) -> tuple[AffordanceObject, str | None]:
    """The object, and the region to hold (None: any)."""
    if (args.object is None) == (args.mesh is None):
        raise InputError("Give either --object or --mesh, for example --object jug.")
    if args.by_region and args.validate == "none":
        raise InputError(f"--by-region is {args.by_region}: give --validate sapien with it, or leave it out.")
    if args.object is not None:
        if args.labels is not None or args.scale != 1 or args.units != "m":
            raise InputError("--labels, --scale and --units belong to --mesh: leave them out with --object.")
        obj = load_object(args.object)
        return obj, region_of(obj, args.region or obj.target)
    assert args.mesh is not None
    obj = import_object(args.mesh, labels=args.labels, scale=args.scale, units=args.units)
    return obj, region_of(obj, args.region or ANY)


def region_of(obj: AffordanceObject, region: str) -> str | None:
    """A region that the object has; None for any."""
    if region == ANY:
        return None
    obj.label_index(region)
    return region


def run(args: Args) -> None:
    """Generate, print and write."""
    obj, region = target(args)
    robot = load_robot(args.robot)
    out = args.out or Path("runs") / "grasps" / f"{obj.name}.safetensors"
    check_out(out)
    simulate = args.validate == "sapien"
    with ProgressDisplay() as phases:
        generated = generate(obj, robot, args.num, args.seed, region, phases, simulate, kinematics=args.kinematics)
        report = summary(generated) | {"kinematics": args.kinematics}
        searches = {}
        if args.by_region:
            searches = by_region(obj, robot, args.by_region, args.seed, region, phases, args.kinematics)
            report["by_region"] = {name: summary(found) for name, found in searches.items()}
        if simulate:
            report["voting"] = voting_summary([generated, *searches.values()], obj)
        if args.baselines:
            report["baselines"] = baselines(
                obj, robot, args.baselines, args.seed, region, phases, simulate, args.kinematics
            )
    print_report(report)
    write_report(report, generated.candidates, out)
    print(out)


def remake(args: Args) -> None:
    """Make or rank the bundled set of an object, or make its contact maps anew."""
    if args.object is None or args.mesh is not None:
        raise InputError(
            "--make-bundle, --rank-in-task and --contact-maps need --object, for example --object jug, and no --mesh."
        )
    if args.kinematics != "compiled":
        raise InputError(f"--kinematics {args.kinematics} is for searches, not for --make-bundle or --rank-in-task.")
    name = args.object
    if args.contact_maps and not (args.make_bundle or args.rank_in_task):
        path, agreement = map_bundled_set(name)
        print_agreement(agreement)
        print(path)
        return
    ids = tasks_of(load_object(name))
    with ProgressDisplay() as phases:
        if args.make_bundle:
            print(make_bundle(name, args.seed, phases, usable_in_task(name), not args.any_region))
        if args.rank_in_task or ids:
            print(rank_bundled_set(name, lambda title: phases.phase(title, "episodes"), not args.any_region))


def main() -> int:
    """Run the command; returns the exit status."""
    description = f"{__doc__}\nObjects: {', '.join(available_objects())}."
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=description)
    try:
        check_ranges(args, RANGES, lambda name: f"--{name.replace('_', '-')}")
        if args.make_bundle or args.rank_in_task or args.contact_maps:
            remake(args)
        else:
            run(args)
    except InputError as error:
        print(error, file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("Interrupted; nothing was written.", file=sys.stderr)
        return INTERRUPTED
    return 0
