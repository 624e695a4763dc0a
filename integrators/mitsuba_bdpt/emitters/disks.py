"""Disks from which light subpaths of infinite emitters start, across their direction.

One disk covers the scene. On a large ground few of its subpaths meet what matters, so where the scene has
details, shapes that are small beside it and lie together, a part of the subpaths starts on a disk that covers
these. The density is that of the mixture, wherever a strategy asks for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..host.introspection import own_parameters

# A shape is a detail if the longest side of its box is not more than this part of the scene's.
DETAIL = 0.25

# Details are aimed at if the radius of the sphere about them is not more than this part of the scene's: else
# there is little to gain.
LOCAL = 0.5

# Details smaller than this, over the scene's size and distance from the origin, are not aimed at: which
# disk's subpaths pass a point is known up to rounding (6e-8 of these).
TINY = 1e-4

# What spheres are larger by, so that surfaces on them are not missed.
MARGIN = 1e-4

# Share of the light subpaths that are aimed at details. What is elsewhere loses at most half of its subpaths.
AIMED = 0.5


@dataclass
class BoundingSphere:
    """A sphere whose outline is a disk: ``center`` and ``radius``.

    Dr.Jit may exchange both without compiling anew.
    """

    center: mi.Point3f
    radius: mi.Float

    @staticmethod
    def about(sphere) -> BoundingSphere:
        """A sphere of Mitsuba's, a little larger, as Mitsuba makes it."""
        radius = max(float(sphere.radius) * (1 + MARGIN), 1e-30)
        made = BoundingSphere(mi.Point3f(sphere.center), mi.Float(radius))
        dr.make_opaque(made)
        return made

    def is_passed(self, p, d):
        """Mask: the line through ``p`` along ``d`` meets it."""
        offset = p - self.center
        return dr.squared_norm(offset - dr.dot(offset, d) * d) <= dr.square(self.radius)

    def pdf_a(self):
        """Density of a uniform point on its disk across any direction (area)."""
        return dr.rcp(dr.pi * dr.square(self.radius))


class Disks:
    """Disks of a scene: outlines of ``scene`` and ``details``, as `BoundingSphere` objects.

    ``scene`` is the sphere about all shapes (a unit sphere if no shape has a finite box), ``details`` that
    about the scene's details, or None if it has none.
    """

    def __init__(self, scene):
        each, box = boxes(scene), mi.ScalarBoundingBox3f()
        for one in each:
            box.expand(one)
        sphere = box.bounding_sphere() if box.valid() else mi.ScalarBoundingSphere3f([0] * 3, 1)
        self.scene = BoundingSphere.about(sphere)
        found = details(each, box) if box.valid() else None
        self.details = BoundingSphere.about(found) if found is not None else None

    def start(self, d, u):
        """A point from which a subpath along ``d`` starts, and its density (area across ``d``)."""
        center, radius, aimed = self.scene.center, self.scene.radius, None
        if self.details is not None:
            aimed = u.x < AIMED
            u = mi.Point2f(dr.select(aimed, u.x / AIMED, (u.x - AIMED) / (1 - AIMED)), u.y)
            along = dr.dot(self.details.center - center, d)
            center = dr.select(aimed, self.details.center - along * d, center)
            radius = dr.select(aimed, self.details.radius, radius)
        disk = mi.warp.square_to_uniform_disk_concentric(u)
        frame = mi.Frame3f(d)
        p = center + radius * (frame.s * disk.x + frame.t * disk.y) - self.scene.radius * d
        return p, self._pdf_a(p, d, aimed)

    def pdf_a(self, p, d):
        """Density with which a subpath along ``d`` passes ``p`` (area across ``d``).

        Without details ``p`` is taken to be a point of the scene, else it may be anywhere.
        """
        return self._pdf_a(p, d, None)

    def _pdf_a(self, p, d, aimed):
        if self.details is None:
            return self.scene.pdf_a()
        in_scene, in_details = self.scene.is_passed(p, d), self.details.is_passed(p, d)
        if aimed is not None:  # on the rim of its disk a point may be outside by rounding
            in_scene, in_details = in_scene | ~aimed, in_details | aimed
        return dr.select(in_scene, (1 - AIMED) * self.scene.pdf_a(), 0) + dr.select(
            in_details, AIMED * self.details.pdf_a(), 0
        )

    def covers(self, p, d):
        """Mask: light from infinity along ``d`` passes ``p`` after a point where its subpaths start.

        Points of a shape are all covered.
        """
        passed = self.scene.is_passed(p, d)
        if self.details is not None:
            passed |= self.details.is_passed(p, d)
        return passed & (dr.dot(p - self.scene.center, d) >= -self.scene.radius)


def boxes(scene) -> list:
    """Valid bounding boxes of the shapes; of meshes those of their finite vertices.

    Of meshes that Mitsuba merges when it loads a scene, ``bbox`` is that of one part; with a vertex that is
    not finite it is invalid, though rays meet other triangles.
    """
    found = []
    for shape in scene.shapes():
        box = mi.ScalarBoundingBox3f(shape.bbox())
        params = own_parameters(shape) if shape.is_mesh() else {}
        if "vertex_positions" in params:
            vertices = np.array(params["vertex_positions"]).reshape(-1, 3)
            vertices = vertices[np.isfinite(vertices).all(axis=1)]
            box = mi.ScalarBoundingBox3f()
            for corner in (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else ():
                box.expand(mi.ScalarPoint3f(corner.tolist()))
        if box.valid() and np.isfinite([box.min, box.max]).all():
            found.append(box)
    return found


def details(found: list, whole):
    """Bounding sphere of those `boxes` that are small beside the box of the ``whole`` scene.

    None if there are none, if they are spread over it (`LOCAL`), or if they are too small for rounding
    (`TINY`).
    """
    size = max(whole.extents())
    small = mi.ScalarBoundingBox3f()
    for box in found:
        if max(box.extents()) <= DETAIL * size:
            small.expand(box)
    if not small.valid():
        return None
    sphere, radius = small.bounding_sphere(), whole.bounding_sphere().radius
    far = radius + float(np.abs([whole.min, whole.max]).max())
    return sphere if TINY * far <= sphere.radius <= LOCAL * radius else None
