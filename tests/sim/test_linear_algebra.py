"""The nearest rotation of a quarter of a million matrices of all kinds, from three kinds of guess, against
NumPy in float64.
"""

import numpy as np
import pytest
import taichi as ti
from scipy.spatial.transform import Rotation

from sim.fields import array_of, fill, zeros
from sim.kernels import kernel
from sim.linear_algebra import nearest_rotation, rotation_near

COUNT = 84_000
KIND = COUNT // 8
# An SVD in float32 leaves some tens of units in the last place (6e-8).
ROUNDING = 4e-6


def matrices() -> np.ndarray:
    """Random, inverted, flat, line-like, tiny, huge, zero and nearly symmetric matrices, KIND of each."""
    random = np.random.default_rng(1)
    all_kinds = random.normal(size=(COUNT, 3, 3))
    part = [all_kinds[k * KIND : (k + 1) * KIND] for k in range(8)]
    part[1] *= -np.sign(np.linalg.det(part[1]))[:, None, None]
    part[2][:, :, 2] = part[2][:, :, :2] @ [0.3, 0.2]
    part[3][:] = random.normal(size=(KIND, 3, 1)) * random.normal(size=(KIND, 1, 3))
    part[4] *= 1e-20
    part[5] *= 1e15
    part[6][:] = 0.0
    part[7] *= 1e-4
    part[7] += np.diag([3.0, 2.0, 1.0])
    return all_kinds.astype(np.float32)


@kernel
def extract(matrix: ti.template(), guess: ti.template(), rotation: ti.template(), is_near: ti.template()):
    for i in range(matrix.shape[0]):
        if ti.static(is_near):
            rotation[i] = rotation_near(guess[i], matrix[i])
        else:
            rotation[i] = nearest_rotation(matrix[i])


def rotations(values: np.ndarray, guesses: np.ndarray | None = None) -> np.ndarray:
    matrix = zeros(len(values), 3, 3, within=2)
    guess = zeros(len(values), 3, 3, within=2)
    rotation = zeros(len(values), 3, 3, within=2)
    fill((matrix, values))
    if guesses is not None:
        fill((guess, guesses))
    extract(matrix, guess, rotation, guesses is not None)
    return array_of(rotation).astype(np.float64)


@pytest.mark.parametrize("guess", [None, "any", "near"])
def test_the_rotation_is_the_nearest_proper_one(one_device, guess):
    values = matrices()
    guesses = None
    if guess == "any":
        guesses = Rotation.random(COUNT, random_state=2).as_matrix()
    elif guess == "near":
        u, _, vt = np.linalg.svd(values.astype(np.float64))
        u[:, :, 2] *= (np.sign(np.linalg.det(u)) * np.sign(np.linalg.det(vt)))[:, None]
        turns = Rotation.from_rotvec(0.1 * np.random.default_rng(3).normal(size=(COUNT, 3))).as_matrix()
        guesses = u @ vt @ turns
    rotation = rotations(values, guesses)
    values = values.astype(np.float64)
    largest = np.abs(values).max(axis=(1, 2), keepdims=True)
    values /= np.where(largest > 0, largest, 1.0)

    assert np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max() < ROUNDING
    assert np.abs(np.linalg.det(rotation) - 1).max() < ROUNDING
    u, s, vt = np.linalg.svd(values)
    handed = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    best = s[:, 0] + s[:, 1] + handed * s[:, 2]
    reached = np.einsum("nij,nij->n", rotation, values)
    assert (best - reached).max() < ROUNDING

    # Where the best rotation is unique by a margin, the error is rounding over the margin.
    unique = s[:, 1] + handed * s[:, 2] > 0.1
    u[:, :, 2] *= handed[:, None]
    assert unique.sum() > COUNT // 2
    assert np.abs(rotation - u @ vt)[unique].max() < 10 * ROUNDING


def test_the_zero_matrix_gives_the_identity(one_device):
    assert np.array_equal(rotations(np.zeros((2, 3, 3), np.float32)), np.stack([np.eye(3)] * 2))
