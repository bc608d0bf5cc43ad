"""Generate grasps of an object, judge them, and store them.

    dora grasps --object jug --num 256 --validate sapien --out runs/jug.safetensors
    dora grasps --object my/mug                 # the folder of an object of your own
    dora grasps --mesh mug.glb --labels mug.yaml --units mm --region handle

Prints a table with baselines beside it (searches without E_DFC, without closing the hand around the object, and of one
iteration), and writes OUT (safetensors) and a .json beside it. `dora view OUT` shows the grasps.
"""

import sys
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import map_bundled_set
from dora.affordance.maps.affordance_map import COUNT
from dora.affordance.maps.packed_maps import MOST_CELLS
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.objects.importing import import_mesh, size_in_words
from dora.affordance.search.backends import Kinematics
from dora.affordance.search.optimise import Settings
from dora.arguments import LARGEST_SEED
from dora.configs import check_ranges
from dora.errors import InputError, command
from dora.progress import ProgressDisplay
from dora.quiet_start import show_any_script
from dora.robot import load_robot
from dora.sim.grasp_tests.bundle_maker import make_bundle
from dora.sim.grasp_tests.failures import hint
from dora.sim.grasp_tests.generation import baselines, by_region, generate, summary, voting_summary
from dora.sim.grasp_tests.report import check_out, print_agreement, print_report, write_report
from dora.tools.in_task.ranking import rank_bundled_set, tasks_of, usable_in_task
from dora.tools.in_task.refining import refine_bundled_set

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
RANGES = {
    "num": (1, MOST_CELLS // COUNT),
    "seed": (0, LARGEST_SEED),
    "baselines": (0, 100_000),
    "by_region": (0, 100_000),
    "scale": (1e-9, 1e9),
}
"""Lowest and highest value of options."""
TAKEN = {
    "make_bundle": ("seed", "seat", "any_region"),
    "rank_in_task": ("any_region",),
    "refine_in_task": ("seat", "any_region"),
    "contact_maps": (),
}
"""What takes no options of searches, and the options that it does take beside --object."""
SHOWN = 5
"""Number of scores that are printed of a ranked set."""
ANY = "any"
"""Value of --region for a search without a region."""


@dataclass
class Args:
    """Generate grasps of an object (--object) or of a mesh (--mesh)."""

    object: str | None = None
    """Name of an object in objects/ or in a folder of DORA_OBJECTS, or the path of an object's folder or mesh."""
    mesh: Path | None = None
    """Your own mesh: OBJ, STL, PLY, GLB, glTF, OFF or 3MF, closed or nearly so."""
    labels: Path | None = None
    """Regions of --mesh: a file with one label per face, or a YAML of boxes and planes (docs/objects.md in
    the project)."""
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
    mass: float | None = None
    """Mass of --mesh [kg] (default: an estimate from its geometry, which is printed; docs/objects.md in the
    project has the rule)."""
    density: float | None = None
    """Density of the material of --mesh [kg/m^3], in the place of --mass."""
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
    seat: float = Settings.seat
    """Angle by which the hand is closed around the object after the search [rad]; 0 leaves this out, for objects that
    the palm would press onto a table."""
    by_region: int = 0
    """Candidates of a search for each other region and of a free one, simulated as well: how often each region is held
    with and without asking for it, and how well the vote tells (needs --validate sapien)."""
    make_bundle: bool = False
    """Make the bundled set of --object instead, grasps.safetensors in its folder: enough valid grasps, ranked by
    simulated lifts or holds; then what --rank-in-task does, where a task uses the object."""
    any_region: bool = False
    """With --make-bundle, --rank-in-task or --refine-in-task: the set of a search that knows no region, which guidance
    "grasps" uses."""
    rank_in_task: bool = False
    """Execute the bundled set of --object in the task that uses it, and rank it by the episodes that succeed."""
    refine_in_task: bool = False
    """Search near the best grasps of the bundled set of --object, execute what is found in the task, and keep the
    best."""
    contact_maps: bool = False
    """Make the contact semantic maps of the bundled set of --object anew, and print what they vote for."""


@dataclass(frozen=True, eq=False)
class Target:
    """The object, the region to hold (None: any), lines about the object, and whether its mass is an estimate."""

    obj: AffordanceObject
    region: str | None
    lines: tuple[str, ...]
    assumed: bool


def target(args: Args) -> tuple[AffordanceObject, str | None]:
    """The object, and the region to hold (None: any)."""
    found = described_target(args)
    return found.obj, found.region


def described_target(args: Args) -> Target:
    """What to search grasps for, and what is known of it."""
    if (args.object is None) == (args.mesh is None):
        raise InputError("Give either --object or --mesh, for example --object jug.")
    if args.by_region and args.validate == "none":
        raise InputError(f"--by-region is {args.by_region}: give --validate sapien with it, or leave it out.")
    if args.object is not None:
        given = (args.labels, args.mass, args.density)
        if any(value is not None for value in given) or args.scale != 1 or args.units != "m":
            raise InputError(
                "--labels, --scale, --units, --mass and --density belong to --mesh: leave them out with --object."
            )
        obj = load_object(args.object)
        assumed = obj.folder is None
        line = f"{obj.name}: {size_in_words(obj)}, {obj.mass:.3g} kg{' assumed' if assumed else ''}"
        return Target(obj, region_of(obj, args.region or obj.target), (line,), assumed)
    assert args.mesh is not None
    if args.mass is not None and args.density is not None:
        raise InputError("--mass and --density exclude each other: give one of them.")
    found = import_mesh(
        args.mesh, labels=args.labels, scale=args.scale, units=args.units, mass=args.mass, density=args.density
    )
    region = region_of(found.object, args.region or ANY)
    return Target(found.object, region, found.lines(), found.weighing.assumed)


def region_of(obj: AffordanceObject, region: str) -> str | None:
    """A region that the object has; None for any."""
    if region == ANY:
        return None
    region = unicodedata.normalize("NFC", region) if region not in obj.labels else region
    obj.label_index(region)
    return region


def run(args: Args) -> None:
    """Generate, print and write."""
    if args.any_region:
        which = "--make-bundle, --rank-in-task or --refine-in-task"
        raise InputError(f"--any-region goes with {which}: a search takes --region any.")
    wanted = described_target(args)
    obj, region = wanted.obj, wanted.region
    robot = load_robot(args.robot)
    out = args.out or Path("runs") / "grasps" / f"{obj.name}.safetensors"
    check_out(out)
    simulate, settings = args.validate == "sapien", Settings(seat=args.seat)
    print(*wanted.lines, sep="\n", flush=True)
    with ProgressDisplay() as phases:
        generated = generate(
            obj, robot, args.num, args.seed, region, phases, simulate, settings, kinematics=args.kinematics
        )
        report: dict[str, Any] = summary(generated) | {"kinematics": args.kinematics} | about(wanted)
        report["failures"]["hint"] = hint(report["failures"], obj, wanted.assumed)
        searches = {}
        if args.by_region:
            searches = by_region(obj, robot, args.by_region, args.seed, region, phases, args.kinematics, settings)
            report["by_region"] = {name: summary(found) for name, found in searches.items()}
        if simulate:
            report["voting"] = voting_summary([generated, *searches.values()], obj)
        if args.baselines:
            report["baselines"] = baselines(
                obj, robot, args.baselines, args.seed, region, phases, simulate, args.kinematics, settings
            )
    print_report(report)
    write_report(report, generated.candidates, out)
    print(out)


def about(wanted: Target) -> dict[str, Any]:
    """Mass, size and notes as values for JSON."""
    size = [100 * side for side in wanted.obj.mesh.extents.tolist()]
    return {
        "mass_kg": wanted.obj.mass,
        "mass_assumed": wanted.assumed,
        "size_cm": size,
        "notes": list(wanted.lines),
    }


def print_ranked(paths: Sequence[Path]) -> None:
    """Files of sets, with what their ranking took and its best scores."""
    for path in paths:
        found = GraspCandidates.load(path)
        best = ", ".join(f"{score:.2f}" for score in found.score[:SHOWN].tolist())
        print(f"{path}\n  ranked by {found.ranking_steps:,} control steps of the task; scores of the best: {best}")


def remake(args: Args) -> None:
    """Make, rank or refine the bundled set of an object, or make its contact maps anew."""
    asked = [f"--{name.replace('_', '-')}" for name in TAKEN]
    if args.object is None or args.mesh is not None:
        raise InputError(f"{', '.join(asked)} need --object, for example --object jug, and no --mesh.")
    given = [name for name in TAKEN if getattr(args, name)]
    if args.contact_maps and len(given) > 1:
        raise InputError("--contact-maps goes alone: sets that are made, ranked or refined get their maps anyway.")
    used = {option for name in given for option in TAKEN[name]}
    for field in fields(args):
        if field.name not in ("object", *TAKEN, *used) and (value := getattr(args, field.name)) != field.default:
            option = f"--{field.name.replace('_', '-')}"
            raise InputError(f"{option} {value} is for searches, not for {', '.join(asked)}: leave it out.")
    name = args.object
    if args.contact_maps:
        path, agreement = map_bundled_set(name)
        print_agreement(agreement)
        print(path)
        return
    ids = tasks_of(load_object(name))
    with ProgressDisplay() as phases:
        if args.make_bundle:
            usable, settings = usable_in_task(name), Settings(seat=args.seat)
            print(make_bundle(name, args.seed, phases, usable, not args.any_region, settings))
        if args.rank_in_task or (args.make_bundle and ids):
            print_ranked(rank_bundled_set(name, lambda title: phases.phase(title, "episodes"), not args.any_region))
        if args.refine_in_task:
            print_ranked(refine_bundled_set(name, phases, not args.any_region, Settings(seat=args.seat)))


@command
def main() -> int:
    """Run the command; returns the exit status."""
    description = f"{__doc__}\nObjects: {', '.join(available_objects())}."
    show_any_script()
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=description)
    try:
        check_ranges(args, RANGES, lambda name: f"--{name.replace('_', '-')}")
        if any(getattr(args, name) for name in TAKEN):
            remake(args)
        else:
            run(args)
    except KeyboardInterrupt:
        print("Interrupted; nothing was written but what is named above.", file=sys.stderr)
        return INTERRUPTED
    return 0
