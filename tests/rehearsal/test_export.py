"""What leaves for other programs: surfaces and volumes, in the patient's coordinates, by others' readers."""

import io
from contextlib import redirect_stderr
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from conftest import rotation_about
from scipy.spatial import cKDTree

import app
from rehearsal.image_and_surface_files import save_surfaces
from rehearsal.resection.resection_state import NO_RESECTION
from scenes.surfaces import FORMATS, FineSurface, save_surface
from scenes.volumes.volume_files import save_image

pytestmark = pytest.mark.usefixtures("one_device")

# Far from the origin, as a patient's organ is.
MIDDLE = np.array([71.5, -133.25, -1204.0])


def body(shift: float = 0.0, size: float = 1.0) -> trimesh.Trimesh:
    """A closed surface without symmetry."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    vertices = ball.vertices * [20 * size, 14 * size, 31 * size] + MIDDLE + [shift, 0, 0]
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def aslant(voxels: np.ndarray) -> sitk.Image:
    """Voxels (z, y, x) on a grid along no axis of the patient's."""
    image = sitk.GetImageFromArray(voxels)
    image.SetSpacing([0.7, 0.9, 1.3])
    image.SetOrigin((MIDDLE - 5).tolist())
    image.SetDirection(rotation_about([1.0, -2.0, 0.5], 25.0).ravel().tolist())
    image.SetMetaData("PatientName", "Doe^Jane")
    return image


@pytest.fixture(scope="module")
def patient(tmp_path_factory) -> Path:
    """A patient's folder with all that a scene can name."""
    folder = tmp_path_factory.mktemp("Doe-Jane")
    names = {"organ": body(), "tumour": body(3.0, 0.2), "vessels": body(-3.0, 0.1), "bed": body(40.0)}
    for name, surface in names.items():
        surface.export(folder / f"{name}.stl")
    random = np.random.default_rng(3)
    hu = random.integers(-1000, 1500, (6, 5, 4)).astype(np.int16)
    sitk.WriteImage(aslant(hu), str(folder / "hu.nrrd"))
    sitk.WriteImage(aslant(random.integers(0, 3, (6, 5, 4)).astype(np.uint8)), str(folder / "marks.nrrd"))
    (folder / "scene.toml").write_text(
        "title = 'Doe, Jane'\n[anatomy]\ntumour = 'tumour.stl'\nct = 'hu.nrrd'\nlabels = 'marks.nrrd'\n"
        "[anatomy.parts]\nvessel = 'vessels.stl'\n[anatomy.tissues]\n1 = 'cortex'\n"
        "[[shape]]\nkind = 'mesh'\nfile = 'bed.stl'\n[[shape]]\nkind = 'plane'\nnormal = [0, 1, "
        "0]\noffset_mm = 3\n"
        "[[shape]]\nkind = 'mesh'\nfile = 'organ.stl'\n"
    )
    return folder


def exported(patient: Path, out: Path, *options: str) -> Path:
    assert app.main(["export", str(patient), "--out", str(out), *options]) == 0
    return out


def vertices_of(path: Path) -> np.ndarray:
    """Vertices (n, 3) as a reader finds them that sorts and joins none, float32 as in the file."""
    return np.asarray(trimesh.load_mesh(path, process=False).vertices)


def test_all_surfaces_of_a_scene_come_out_where_they_are(patient, tmp_path, capsys):
    out = exported(patient, tmp_path / "out")
    told = capsys.readouterr().out
    sources = dict(organ="organ", tumour="tumour", vessels="vessels", support="bed") | {"support-2": "organ"}
    assert {path.name for path in out.iterdir()} == {f"{name}.stl" for name in sources} | {
        "ct.nrrd",
        "labels.nrrd",
        "classes.seg.nrrd",
    }
    for name, source in sources.items():
        # Triangles have no order to rely on, but corners are float32 in both files: the same numbers.
        got, wanted = vertices_of(out / f"{name}.stl"), vertices_of(patient / f"{source}.stl")
        assert len(got) == len(wanted) > 400
        assert np.array_equal(np.unique(got, axis=0), np.unique(wanted, axis=0))
        assert trimesh.load_mesh(out / f"{name}.stl").volume > 0
    assert "Left out: 1 shape" in told and "vessels.stl" in told


def test_voxels_type_and_grid_come_out_as_they_were(patient, tmp_path):
    out = exported(patient, tmp_path / "out", "--format", "ply")
    for name, source in {"ct.nrrd": "hu.nrrd", "labels.nrrd": "marks.nrrd"}.items():
        got, wanted = sitk.ReadImage(str(out / name)), sitk.ReadImage(str(patient / source))
        assert np.array_equal(sitk.GetArrayFromImage(got), sitk.GetArrayFromImage(wanted))
        assert got.GetPixelID() == wanted.GetPixelID()
        assert got.GetDirection() == wanted.GetDirection() and got.GetOrigin() == wanted.GetOrigin()
        # NRRD holds the product of spacing and direction: the norm taken back is off by rounding.
        assert np.allclose(got.GetSpacing(), wanted.GetSpacing(), rtol=1e-15, atol=0)
        assert b"space: left-posterior-superior\n" in (out / name).read_bytes()


