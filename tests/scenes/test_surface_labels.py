"""Surfaces as labels and as support; their voxels: test_accepted_forms.py."""

import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from synthetic_body import DIRECTIONS, TUMOUR, ellipsoid, grid_around

from scenes.patients.import_request import import_request
from scenes.patients.organ_support import bed_of_file
from scenes.volumes.voxel_grid import VoxelGrid

THICK = VoxelGrid.of(grid_around((20, -20, -80), (180, 120, 90), (0.9, 0.8, 5.0), DIRECTIONS["oblique"]))


def written(path, surface, head="3D Slicer output. SPACE=LPS"):
    """An STL with a text in its header, as 3D Slicer writes it."""
    path.write_bytes(head.encode().ljust(80, b"\0") + surface.export(file_type="stl")[80:])
    return path


def test_a_support_states_its_coordinate_system(tmp_path):
    organ = ellipsoid((TUMOUR[0], np.full(3, 9.0)))
    under = ellipsoid((TUMOUR[0] + [0, 31.0, 0], np.array([30.0, 18.0, 30.0])))
    in_ras = trimesh.Trimesh(under.vertices * [-1, -1, 1], under.faces)
    bed = bed_of_file(written(tmp_path / "bed.stl", in_ras, "SPACE=RAS"), organ, np.array([0, 1.0, 0]))
    np.testing.assert_allclose(bed.center_mass, under.center_mass, atol=1e-3)


def test_an_import_of_surfaces(tmp_path, monkeypatch):
    """From files to the organ that is taken; its surface is made elsewhere."""
    taken = {}

    def watched(volume, labels, organ, side, **_):
        taken.update(labels=labels)
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.patients.import_request.import_patient", watched)
    ct = THICK.image(np.zeros(THICK.size[::-1], np.int16))
    sitk.WriteImage(ct, str(tmp_path / "ct.nrrd"))
    files = [
        written(tmp_path / f"{name}.stl", ellipsoid((TUMOUR[0] + [x, 0, 0], np.full(3, 9.0))))
        for name, x in (("a", 25.0), ("b", 0.0))
    ]
    with pytest.raises(KeyboardInterrupt):
        import_request(tmp_path / "ct.nrrd", files, ["a"], {"tumour": ["b"]})
    tissues = [s.tissue for s in taken["labels"].segments.values()]
    assert sorted(tissues) == ["kidney", "tumour"]
