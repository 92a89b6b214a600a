"""Surfaces as labels: the voxels are where the surface is, whatever its format, its coordinate system and the way it faces."""

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from dicom_series import refusal
from synthetic_body import DIRECTIONS, LEFT, TUMOUR, grid_around

from scenes.patients.import_request import import_request
from scenes.patients.organ_support import bed_of_file
from scenes.patients.readers import surface_labels
from scenes.patients.readers.label_files import open_labels
from scenes.patients.readers.label_maps import merge_label_maps
from scenes.surfaces import save_surface
from scenes.volumes.voxel_grid import VoxelGrid

# A CT of slices 5 mm thick; its x and y are not the same as seen from 0, so that RAS is not inside it where LPS is.
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


@pytest.mark.parametrize("name", ["tumour.stl", "tumour-ascii.stl", "tumour.ply", "tumour.obj", "Tumour.STL"])
@pytest.mark.parametrize("space", ["LPS", "RAS", None])
def test_each_format_in_each_coordinate_system(tmp_path, name, space):
    turn = (-1.0, -1.0, 1.0) if space == "RAS" else (1.0, 1.0, 1.0)
    head = f"3D Slicer output. SPACE={space}" if space else "made by hand"
    path = written(tmp_path / name.lower(), ball(), head, turn).rename(tmp_path / name)
    assert_is(path, ball().volume, TUMOUR[0])
    found = open_labels(path)
    assert found.notes == (
        () if space else ("surfaces that state no coordinate system were taken as LPS: 1",)
    )
    (one,) = found.maps(THICK)
    assert [s.tissue for s in one.segments.values()] == ["tumour"]


def test_a_kidney_and_its_tumour_in_a_folder(tmp_path):
    """On one grid, in voxels far smaller than the CT's; also what is small and thin keeps its volume."""
    kidney, vein = ellipsoid(*LEFT), ellipsoid(LEFT[0] - [30, 0, 0], np.array([20.0, 3.0, 3.0]))
    for name, surface in {"kidney_left": kidney, "tumour": ball(), "renal_vein": vein}.items():
        save_surface(surface, tmp_path / f"{name}.stl")
    (tmp_path / "brain.stl").write_bytes(b"never read")
    found = open_labels(tmp_path)
    assert found.notes == () and found.identifiers == {}
    maps = found.maps(THICK)
    of = {s.tissue: (one, measured(one)) for one in maps for s in one.segments.values()}
    for tissue, surface in {"kidney": kidney, "tumour": ball(), "vein": vein}.items():
        one, (volume, middle) = of[tissue]
        assert volume == pytest.approx(surface.volume, rel=0.01), tissue
        assert np.abs(middle - surface.center_mass).max() < 0.5 * one.grid.spacing.max()
    merged = merge_label_maps(maps)
    (tumour,) = merged.of_tissues("tumour")
    assert measured(merged, tumour)[0] == pytest.approx(ball().volume, rel=0.01)
    assert "brain.stl: has no triangles" in refusal(
        tmp_path, read=lambda path: open_labels(path, ["Brain"]), name="brain.stl"
    )


BODIES = {
    "inverted": (inverted(ball()), 1.0),
    "two bodies": (together(ball(), ball(25.0)), 2.0),
    "two bodies, one inverted": (together(ball(), inverted(ball(25.0))), 2.0),
    "hollow": (together(ball(), inverted(ball(0, 6.0))), 1 - (6 / RADIUS) ** 3),
    "hollow, all inverted": (together(inverted(ball()), ball(0, 6.0)), 1 - (6 / RADIUS) ** 3),
    "a body in a hollow": (
        together(ball(), inverted(ball(0, 7.0)), ball(0, 4.0)),
        1 - (7 / RADIUS) ** 3 + (4 / RADIUS) ** 3,
    ),
}


@pytest.mark.parametrize(("surface", "share"), BODIES.values(), ids=BODIES)
def test_bodies_in_one_file(tmp_path, surface, share):
    path = written(tmp_path / "tumour.stl", surface)
    two = share == 2.0
    assert_is(path, share * ball().volume, TUMOUR[0] + [12.5 * two, 0, 0])


def test_the_box_of_a_long_thin_structure_has_a_limit_of_voxels(tmp_path, monkeypatch):
    """Of two balls far apart, so that their box is large for their volume."""
    written(
        tmp_path / "vessels.stl", together(ball(), ellipsoid(TUMOUR[0] + [60, 60, 60], np.full(3, RADIUS)))
    )
    most = 200_000
    monkeypatch.setattr(surface_labels, "MOST_VOXELS", most)
    (found,) = open_labels(tmp_path / "vessels.stl").maps(THICK)
    # A voxel more along each axis.
    assert (
        0.9 * most < np.prod(np.array(found.grid.size) + 1) and np.prod(np.array(found.grid.size) - 1) < most
    )
    assert measured(found)[0] == pytest.approx(2 * 4 / 3 * np.pi * RADIUS**3, rel=0.02)


