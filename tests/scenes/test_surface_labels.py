"""Surfaces as labels: the voxels are where the surface is, whatever its format, its coordinate system and
the way it faces.
"""

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from synthetic_body import DIRECTIONS, TUMOUR, grid_around

from scenes.patients.import_request import import_request
from scenes.patients.organ_support import bed_of_file
from scenes.patients.readers.label_files import open_labels
from scenes.volumes.voxel_grid import VoxelGrid

# A CT of slices 5 mm thick; its x and y are not the same as seen from 0, so that RAS is not inside it where
# LPS is.
THICK = VoxelGrid.of(grid_around((20, -20, -80), (180, 120, 90), (0.9, 0.8, 5.0), DIRECTIONS["oblique"]))
RADIUS = 9.0


def ellipsoid(centre, axes, subdivisions=3):
    ball = trimesh.creation.icosphere(subdivisions)
    return trimesh.Trimesh(ball.vertices * axes + centre, ball.faces, process=False)


def ball(x=0.0, radius=RADIUS):
    return ellipsoid(TUMOUR[0] + [x, 0, 0], np.full(3, radius))


def inverted(surface):
    return trimesh.Trimesh(surface.vertices, surface.faces[:, ::-1], process=False)


def together(*surfaces):
    return trimesh.util.concatenate(surfaces)


def written(path, surface, head="3D Slicer output. SPACE=LPS", turn=(1.0, 1.0, 1.0)):
    """A surface file by its suffix, with a text in its header as 3D Slicer writes it, or none."""
    vertices, faces = surface.vertices * turn, surface.faces
    moved = trimesh.Trimesh(vertices, faces, process=False)
    kind = path.suffix[1:]
    if path.name.endswith("ascii.stl"):
        text = moved.export(file_type="stl_ascii").split("\n", 1)[1]
        path.write_text(f"solid {head}\n{text}")
    elif kind == "stl":
        path.write_bytes(head.encode().ljust(80, b"\0") + moved.export(file_type="stl")[80:])
    elif kind == "ply":
        magic, rest = moved.export(file_type="ply").split(b"\n", 1)
        rest = b"\n".join(line for line in rest.split(b"\n", 3) if not line.startswith(b"comment"))
        path.write_bytes(b"\n".join([magic, b"comment " + head.encode(), rest]))
    elif kind == "obj":
        # A place in a texture for each corner, as for a painted surface: no two triangles share one.
        lines = [f"# {head}", "mtllib ../secret.mtl", *(f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices)]
        lines += [f"vt {n % 7 / 7} {n % 5 / 5}" for n in range(3 * len(faces))]
        lines += [
            "f " + " ".join(f"{v + 1}/{3 * n + k + 1}" for k, v in enumerate(face))
            for n, face in enumerate(faces)
        ]
        path.write_text("\n".join(lines) + "\n")
    return path


def measured(label_map, value=1):
    """Volume [mm^3] and centroid [mm] of a label, as ITK measures them."""
    shape = sitk.LabelShapeStatisticsImageFilter()
    shape.Execute(label_map.grid.image((label_map.values == value).astype(np.uint8)))
    return shape.GetPhysicalSize(1), np.array(shape.GetCentroid(1))


def labels_of(path, ct=THICK):
    return open_labels(path).maps(ct)


def assert_is(path, volume, centre, ct=THICK):
    (one,) = labels_of(path, ct)
    found, middle = measured(one)
    assert found == pytest.approx(volume, rel=0.01)
    assert np.abs(middle - centre).max() < 0.5 * one.grid.spacing.max()


def test_a_support_states_its_coordinate_system(tmp_path):
    organ = ball()
    under = ellipsoid(TUMOUR[0] + [0, 31.0, 0], np.array([30.0, 18.0, 30.0]))
    bed = bed_of_file(
        written(tmp_path / "bed.stl", under, "SPACE=RAS", (-1, -1, 1)), organ, np.array([0, 1.0, 0])
    )
    np.testing.assert_allclose(bed.center_mass, under.center_mass, atol=1e-3)


def test_an_import_of_surfaces(tmp_path, monkeypatch):
    """From files to the organ that is taken; its surface is made elsewhere."""
    given = {}

    def watched(volume, labels, organ, side, **_):
        given.update(labels=labels)
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.patients.import_request.import_patient", watched)
    ct = THICK.image(np.zeros(THICK.size[::-1], np.int16))
    sitk.WriteImage(ct, str(tmp_path / "ct.nrrd"))
    files = [
        written(tmp_path / f"{name}.stl", surface) for name, surface in {"a": ball(25.0), "b": ball()}.items()
    ]
    with pytest.raises(KeyboardInterrupt):
        import_request(tmp_path / "ct.nrrd", files, ["a"], {"tumour": ["b"]})
    tissues = [s.tissue for s in given["labels"].segments.values()]
    assert sorted(tissues) == ["kidney", "tumour"]
