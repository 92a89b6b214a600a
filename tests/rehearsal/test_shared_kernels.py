"""Kernels that one patient has compiled serve the others."""

from dataclasses import replace

import numpy as np
from coarse_patient import coarse_patient

from rehearsal.case import case_of
from rehearsal.rehearsal import Rehearsal
from scenes.scene import with_options
from sim import kernels

LOOK = "both", "elevation", 350.0, 40.0


def used(rehearsal: Rehearsal) -> None:
    """A press of one step, its pictures and measurements."""
    rehearsal.advance(rehearsal.pose_at_depth(1.0))
    rehearsal.show()
    rehearsal.anatomy.scanner.images(rehearsal.anatomy.image_plane(), rehearsal.case.probe, *LOOK)
    rehearsal.organ.contacts.measure_penetration()


def test_a_patient_of_another_size_compiles_nothing(device, monkeypatch):
    first, anatomy = coarse_patient()
    used(first)
    compiled = []
    build = kernels._Compiled.__init__

    def counted(self, taichi, *given):
        compiled.append(taichi.func.__qualname__)
        build(self, taichi, *given)

    monkeypatch.setattr(kernels._Compiled, "__init__", counted)
    organ = anatomy.organ.copy()
    organ.apply_transform(np.diag([1.1, 0.9, 1.05, 1.0]))
    other_anatomy = replace(anatomy, organ=organ)
    scene = with_options(first.case.scene, {"tissue.cell_mm": 7.0})
    other = Rehearsal(case_of(scene, other_anatomy, first.case.probe), other_anatomy)
    used(other)
    assert other.organ.body.count != first.organ.body.count
    assert other.anatomy.embedding.count != first.anatomy.embedding.count
    assert compiled == []