@pytest.mark.parametrize("suffix", FORMATS)
def test_nothing_of_the_patient_is_in_what_is_written(patient, tmp_path, suffix):
    out = exported(patient, tmp_path / "out", "--format", suffix)
    for path in out.iterdir():
        content = path.read_bytes() + path.name.encode()
        assert not any(word in content.lower() for word in (b"doe", b"jane", bytes(tmp_path)))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_surface_says_its_space_and_reads_back_to_float32(tmp_path, suffix):
    surface, path = body(0.1234567), tmp_path / f"a.{suffix}"
    surface.metadata["name"] = "Doe^Jane"
    surface.visual.vertex_colors = np.full((len(surface.vertices), 4), 200, np.uint8)
    save_surface(surface, path)
    content = path.read_bytes()
    read = trimesh.load_mesh(path, process=False)
    corners = np.asarray(surface.vertices)[surface.faces]
    assert np.array_equal(np.asarray(read.triangles, np.float32), corners.astype(np.float32))
    if suffix == "stl":
        # 80 bytes, the number of triangles, and 50 bytes for each.
        assert content[:80].split() == [b"SPACE=LPS"] and len(content) == 84 + 50 * len(surface.faces)
        assert np.frombuffer(content[80:84], "<u4")[0] == len(surface.faces)
    else:
        header = content[: content.index(b"end_header\n")].splitlines()
        assert header[0] == b"ply" and header[2] == b"comment SPACE=LPS"
        assert np.array_equal(np.asarray(read.vertices, np.float32), surface.vertices.astype(np.float32))
        assert np.array_equal(read.faces, surface.faces) and b"red" not in b" ".join(header)


def lying(tumour: bool) -> SimpleNamespace:
    """What a file needs of an anatomy: surfaces at rest and as they lie, about an origin."""
    rest, moved_tumour = body(), body(3.0, 0.2).vertices - MIDDLE + [1.0, 0, 0]
    fine = FineSurface.of(rest)
    return SimpleNamespace(
        case=SimpleNamespace(origin=MIDDLE),
        organ=rest,
        fine_organ=lambda: (fine, fine.vertices - MIDDLE + [0, 0, 2.5]),
        tumour=body(3.0, 0.2) if tumour else None,
        tumour_vertices=moved_tumour,
        cut=None,
        frame=SimpleNamespace(resection=NO_RESECTION),
    )


def test_organ_and_tumour_are_saved_as_they_lie_vertex_by_vertex(tmp_path, capsys):
    save_surfaces(lying(tumour=True), tmp_path, "004-")
    organ, tumour = vertices_of(tmp_path / "004-organ.ply"), vertices_of(tmp_path / "004-tumour.ply")
    # A float32 of 1204 mm is good to 6e-5.
    assert np.allclose(organ[: len(body().vertices)], body().vertices + [0, 0, 2.5], atol=2e-4)
    edges = body().vertices[body().edges_unique].mean(axis=1) + [0, 0, 2.5]
    assert len(organ) == len(body().vertices) + len(edges)
    assert cKDTree(organ[len(body().vertices) :]).query(edges)[0].max() < 2e-4
    assert np.allclose(tumour, body(4.0, 0.2).vertices, atol=2e-4)
    assert capsys.readouterr().out.count("Saved ") == 2
    save_surfaces(lying(tumour=False), tmp_path)
    assert (tmp_path / "organ.ply").is_file() and not (tmp_path / "tumour.ply").exists()


def test_what_cannot_be_exported_is_refused_in_one_line(patient, tmp_path):
    def refused(*arguments) -> str:
        told = io.StringIO()
        with redirect_stderr(told):
            assert app.main(["export", *map(str, arguments)]) == 2
        assert told.getvalue().count("\n") == 1
        return told.getvalue()

    assert "no such scene file" in refused(tmp_path / "none.toml", "--out", tmp_path / "a")
    # A patient's own folder would be written over.
    assert "not an empty folder" in refused(patient, "--out", patient)
    assert "--format" in refused(patient, "--out", tmp_path / "a", "--format", "obj")
    assert "--out" in refused(patient)
    broken = tmp_path / "broken"
    broken.mkdir()
    body().export(broken / "organ.stl")
    (broken / "ct.nrrd").write_bytes(b"NRRD0004\nnothing\n")
    (broken / "scene.toml").write_text("[anatomy]\nct = 'ct.nrrd'\n")
    assert "ct.nrrd" in refused(broken, "--out", tmp_path / "a") and not (tmp_path / "a").exists()


def test_a_full_disk_is_one_line(patient, tmp_path, bytes_to_a_file):
    told = io.StringIO()
    # The surfaces have room for 64 KB; a volume of noise has not.
    voxels = np.random.default_rng(5).integers(0, 255, (50, 50, 50)).astype(np.uint8)
    with bytes_to_a_file(65536), pytest.raises(OSError, match="is the disk full") as caught:
        save_image(sitk.GetImageFromArray(voxels), tmp_path / "a.nrrd")
    assert caught.value.filename == str(tmp_path / "a.nrrd")
    before = sorted(tmp_path.iterdir())
    with bytes_to_a_file(100), redirect_stderr(told):
        assert app.main(["export", str(patient), "--out", str(tmp_path / "out")]) == 2
    assert told.getvalue().count("\n") == 1 and str(tmp_path / "out") in told.getvalue()
    assert sorted(tmp_path.iterdir()) == before
