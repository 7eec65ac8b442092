"""The meshes of the Franka Panda, decimated once and kept in `panda.npz`.

Made by `acwm_sim.decimate_panda` from the visual meshes of `pybullet_data/franka_panda`, which
Franka Emika GmbH released under the Apache License 2.0; changed by that decimation.
"""

import functools
from pathlib import Path

import numpy as np

from acwm_sim.meshes import Mesh

ASSET = Path(__file__).with_name("panda.npz")

MESHES = (*(f"link{k}" for k in range(8)), "hand", "finger")
"""Names of the meshes, each in the frame of its link."""

VERTEX_UNIT = 1e-5
"""Metres that a step of the stored vertices stands for."""


@functools.cache
def load(name: str) -> Mesh:
    """One of `MESHES`, with display colours."""
    with np.load(ASSET) as arrays:
        vertices, normals, colors, triangles = (
            arrays[f"{name}.{part}"] for part in ("vertices", "normals", "colors", "triangles")
        )
    return Mesh(
        vertices.astype(np.float32) * np.float32(VERTEX_UNIT),
        normals.astype(np.float32) / np.float32(127),
        triangles.astype(np.int32),
        colors.astype(np.float32) / np.float32(255),
    )
