"""Shared by all tests: a fresh Taichi for each, small bodies, and the place of the optional real data."""

import gc
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

# Each worker has a core of its own: threads of several libraries on each would wait for one another. Read
# when these are imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    for threads in ("TI_CPU_MAX_NUM", "OMP_NUM", "OPENBLAS_NUM", "ITK_GLOBAL_DEFAULT_NUMBER_OF"):
        os.environ.setdefault(f"{threads}_THREADS", "1")

import numpy as np
import pytest
import trimesh

from rehearsal import worker_processes
from sim import stored_arrays
from sim.device import start

# Tests compute: one that changes a function must not leave its arrays to others.
stored_arrays.FOLDER = None

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
ROOT = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--renew-pictures", action="store_true", help="store the pictures of test_pictures.py anew"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first: no worker is left with it when the others have ended, nor takes half of a file whose
    fixture takes long.

    Scenes last: they have no kernels, so that one of two workers compiles nearly all.
    """
    longest = "test_window", "test_app"
    items.sort(key=lambda item: (item.path.stem not in longest, item.path.parent.name == "scenes"))


def pytest_collection_finish() -> None:
    """What is imported by now stays: each search for what is no longer used need not look at it."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def device():
    """Taichi on the CPU. It stays for the next test, with its compiled kernels."""
    start("cpu")


@pytest.fixture(scope="module")
def one_device():
    """``device`` for fixtures of a file."""
    start("cpu")


@pytest.fixture(scope="module")
def kept(one_device) -> Callable:
    """Calls a function that makes something on the device, or, where a test of the file has called it so
    before, gives that again.

    What has a ``snapshot`` is put back as it was made; a tool stays where it is.
    """
    made: dict[Any, tuple[Any, Any]] = {}

    def keep(make: Callable, *args, **named) -> Any:
        bound = inspect.signature(make).bind(*args, **named)
        bound.apply_defaults()
        # A surface is another in each test, though it be the same.
        given = [
            v.identifier_hash if isinstance(v, trimesh.Trimesh) else v
            for v in (*bound.args, *bound.kwargs.items())
        ]
        call = make, *given
        if call not in made:
            thing = make(*args, **named)
            made[call] = thing, thing.snapshot() if hasattr(thing, "snapshot") else None
        thing, state = made[call]
        if state is not None:
            thing.restore(state)
        return thing

    return keep


@pytest.fixture(scope="module")
def arrays_stored(tmp_path_factory) -> Iterator[None]:
    """For files in which the same organ is built again and again, and no two computations are compared:
    its arrays are stored, as in use.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stored_arrays, "FOLDER", tmp_path_factory.getbasetemp() / "arrays")
        yield


@pytest.fixture
def nothing_built() -> Iterator[None]:
    """What tasks build in this process is of a Taichi that the next test starts anew."""
    worker_processes._built.clear()
    yield
    worker_processes._built.clear()


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a Dask cluster of one worker with two threads: this process, reached as any other
    would be.
    """
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, protocol="tcp", dashboard_address=None
    ) as local:
        yield local.scheduler_address


@pytest.fixture
def data() -> Path:
    """The folder of real data, which the project stands without."""
    if not DATA.is_dir():
        pytest.skip("no ../shared/data here")
    return DATA


@pytest.fixture
def ball() -> trimesh.Trimesh:
    """A ball of 12 mm radius about the origin."""
    return trimesh.creation.icosphere(subdivisions=3, radius=12.0)


@pytest.fixture
def block() -> trimesh.Trimesh:
    """A block of 24 x 20 x 16 mm about the origin."""
    return trimesh.creation.box([24.0, 20.0, 16.0])


@pytest.fixture
def bytes_to_a_file() -> Callable[[int], AbstractContextManager[None]]:
    """While it lasts no file grows beyond so many bytes, as on a disk that is full."""
    resource = pytest.importorskip("resource", reason="no limits of files on this system")

    @contextmanager
    def limited(most: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


def rotation_about(axis: list[float], degrees: float) -> np.ndarray:
    """Rotation matrix (3, 3)."""
    return trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]
