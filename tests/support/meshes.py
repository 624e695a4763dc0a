"""Triangle meshes for tests, in files that go with the process."""

import tempfile
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.spatial import ConvexHull


def as_ply(vertices, faces, normals=None, texcoords=None):
    """The entry of a scene for a mesh."""
    optional = {"vertex_normals": normals, "vertex_texcoords": texcoords}
    has = {f"has_{name}": data is not None for name, data in optional.items()}
    mesh = mi.Mesh("mesh", len(vertices), len(faces), **has)
    params = mi.traverse(mesh)
    for name, data in {"vertex_positions": vertices, **optional}.items():
        if data is not None:
            params[name] = data.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    path = folder() / f"{len(list(folder().iterdir()))}.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


@cache
def _made():
    return tempfile.TemporaryDirectory()


def folder():
    """A folder of this process."""
    return Path(_made().name)


def ball_mesh(subdivisions=0, lean=0.0):
    """A unit sphere of 20 * 4^n triangles with vertex normals, which lean by an angle in degrees."""
    golden = (1 + 5**0.5) / 2
    v = np.array([np.roll((0, a, b * golden), i) for i in range(3) for a in (-1, 1) for b in (-1, 1)])
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    for _ in range(subdivisions):
        corners = v[ConvexHull(v).simplices]
        middles = (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
        middles /= np.linalg.norm(middles, axis=1, keepdims=True)
        v = np.unique(np.concatenate([v, middles]).round(9), axis=0)
    f = ConvexHull(v).simplices
    inward = np.linalg.det(v[f]) < 0
    f[inward] = f[inward][:, ::-1]
    cos, sin = np.cos(np.deg2rad(lean)), np.sin(np.deg2rad(lean))
    return as_ply(v, f, v @ np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]))
