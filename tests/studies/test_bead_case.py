"""Case folders: what is read, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import rotation_about
from small_bead_case import DEPTHS, beads, values, write_case

from studies.accuracy.bead_case import CaseError, load_case


def refused(folder: Path) -> str:
    with pytest.raises(CaseError) as error:
        load_case(folder)
    assert "\n" not in str(error.value) and str(folder) in str(error.value)
    return str(error.value)


def changed(path: str, value) -> dict:
    """The values of a case with one of them changed, or left out where the value is ``None``."""
    case = values()
    at = case
    *way, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    for part in way:
        at = at[part]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return case


def test_a_case_is_read_as_it_was_written(tmp_path):
    turned = rotation_about([0, 0, 1], 30)
    case = load_case(write_case(tmp_path / "a", changed("probe.rotation", turned.tolist())))
    assert case.name == "ball" and case.organ.is_watertight and case.support.is_watertight
    assert np.array_equal(case.beads, beads()[0]) and np.array_equal(case.measured, beads()[1:])
    assert case.indentation_mm.tolist() == list(DEPTHS)
    assert np.array_equal(case.poses[2, :3, :3], turned) and case.poses[2, :3, 3].tolist() == [0, 0, 13.0]
    assert case.gravity.tolist() == [0, 0, -9810.0] and case.friction == 0.35
    assert (case.young_kpa, case.poisson, case.density_kg_m3) == (15.0, 0.45, 1050.0)
    assert case.size_mm.tolist() == [16, 8, 10] and case.edge_radius_mm == 1.0


def test_a_laboratory_without_material_values_brings_its_own_case(tmp_path):
    case = load_case(write_case(tmp_path, changed("material", None)))
    assert (case.young_kpa, case.poisson, case.density_kg_m3) == (None, None, None)


def test_a_stage_may_have_the_probe_turned(tmp_path):
    turned = rotation_about([1, 0, 0], 5)
    case = load_case(write_case(tmp_path, changed("stage.1.rotation", turned.tolist())))
    assert np.array_equal(case.poses[1, :3, :3], turned) and np.array_equal(case.poses[2, :3, :3], np.eye(3))


def test_the_digest_differs_with_the_contents(tmp_path):
    one, same = load_case(write_case(tmp_path / "a")), load_case(write_case(tmp_path / "b"))
    other = load_case(write_case(tmp_path / "c", places=beads() * [1, 1, 0.999]))
    assert one.digest == same.digest != other.digest


@pytest.mark.parametrize(
    "path, value, words",
    [
        ("probe", None, "probe: missing; correct it there"),
        ("stage.1.position", None, "stage.1.position: missing"),
        ("units.length", "cm", "units.length = 'cm': input should be 'mm'"),
        ("units.acceleration", "mm/s^2", "units.acceleration = 'mm/s^2': input should be 'm/s^2'"),
        ("material.young_MPa", 0.015, "young_MPa: the unit is in the key; write young_kPa"),
        ("stage.1.indentation_cm", 0.2, "indentation_cm: the unit is in the key; write indentation_mm"),
        ("material.young_kPa", "15 kPa", "material.young_kPa = '15 kPa': input should be a valid number"),
        ("material.young_kPa", float("nan"), "material.young_kPa = nan: input should be a finite number"),
        ("material.poisson", 0.5, "material.poisson = 0.5: input should be less than 0.5"),
        ("material.density", 1.05, "material.density = 1.05: input should be greater than or equal to 100"),
        ("gravity.direction", [0, 0, 0], "a direction must not be zero"),
        ("contact.friction_on_probe", False, "contact.friction_on_probe = False: input should be True"),
        ("probe.shape", "sphere", "probe.shape = 'sphere': input should be 'cuboid'"),
        ("material.young_kPa", "15", "material.young_kPa = '15': input should be a valid number"),
        ("probe.size_mm", [40.0, 10.0], "probe.size_mm = [40.0, 10.0]: tuple should have at least 3 items"),
        ("probe.edge_radius_mm", 4.5, "edge_radius_mm is 4.5: expected at most half"),
        ("probe.rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "expected a rotation matrix"),
        ("probe.rotation", [[-1, 0, 0], [0, 1, 0], [0, 0, 1]], "expected a rotation matrix"),
        ("stage.1.index", 2, "stage 1 has index 2: list the stages in order, from 0"),
        ("stage.0.indentation_mm", 1.0, "stage 0 has indentation_mm 1: expected 0"),
        ("stage.2.indentation_mm", 2.0, "stage 2 has indentation_mm 2: expected more than 2"),
        ("stage.1.position", [0, 0, 17], "its position is 0.00 mm from stage 0's along press_direction"),
        ("stage", [], "tuple should have at least 2 items"),
        ("format_version", 2, "format_version = 2: input should be 1"),
        ("files", {"kidney": "none.stl"}, "no such surface file"),
    ],
)
def test_a_wrong_case_is_refused_by_name(tmp_path, path, value, words):
    assert words in refused(write_case(tmp_path, changed(path, value)))


def test_a_folder_that_is_no_case_is_refused(tmp_path):
    assert "holds no case.toml" in refused(tmp_path)
    (tmp_path / "case.toml").write_text("[units\n")
    assert "not valid TOML" in refused(tmp_path)
    (tmp_path / "case.toml").write_bytes(b"\xff")
    assert "cannot be read" in refused(tmp_path)


def test_an_open_surface_is_refused(tmp_path):
    folder = write_case(tmp_path)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    trimesh.Trimesh(mesh.vertices, mesh.faces[:-3]).export(folder / "kidney.stl")
    assert "kidney.stl: is not a closed surface" in refused(folder)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda text: text.replace("x2,", "q2,"), "column x2 is missing; expected 12 columns, x to z2"),
        (lambda text: "", "has no rows"),
        (lambda text: text.replace("\n1,", "\n1,nan,"), "line 3, x is 'nan': expected a finite number"),
        (lambda text: text.replace("\n1,", "\n1,here,"), "line 3, x is 'here': expected a finite number"),
        (lambda text: text.rstrip().rsplit(",", 1)[0], "line 13, z2 is missing"),
    ],
)
def test_a_wrong_table_of_beads_is_refused(tmp_path, change, words):
    table = write_case(tmp_path) / "beads.csv"
    table.write_text(change(table.read_text()))
    assert words in refused(tmp_path)


def test_beads_elsewhere_are_refused(tmp_path):
    places = beads()
    places[0, 4] = [0, 0, 14.0]
    assert "the bead on line 6 is 2.0" in refused(write_case(tmp_path / "outside", places=places))
    places = beads()
    places[2, 5] *= 1000
    folder = write_case(tmp_path / "metres", places=places)
    assert "the bead on line 7 is" in refused(folder)
    (folder / "beads.csv").write_text("# by hand\n\n" + (folder / "beads.csv").read_text())
    assert "the bead on line 9 is" in refused(folder)


def with_parts(tmp_path: Path) -> dict:
    case = values()
    tumour = dict(name="tumour", surface="tumour.stl", young_kPa=60.0, poisson=0.4, density=1100.0)
    case["material"]["part"] = [tumour]
    trimesh.creation.icosphere(subdivisions=2, radius=4.0).export(tmp_path / "tumour.stl")
    return case


def test_parts_holds_and_forces_are_read(tmp_path):
    case = with_parts(tmp_path)
    case["hold"] = [dict(name="hilum", shape="sphere", centre=[-9.0, 0.0, 0.0], radius_mm=4.0)]
    case["stage"][1]["probe_force_N"] = [0.5, 0.0, -2.0]
    found = load_case(write_case(tmp_path, case))
    (part,), (region,) = found.parts, found.fixed
    assert part.name == "tumour"
    assert (part.material.young_kpa, part.material.poisson, part.material.density_g_cm3) == (60.0, 0.4, 1.1)
    assert part.surface.volume == pytest.approx(4 / 3 * np.pi * 4**3, rel=0.05)
    assert region.at_mm.tolist() == [-9.0, 0.0, 0.0] and region.radius_mm == 4.0
    # The file has the force on the tissue.
    assert found.probe_force_n[1].tolist() == [-0.5, -0.0, 2.0] and np.isnan(found.probe_force_n[0]).all()
    other = dict(case["material"]["part"][0], young_kPa=50.0)
    case["material"]["part"] = [other]
    assert load_case(write_case(tmp_path, case)).digest != found.digest


def test_a_probe_may_slide_at_the_same_depth(tmp_path):
    case = values()
    case["stage"][2] |= dict(indentation_mm=2.0, slide_mm=3.0, position=[3.0, 0.0, 15.0])
    found = load_case(write_case(tmp_path, case))
    assert found.indentation_mm.tolist() == [0.0, 2.0, 2.0] and found.poses[2, :3, 3].tolist() == [3, 0, 15]
    del case["stage"][2]["slide_mm"]
    assert "expected more than 2 of the stage before" in refused(write_case(tmp_path, case))


def test_a_part_without_its_surface_is_refused(tmp_path):
    case = with_parts(tmp_path)
    case["material"]["part"][0]["young_kPa"] = -1.0
    assert "material.part.0.young_kPa = -1.0" in refused(write_case(tmp_path, case))
    case["material"]["part"][0]["young_kPa"] = 60.0
    (tmp_path / "tumour.stl").unlink()
    assert "tumour.stl" in refused(write_case(tmp_path, case))
