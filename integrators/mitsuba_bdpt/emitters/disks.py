"""Disks from which light subpaths of infinite emitters start, across their direction.

One disk covers the scene. On a large ground few of its subpaths meet what matters, so where the scene has
details, shapes that are small beside it and lie together, a part of the subpaths starts on a disk that covers
these. The density is that of the mixture, wherever a strategy asks for it. Where emission is guided (see
`emission_tables`), tables do the same for details that are not smaller than their cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.boxes import boxes
from .emission_tables import Factor

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


@dataclass
class Guided:
    """What guides where subpaths start on a scene's disk.

    ``warp`` gives numbers for uniform ones, and their density; ``density``: that of a point. ``share`` of the
    subpaths that are aimed at details.
    """

    share: mi.Float
    warp: Callable[[Any], Any]
    density: Callable[[Any], Any]


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

    def share(self, side: int) -> float:
        """The share of subpaths that are aimed at details beside tables of ``side`` x ``side`` cells.

        0 if the details are not smaller than a cell, so that the tables can aim at them.
        """
        if self.details is None:
            return 0.0
        return AIMED if dr.slice(self.details.radius) * side < dr.slice(self.scene.radius) else 0.0

    def start(self, d, u, guided: Guided | None = None):
        """A point from which a subpath along ``d`` starts, and its density (area across ``d``)."""
        center, radius, aimed = self.scene.center, self.scene.radius, None
        share = AIMED if guided is None else guided.share
        if self.details is not None:
            aimed = u.x < share
            u = mi.Point2f(dr.select(aimed, u.x / share, (u.x - share) / (1 - share)), u.y)
            along = dr.dot(self.details.center - center, d)
            center = dr.select(aimed, self.details.center - along * d, center)
            radius = dr.select(aimed, self.details.radius, radius)
        frame, density = mi.Frame3f(d), None
        if guided is not None:
            frame = _frame(d)
            warped, density = guided.warp(u)
            u = warped if aimed is None else dr.select(aimed, u, warped)
        disk = mi.warp.square_to_uniform_disk_concentric(u)
        p = center + radius * (frame.s * disk.x + frame.t * disk.y) - self.scene.radius * d
        if guided is not None and aimed is not None:
            density = dr.select(aimed, guided.density(p), density)
        return p, self._pdf_a(p, d, aimed, density, share)

    def place(self, p, d):
        """The numbers for which a subpath along ``d`` that passes ``p`` starts on the scene's disk."""
        frame, offset = _frame(d), (p - self.scene.center) / self.scene.radius
        disk = mi.Point2f(dr.dot(frame.s, offset), dr.dot(frame.t, offset))
        return mi.warp.uniform_disk_to_square_concentric(disk)

    def pdf_a(self, p, d, density=None, share=AIMED):
        """Density with which a subpath along ``d`` passes ``p`` (area across ``d``).

        Without details ``p`` is taken to be a point of the scene, else it may be anywhere. ``density``: how
        many times as dense as uniform points are there on the scene's disk; ``share`` of the details' disk.
        """
        return self._pdf_a(p, d, None, density, share)

    def _pdf_a(self, p, d, aimed, density, share):
        scene = self.scene.pdf_a()
        if density is not None:
            scene = scene * density
        if self.details is None:
            return scene
        in_scene, in_details = self.scene.is_passed(p, d), self.details.is_passed(p, d)
        if aimed is not None:  # on the rim of its disk a point may be outside by rounding
            in_scene, in_details = in_scene | ~aimed, in_details | aimed
        return dr.select(in_scene, (1 - share) * scene, 0) + dr.select(
            in_details, share * self.details.pdf_a(), 0
        )

    def factor(self, p, d, share: float) -> Factor:
        """What tables, with a ``share`` beside them, change of the density of subpaths past ``p``."""
        if self.details is None:
            return Factor.whole()
        in_scene, in_details = self.scene.is_passed(p, d), self.details.is_passed(p, d)
        before = self.pdf_a(p, d)
        scaled = dr.select(in_scene, (1 - share) * self.scene.pdf_a(), 0)
        kept = dr.select(in_details, share * self.details.pdf_a(), 0)
        usual = before == 0
        return Factor(dr.select(usual, 1, scaled / before), dr.select(usual, 0, kept / before))

    def covers(self, p, d):
        """Mask: light from infinity along ``d`` passes ``p`` after a point where its subpaths start.

        Points of a shape are all covered.
        """
        passed = self.scene.is_passed(p, d)
        if self.details is not None:
            passed |= self.details.is_passed(p, d)
        return passed & (dr.dot(p - self.scene.center, d) >= -self.scene.radius)


# An odd rotation: frames are mirrored where directions have z = 0 in its axes, which those of users have not.
_ODD = np.linalg.qr(np.array([[0.61, -0.34, 0.29], [0.17, 0.83, -0.41], [-0.53, 0.26, 0.71]]))[0].tolist()


def _frame(d) -> mi.Frame3f:
    """A frame about ``d`` that does not depend on rounding for directions along axes."""
    x, y, z = (mi.Vector3f(*axis) for axis in _ODD)
    turned = mi.Frame3f(mi.Vector3f(dr.dot(x, d), dr.dot(y, d), dr.dot(z, d)))
    s, t = (v.x * x + v.y * y + v.z * z for v in (turned.s, turned.t))
    return mi.Frame3f(s, t, d)


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
