"""Disks across the direction on which light subpaths from infinity start.

One disk covers the scene. If it has details, shapes that are small beside it and lie together, part of the
subpaths starts on a second disk that covers these. Every density is the mixture's. Where emission is guided,
the guide's tables replace the second disk unless the details are smaller than a cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..geometry.boxes import asked_anew, known_box
from .records import Factor

DETAIL = 0.25  # longest side of a detail's bounding box, relative to the scene's

# Largest radius of the details' bounding sphere relative to the scene's; above there is little to gain.
LOCAL = 0.5

# Smallest radius of the details' sphere relative to the scene's size plus distance from the origin, of which
# rounding is 6e-8.
TINY = 1e-4

MARGIN = 1e-4  # relative enlargement of bounding spheres, so that surfaces on them are not missed
AIMED = 0.5  # share of the light subpaths aimed at details; the rest of the scene loses at most this share


@dataclass
class BoundingSphere:
    """A bounding sphere; both fields are opaque."""

    center: mi.Point3f
    radius: mi.Float

    @staticmethod
    def about(sphere, margin: float = MARGIN) -> BoundingSphere:
        """Enlarge a ``sphere`` of Mitsuba's, as Mitsuba does."""
        radius = max(float(sphere.radius) * (1 + margin), 1e-30)
        made = BoundingSphere(mi.Point3f(sphere.center), mi.Float(radius))
        dr.make_opaque(made)
        return made

    def is_passed(self, p, d):
        """Mask: the line through ``p`` along ``d`` meets the sphere."""
        offset = p - self.center
        return dr.squared_norm(offset - dr.dot(offset, d) * d) <= dr.square(self.radius)

    def pdf_a(self):
        """Density (area) of a uniform point on the sphere's outline, a disk, across any direction."""
        return dr.rcp(dr.pi * dr.square(self.radius))

    def cone(self, p: mi.Point3f) -> tuple[mi.Vector3f, mi.Float]:
        """The cone from ``p``: axis, and 1 - cos of its half angle (2 inside the sphere)."""
        between = self.center - p
        dist2 = dr.squared_norm(between)
        sin2 = dr.square(self.radius) / dist2
        # 1 - cos of small angles would cancel.
        width = dr.select(sin2 < 1, sin2 / (1 + dr.safe_sqrt(1 - sin2)), 2)
        axis = dr.select(dist2 > 0, mi.Vector3f(between) * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1))
        return axis, width


