"""The coverage of an organ, packed for a session's file: one bit per voxel."""

import base64
import math
import zlib
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, with_config
from typing_extensions import TypedDict

# A grid of 1.5 mm over half a metre has fewer.
MOST_VOXELS = 100_000_000


@with_config(ConfigDict(extra="forbid", strict=True))
class SeenVoxels(TypedDict):
    """``shape``: voxels along x, y and z. ``bits``: one for each, the last axis fastest; packed, zipped, as base64."""

    shape: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=3, max_length=3)]
    bits: str


def pack_seen(seen: np.ndarray) -> SeenVoxels:
    """Pack which voxels (nx, ny, nz) were imaged."""
    bits = zlib.compress(np.packbits(seen).tobytes())
    return SeenVoxels(shape=list(seen.shape), bits=base64.b64encode(bits).decode("ascii"))


def unpack_seen(packed: SeenVoxels) -> np.ndarray:
    """Unpack which voxels (nx, ny, nz) were imaged. Raises ValueError."""
    count = math.prod(packed["shape"])
    if count > MOST_VOXELS:
        raise ValueError(f"{count} voxels, expected at most {MOST_VOXELS}")
    size = -(-count // 8)
    try:
        bits = base64.b64decode(packed["bits"], validate=True)
        unzip = zlib.decompressobj()
        octets = unzip.decompress(bits, size + 1)
    except (ValueError, zlib.error):
        raise ValueError("bits of voxels that cannot be unpacked") from None
    if len(octets) != size or not unzip.eof:
        raise ValueError(f"bits of other than its {count} voxels")
    voxels = np.unpackbits(np.frombuffer(octets, np.uint8), count=count)
    return voxels.view(bool).reshape(packed["shape"])


def _unpackable(packed: SeenVoxels) -> SeenVoxels:
    unpack_seen(packed)
    return packed


# As a file has it.
Seen = Annotated[SeenVoxels, AfterValidator(_unpackable)]
