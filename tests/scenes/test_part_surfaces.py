"""Surfaces of parts made in processes of their own: the same as here, and the same errors."""

import os

import numpy as np
import pytest

from errors import PatientError
from scenes.patients import part_surfaces
from scenes.patients.part_surfaces import part_surfaces_in_processes
from scenes.terminal import silent
from scenes.volumes.voxel_grid import VoxelGrid

GRID = VoxelGrid((40, 36, 32), np.array([0.9, 1.0, 1.2]), np.array([5.0, -7.0, 3.0]), np.eye(3))


def ball(at: tuple[float, float, float], radius_mm: float) -> np.ndarray:
    x, y, z = np.meshgrid(*map(np.arange, GRID.size), indexing="ij")
    place = np.stack([x, y, z], axis=-1) * GRID.spacing
    return (np.linalg.norm(place - at, axis=-1) < radius_mm).transpose(2, 1, 0)


def made(monkeypatch, found, aside: bool):
    monkeypatch.setattr(part_surfaces, "PROCESSES_FROM_MM2", 0.0 if aside else np.inf)
    monkeypatch.setattr(part_surfaces, "cpu_count", lambda: 2)
    with part_surfaces_in_processes(found) as surfaces:
        return surfaces(silent)


SPECK = np.zeros(GRID.size[::-1], bool)
SPECK[10, 10, 10] = True


def test_they_are_the_same_wherever_they_are_made(monkeypatch):
    found = {"tumour": (GRID, ball((14, 14, 15), 9.0)), "urine": (GRID, ball((24, 22, 20), 8.0))}
    too_thin = {"vessel": (GRID, SPECK)}
    here, there = (made(monkeypatch, found | too_thin, aside) for aside in (False, True))
    assert list(here) == list(there) == list(found)
    for tissue, surface in here.items():
        assert np.array_equal(surface.vertices, there[tissue].vertices)
        assert np.array_equal(surface.faces, there[tissue].faces)
        assert there[tissue].is_watertight and there[tissue].volume > 0


@pytest.mark.parametrize("aside", [False, True])
def test_of_what_is_too_thin_what_must_be_seen_stops_an_import(monkeypatch, aside):
    found = {"cyst": (GRID, ball((24, 22, 20), 8.0)), "tumour": (GRID, SPECK)}
    with pytest.raises(PatientError, match="the tumour has no surface"):
        made(monkeypatch, found, aside)


def test_a_process_that_dies_is_said(monkeypatch):
    monkeypatch.setattr(part_surfaces, "part_surface", lambda *part: os._exit(1))
    found = {tissue: (GRID, ball((14, 14, 15), 9.0)) for tissue in ("tumour", "cyst")}
    with pytest.raises(PatientError, match="lack of memory"):
        made(monkeypatch, found, aside=True)
