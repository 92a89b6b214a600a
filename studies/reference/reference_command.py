"""The command ``reference``: a bead experiment for ``validate``, computed by finite elements."""

from pathlib import Path

import click
import numpy as np
import trimesh

from rehearsal.commands.command_line import CommandError, make_folder
from scenes.anatomy import load_anatomy
from scenes.scene import PAPER, load_scene
from studies.study import number_option


@click.command()
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder to write the case to.")
@number_option(
    "--edge",
    "edge_mm",
    low=2,
    high=10,
    default=2.5,
    help="Length in mm of the elements' edges by the transducer.",
)
def reference(out: Path, edge_mm: float) -> None:
    """Make a bead experiment by finite elements, for `validate`.

    It presses the embedded patient's kidney.
    """
    make_folder(out)
    try:
        from studies.reference.equilibrium import NotConvergedError
        from studies.reference.fem_solid import MeshError
        from studies.reference.make_reference import make_reference
    except ImportError as error:
        raise CommandError(
            f"the reference needs {error.name}, which is not installed: pip install -r requirements-dev.txt"
        ) from None
    scene = load_scene(PAPER)
    anatomy = load_anatomy(scene, PAPER.parent)
    support = anatomy.shapes[0]
    assert isinstance(support, trimesh.Trimesh)
    try:
        gravity = np.array(scene.gravity.direction)
        case = make_reference(anatomy.organ, support, gravity, edge_mm, click.echo)
    except (MeshError, NotConvergedError) as error:
        raise CommandError(
            f"no reference with edges of {edge_mm:g} mm: {error}; try another --edge"
        ) from None
    try:
        case.write(out)
    except OSError as error:
        raise CommandError(f"{out}: cannot be written to ({error.strerror}); choose another --out") from None
    click.echo(case.summary())
