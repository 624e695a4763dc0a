"""Names of Mitsuba 3.10 beside those of 3.9."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
from mitsuba_bdpt.host import renamed
from mitsuba_bdpt.host.introspection import own_parameters


def mesh():
    """A pyramid without base, with texture coordinates and normals."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    made = mi.Mesh("pyramid", 5, 4, has_vertex_normals=True, has_vertex_texcoords=True)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = corners.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = corners[:, :2].astype(np.float32).ravel()
    parameters.update()
    return made


def test_names_of_today():
    """Expected: of a mesh of the installed Mitsuba its own numbers; a sphere is none."""
    parameters = own_parameters(mesh())
    assert renamed.holds_a_mesh(parameters) and renamed.has_coordinates(parameters)
    assert np.array(renamed.faces(parameters)).tolist() == [0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4]
    assert (
        np.array(renamed.positions(parameters)).tolist() == np.array(parameters["vertex_positions"]).tolist()
    )
    assert len(np.array(renamed.normals(parameters))) == 15
    assert not renamed.holds_a_mesh(own_parameters(mi.load_dict({"type": "sphere"})))


def test_names_of_3_10():
    """Rationale: its tensors have a position for several vertices, by an index. Expected: the same numbers as
    of 3.9, where each vertex has its own.
    """
    positions = np.arange(9, dtype=np.float32).reshape(3, 3)
    index, faces = [0, 1, 2, 1], [[0, 1, 2], [2, 3, 0]]
    parameters = {
        "positions": mi.TensorXf(positions),
        "position_index": mi.TensorXu(index),
        "normals": mi.TensorXf(np.zeros((0, 3), np.float32)),
        "normal_index": mi.TensorXu(np.zeros(0, np.uint32)),
        "texcoords": mi.TensorXf(np.zeros((4, 2), np.float32)),
        "faces": mi.TensorXu(faces),
    }
    assert renamed.holds_a_mesh(parameters) and renamed.has_coordinates(parameters)
    assert np.array(renamed.positions(parameters)).reshape(-1, 3).tolist() == positions[index].tolist()
    assert np.array(renamed.faces(parameters)).tolist() == np.ravel(faces).tolist()
    assert len(renamed.normals(parameters)) == 0
    del parameters["position_index"]
    assert np.array(renamed.positions(parameters)).tolist() == positions.ravel().tolist()


def test_flags_of_hits(monkeypatch):
    """Expected: 3.9's ``All``, and 3.10's ``Default``, where ``All`` is deprecated."""
    assert renamed.hit_flags() == mi.RayFlags.All
    monkeypatch.setattr(mi, "RayFlags", SimpleNamespace(Default=7))
    assert renamed.hit_flags() == 7
