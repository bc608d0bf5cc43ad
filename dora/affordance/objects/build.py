"""Write the folders of objects that are modelled here, or that of a user's mesh.

python -m dora.affordance.objects.build                 # all models, into objects/
python -m dora.affordance.objects.build objects/jug     # the model of that name
python -m dora.affordance.objects.build my/mug --mesh mug.stl --units mm --labels mug.yaml --mass 0.35
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import own_objects
from dora.affordance.objects.folder_writing import check_object_folder, write_object_folder
from dora.affordance.objects.importing import import_mesh
from dora.affordance.objects.models import cube, hammer, jug, microwave
from dora.errors import InputError, command
from dora.quiet_start import show_any_script

MODELS: dict[str, Callable[[], AffordanceObject]] = {
    "cube": cube.build, "hammer": hammer.build, "jug": jug.build, "microwave": microwave.build,
}  # fmt: skip
"""What makes each object that is modelled here."""


@dataclass
class Args:
    """Write the folders of objects."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders to write, named as the objects (default: all models, into objects/)."""
    mesh: Path | None = None
    """Your own mesh instead of a model: OBJ, STL, PLY, GLB, glTF, OFF or 3MF, closed or nearly so."""
    labels: Path | None = None
    """Regions of --mesh: a file with one label per face, or a YAML of boxes and planes (docs/objects.md in
    the project)."""
    units: Literal["m", "cm", "mm", "in"] = "m"
    """Unit of length of --mesh; GLB files are in metres."""
    scale: float = 1.0
    """Factor of all lengths of --mesh."""
    mass: float | None = None
    """Mass of --mesh [kg] (default: an estimate from its geometry; docs/objects.md in the project has the rule)."""
    density: float | None = None
    """Density of the material of --mesh [kg/m^3], in the place of --mass."""


def model(name: str) -> AffordanceObject:
    """An object that is modelled here, made anew.

    Raises:
        InputError: there is no model of that name.
    """
    if name not in MODELS:
        raise InputError(f"there is no model of {name!r}; name the folder as one of: {', '.join(MODELS)}.")
    return MODELS[name]()


def run(args: Args) -> list[Path]:
    """Write what is asked for; returns the paths of the object.toml files.

    Raises:
        InputError: unknown model, a mesh without a single folder, or as `import_mesh`.
    """
    if args.mesh is None:
        given = (args.labels, args.mass, args.density)
        if any(value is not None for value in given) or args.units != "m" or args.scale != 1:
            raise InputError("--labels, --units, --scale, --mass and --density belong to --mesh: give that as well.")
        folders = args.folders or [own_objects() / name for name in MODELS]
        return [write_object_folder(model(folder.resolve().name), folder) for folder in folders]
    if len(args.folders) != 1:
        raise InputError("--mesh needs the one folder to write, for example: build my/mug --mesh mug.stl.")
    check_object_folder(args.folders[0], args.mesh, args.labels)
    found = import_mesh(
        args.mesh, labels=args.labels, scale=args.scale, units=args.units, mass=args.mass, density=args.density
    )
    print(*found.lines(), sep="\n", file=sys.stderr)
    return [write_object_folder(found.object, args.folders[0])]


@command
def main() -> int:
    """Run the command; returns the exit status."""
    show_any_script()
    args = tyro.cli(Annotated[Args, tyro.conf.arg(name="")], description=__doc__)
    print(*run(args), sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