def without(surface, faces):
    return trimesh.Trimesh(surface.vertices, np.delete(surface.faces, faces, axis=0), process=False)


def turned_over(surface, face):
    faces = np.array(surface.faces)
    faces[face] = faces[face, ::-1]
    return trimesh.Trimesh(surface.vertices, faces, process=False)


AT = ", ".join(f"{c:.1f}" for c in ball().triangles_center[7])
REFUSED = {
    "open": ("tumour", without(ball(), 7), rf"is not closed.* at 1 places, .*around \({AT}\)"),
    "two openings": ("tumour", without(ball(), [7, 900]), "at 2 places"),
    "a triangle turned over": ("tumour", turned_over(ball(), 7), rf"face both ways, at 1 places, .*\({AT}\)"),
    "a sheet": ("tumour", trimesh.Trimesh(np.eye(3) * 20, [[0, 1, 2]]), "is not closed"),
    "metres": ("tumour", ellipsoid(TUMOUR[0] / 1000, np.full(3, 0.009)), "0.018 mm long; expected mm, .* be metres"),
    "a kidney in metres": ("kidney_left", ellipsoid(LEFT[0] / 1e3, LEFT[1] / 1e3), "0.09 mm long.* be metres"),
    "a kidney in cm": ("kidney_left", ellipsoid(LEFT[0] / 10, LEFT[1] / 10), "9 mm long; .* centimetres; scale"),
    "micrometres": ("tumour", ellipsoid(TUMOUR[0] * 1e3, np.full(3, 9e3)), "micrometres"),
    "two bodies in one another": ("tumour", together(ball(), ball(5.0)), "inside two bodies that face the same way"),
    "a hollow that faces outward": ("tumour", together(ball(), ball(0, 6.0)), "a hollow in it facing inward"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "surface", "words"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_closed_surface_in_mm_is_refused(tmp_path, name, surface, words):
    path = written(tmp_path / f"{name}.ply", surface)
    with pytest.raises(Exception, match=words):
        labels_of(path)
    refusal(path, read=labels_of)


@pytest.mark.parametrize(
    ("head", "turn", "words"),
    [
        ("by hand", -1.0, "0% of its surface in the CT as LPS, as was assumed, and 100% as RAS"),
        ("SPACE=LPS", -1.0, "as LPS, as it states, and 100% as RAS.*SPACE=RAS"),
        ("SPACE=RAS", 1.0, "as RAS, as it states, and 100% as LPS"),
        ("SPACE=LPS SPACE=RAS", 1.0, "states SPACE=LPS and SPACE=RAS; expected LPS or RAS"),
        ("SPACE=left-anterior-superior", 1.0, "states SPACE=left-anterior-superior"),
    ],
)
def test_coordinate_systems_that_do_not_fit(tmp_path, head, turn, words):
    path = written(tmp_path / "tumour.obj", ball(), head, (turn, turn, 1.0))
    with pytest.raises(Exception, match=words):
        labels_of(path)
    refusal(path, read=labels_of)


@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.obj", "a.vtp", "a.vtk"])
def test_what_is_no_surface(tmp_path, name):
    (tmp_path / name).write_bytes(
        b"ply\nformat ascii 1.0\nelement vertex 99999999999\nend_header\n" + bytes(99)
    )
    assert "STL" in refusal(tmp_path / name, read=labels_of)


def test_folders_of_several_kinds(tmp_path):
    save_surface(ball(), tmp_path / "brain.stl")
    assert "far from the kidneys" in refusal(tmp_path, read=open_labels)
    labels = sitk.Image([6, 6, 6], sitk.sitkUInt8) + 1
    sitk.WriteImage(labels, str(tmp_path / "kidney_left.nii.gz"))
    found = open_labels(tmp_path)
    assert [s.name for one in found.maps(THICK) for s in one.segments.values()] == ["kidney_left"]
    assert found.notes == ("label maps were read, and not the surfaces beside them: 1",)


@pytest.mark.parametrize("name", ["tumour.stl", "tumour-ascii.stl", "tumour.ply", "tumour.obj"])
def test_texts_of_a_header_are_identifiers(tmp_path, name):
    path = written(tmp_path / name, ball(), "SPACE=LPS of Doe^Jane")
    assert any("Doe^Jane" in text for text in open_labels(path).identifiers)
    # What may stand in every patient's files names nobody.
    found = open_labels(written(tmp_path / name, ball(), "tumour SPACE=LPS")).identifiers
    assert {*found} <= {"tumour-ascii"}


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
