"""Kernels that one patient has compiled serve the others."""

from dataclasses import replace

import numpy as np
from coarse_patient import coarse_patient

from rehearsal.rehearsal import Rehearsal
from scenes.scene import with_options
from sim import kernels

LOOK = "both", "elevation", 350.0, 40.0


def used(rehearsal: Rehearsal) -> None:
    """A press of one step, its pictures and measurements."""
    rehearsal.advance(rehearsal.pose_at_depth(1.0))
    rehearsal.update_surfaces()
    rehearsal.scanner.images(rehearsal.image_plane(), rehearsal.probe, *LOOK)
    rehearsal.contacts.measure_penetration()
    rehearsal.wrench()


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
    scene = with_options(first.scene, {"tissue.cell_mm": 7.0})
    other = Rehearsal(scene, replace(anatomy, organ=organ), first.probe)
    used(other)
    assert other.body.count != first.body.count and other.embedding.count != first.embedding.count
    assert compiled == []