class Disks:
    """Outlines of two spheres: ``scene``, about all shapes, and ``details``, about the scene's, or None.

    ``scene`` is a unit sphere if no shape has a finite box. ``about`` caches facts, see `ShapeFacts.about`.
    """

    def __init__(self, scene, about: Callable = asked_anew):
        found = (known_box(shape, about) for shape in scene.shapes())
        each, box = [one for one in found if one is not None], mi.ScalarBoundingBox3f()
        for one in each:
            box.expand(one)
        sphere = box.bounding_sphere() if box.valid() else mi.ScalarBoundingSphere3f([0] * 3, 1)
        self.scene = BoundingSphere.about(sphere)
        small = details(each, box) if box.valid() else None
        self.details = BoundingSphere.about(small) if small is not None else None

    def share(self, side: int) -> float:
        """Share of subpaths aimed at details; 0 unless they are smaller than one of ``side``^2 cells."""
        if self.details is None:
            return 0.0
        return AIMED if dr.slice(self.details.radius) * side < dr.slice(self.scene.radius) else 0.0

    def start(self, d, u, share=AIMED, warp: Callable | None = None, density_at: Callable | None = None):
        """Sample a subpath's start along ``d`` and its density (area across ``d``).

        ``share`` of the subpaths is aimed at details. A guide's ``warp`` maps uniform numbers to guided ones
        and their density, ``density_at`` returns that of a point.
        """
        center, radius, aimed = self.scene.center, self.scene.radius, None
        if self.details is not None:
            aimed = u.x < share
            u = mi.Point2f(dr.select(aimed, u.x / share, (u.x - share) / (1 - share)), u.y)
            along = dr.dot(self.details.center - center, d)
            center = dr.select(aimed, self.details.center - along * d, center)
            radius = dr.select(aimed, self.details.radius, radius)
        frame, density = mi.Frame3f(d), None
        if warp is not None:
            frame = _frame(d)
            warped, density = warp(u)
            u = warped if aimed is None else dr.select(aimed, u, warped)
        disk = mi.warp.square_to_uniform_disk_concentric(u)
        p = center + radius * (frame.s * disk.x + frame.t * disk.y) - self.scene.radius * d
        if density_at is not None and aimed is not None:
            density = dr.select(aimed, density_at(p), density)
        return p, self.pdf_a(p, d, density, share, aimed)

    def place(self, p, d):
        """Primary numbers of a subpath along ``d`` that passes ``p``, on the scene's disk."""
        frame, offset = _frame(d), (p - self.scene.center) / self.scene.radius
        disk = mi.Point2f(dr.dot(frame.s, offset), dr.dot(frame.t, offset))
        return mi.warp.uniform_disk_to_square_concentric(disk)

    def pdf_a(self, p, d, density=None, share=AIMED, aimed=None):
        """Density (area across ``d``) with which a subpath along ``d`` passes ``p``.

        Without details ``p`` must be a point of the scene, else it may be anywhere. ``density`` on the
        scene's disk relative to uniform; ``share`` of the details' disk; ``aimed``: mask of samples of it.
        """
        scene = self.scene.pdf_a()
        if density is not None:
            scene = scene * density
        if self.details is None:
            return scene
        in_scene, in_details = self.scene.is_passed(p, d), self.details.is_passed(p, d)
        if aimed is not None:  # rounding may move a point of its disk's rim outside
            in_scene, in_details = in_scene | ~aimed, in_details | aimed
        of_details = dr.select(in_details, share * self.details.pdf_a(), 0)
        return dr.select(in_scene, (1 - share) * scene, 0) + of_details

    def factor(self, p, d, share: float) -> Factor:
        """Effect of tables on the density of subpaths past ``p``; ``share``: see `share`."""
        if self.details is None:
            return Factor.whole()
        before = self.pdf_a(p, d)
        scaled = dr.select(self.scene.is_passed(p, d), (1 - share) * self.scene.pdf_a(), 0)
        kept = dr.select(self.details.is_passed(p, d), share * self.details.pdf_a(), 0)
        usual = before == 0
        return Factor(dr.select(usual, 1, scaled / before), dr.select(usual, 0, kept / before))

    def covers(self, p, d):
        """Mask: light subpaths along ``d`` can pass ``p``; true for all points of shapes."""
        passed = self.scene.is_passed(p, d)
        if self.details is not None:
            passed |= self.details.is_passed(p, d)
        return passed & (dr.dot(p - self.scene.center, d) >= -self.scene.radius)


# An arbitrary rotation: frames are mirrored where z = 0 in its axes, which scenes' directions avoid.
_ODD = np.linalg.qr(np.array([[0.61, -0.34, 0.29], [0.17, 0.83, -0.41], [-0.53, 0.26, 0.71]]))[0].tolist()


def _frame(d) -> mi.Frame3f:
    """Frame about ``d``, independent of rounding for directions along axes."""
    x, y, z = (mi.Vector3f(*axis) for axis in _ODD)
    turned = mi.Frame3f(mi.Vector3f(dr.dot(x, d), dr.dot(y, d), dr.dot(z, d)))
    s, t = (v.x * x + v.y * y + v.z * z for v in (turned.s, turned.t))
    return mi.Frame3f(s, t, d)


def details(found: list, whole):
    """Bounding sphere of the boxes small beside ``whole``; None if none, spread (`LOCAL`) or `TINY`."""
    small = mi.ScalarBoundingBox3f()
    for box in found:
        if max(box.extents()) <= DETAIL * max(whole.extents()):
            small.expand(box)
    if not small.valid():
        return None
    sphere, radius = small.bounding_sphere(), whole.bounding_sphere().radius
    far = radius + float(np.abs([whole.min, whole.max]).max())
    return sphere if TINY * far <= sphere.radius <= LOCAL * radius else None
