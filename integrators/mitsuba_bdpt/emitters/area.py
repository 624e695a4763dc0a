"""Area lights: diffuse emission from shapes whose points Mitsuba samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from ..errors import UnsupportedError, UsageError
from ..geometry.boxes import scene_box
from ..geometry.mitsubas_choices import TEXTURE_SAMPLED, is_sampled_by_texture, is_textured
from ..geometry.quadrics import Sphere, cone_pdf_w, is_small, may_light_itself
from ..geometry.smooth_meshes import is_flat
from ..host.introspection import named, number, own_parameters, parts
from .group import Context, Group, HitOnlyEmitters, to_area, weight_over
from .records import Chosen, Direct, Emission, Factor, Place
from .surfaces import Surfaces
from .tables import Mask, look_up, rows, table
from .textured import is_mapped

_CURVES = {mi.ShapeType.BSplineCurve.value, mi.ShapeType.LinearCurve.value}
_SAMPLED = TEXTURE_SAMPLED | {mi.ShapeType.Cylinder.value, mi.ShapeType.Mesh.value}


@dataclass
class _Sphere:
    """How next-event estimation samples a sphere at ``center``; 0: not applicable.

    By area from within ``inner_radius``. ``cone_radius``: that of a sphere which may be so small that
    Mitsuba's density is wrong and `quadrics.cone_pdf_w` is used.
    """

    center: mi.Vector3f | tuple = (0, 0, 0)
    inner_radius: mi.Float | float = 0.0
    cone_radius: mi.Float | float = 0.0

    @staticmethod
    def of(emitter, sphere: Sphere | None, extent: float) -> _Sphere:
        """Parameters of an emitter in a scene of diameter ``extent``."""
        if sphere is None or is_textured(emitter):  # a texture is sampled from every position
            return _Sphere()
        return _Sphere(sphere.center, sphere.inner_radius, sphere.radius if is_small(sphere, extent) else 0.0)


PLAIN = 0.25  # share of a curved light's directions sampled by the cosine where emission is guided
_LEAST_COS = 1e-3  # lower bound of the cosine that a density is divided by


@dataclass
class _Table:
    """Coordinates of the square of an area light's directions.

    Flat lights (``flat`` 1): directions in the ``frame``, stored because one built from a normal is mirrored
    by the sign of a zero. Curved lights: directions in world space, up to their sign.
    """

    s: mi.Vector3f | tuple = (1, 0, 0)
    t: mi.Vector3f | tuple = (0, 1, 0)
    n: mi.Vector3f | tuple = (0, 0, 1)
    flat: mi.Float | float = 0.0

    @staticmethod
    def of(shape: mi.Shape) -> _Table:
        if not is_flat(shape):
            return _Table()
        frame = mi.Frame3f(mi.Vector3f(shape.sample_position(0, mi.Point2f(0.5)).n))
        return _Table(*(dr.slice(axis) for axis in (frame.s, frame.t, frame.n)), flat=1.0)

    def frame(self) -> mi.Frame3f:
        return mi.Frame3f(self.s, self.t, self.n)


class AreaEmitters(Group):
    """Area lights.

    Emission: y_0 uniform on the shape, or by the texture where its density is known (area measure); direction
    by the cosine with the shading normal (solid angle). Next-event estimation is Mitsuba's, except for
    spheres and for textured lights whose points are sampled here.
    """

    @classmethod
    def of(cls, emitter) -> type[Group]:
        return cls if _samples_points(emitter) else HitOnlyEmitters

    @classmethod
    def tables(cls, emitter) -> int:
        return 1

    def __init__(self, emitters, context: Context):
        self._emitters, self._facts = emitters, context.facts
        how = rows(emitters, None, lambda e: _sampled(e, context.by_shapes))
        self._by_texture = Mask(rows(how, None, lambda h: h == "texture"))
        self.redraws = rows(how, False, lambda h: h in ("map", "shape"))
        self._redrawn = Mask([e and r for e, r in zip(emitters, self.redraws, strict=True)])
        self._surfaces = Surfaces(emitters, context, self.redraws, rows(how, None, lambda h: h == "map"))
        pairs = list(zip(emitters, self._surfaces.spheres, strict=True))
        self._lights_itself = Mask([e and may_light_itself(e.get_shape(), s) for e, s in pairs])
        extent = 2 * scene_box(context.scene, context.facts.about).bounding_sphere().radius
        found = [_Sphere.of(e, s, extent) for e, s in pairs]
        self._any_inner = any(sphere.inner_radius > 0 for sphere in found)
        self._seen_through = any(
            sphere.inner_radius > 0 and mi.has_flag(e.get_shape().bsdf().flags(), mi.BSDFFlags.Null)
            for sphere, e in zip(found, emitters, strict=True)
        )
        self._any_cone = any(sphere.cone_radius > 0 for sphere in found)
        self._spheres = table(found)

    def pdf_a(self, emitter, index, at, n, active):
        """Density of y_0 = ``at`` with the normal ``n`` in emission (area measure), without the selection."""
        density = self._own_pdf_a(index, at.uv, active)
        if not self._by_texture.any:
            return density
        # Mitsuba's density of a texture is that of area only at unit distance along the normal.
        textured = self._by_texture.at(index, active)
        it = dr.zeros(mi.Interaction3f)
        it.p = at.p + n
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv, ds.d, ds.dist = at.p, n, at.uv, -mi.Vector3f(n), mi.Float(1)
        return dr.select(textured, emitter.pdf_direction(it, ds, textured), density)

    def _own_pdf_a(self, index, uv, active):
        """`pdf_a` of a light whose texture Mitsuba does not sample."""
        textured = self._surfaces.textured
        density = dr.gather(mi.Float, self._surfaces.inv_area, index, active)
        if not textured.mask.any:
            return density
        mapped = textured.mask.at(index, active)
        return dr.select(mapped, textured.pdf_a(index, uv, mapped), density)

    def direct_pdf_w(self, emitter, index, it, ds, active):
        """Density (solid angle) with which next-event estimation at ``it`` samples ``ds``.

        Without the selection. Turns ``ds.n``, which callers build for this call alone.

        Mitsuba samples a sphere with flipped normals as from inside up to radius (1 + RayEpsilon), but its
        ``pdf_direction`` only up to the radius: wrong for points of the sphere itself.
        """
        # Mitsuba masks by the sign of the normal, but the shading frame decides which side emits.
        ds.n = mi.Normal3f(ds.n * dr.select(dr.dot(ds.n, ds.d) > 0, -1.0, 1.0))
        by_area = self._redrawn.at(index, active)
        pdf_w = emitter.pdf_direction(it, ds, active & ~by_area)
        if self._any_inner:
            sphere = look_up(self._spheres, index, active)
            inside = dr.squared_norm(it.p - sphere.center) <= dr.square(sphere.inner_radius)
            by_area = by_area | (active & (sphere.inner_radius > 0) & inside)
            if self._seen_through:
                # From outside Mitsuba samples only the near half, which is dark.
                beyond = dr.dot(ds.p - sphere.center, ds.d) > 0
                pdf_w = dr.select((sphere.inner_radius > 0) & ~inside & beyond, 0, pdf_w)
        cos = dr.abs(dr.dot(ds.d, ds.n))
        pdf_a = self._own_pdf_a(index, ds.uv, active)
        pdf_w = dr.select(by_area, pdf_a * dr.square(ds.dist) / cos, pdf_w)
        if self._any_cone:
            narrow = self._cone_pdf_w(index, it.p, active)
            pdf_w = dr.select(narrow > 0, narrow, pdf_w)
        return pdf_w

    def _cone_pdf_w(self, index, p, active):
        """`quadrics.cone_pdf_w` of the emitter ``index``; 0 unless it is a small sphere."""
        sphere = look_up(self._spheres, index, active)
        return dr.select(active, cone_pdf_w(sphere.center, sphere.cone_radius, p), 0)

    def with_guide(self, guide) -> Group:
        other = super().with_guide(guide)
        shapes = rows(self._emitters, None, lambda emitter: emitter.get_shape())
        about = self._facts.about
        tables = rows(shapes, _Table(), lambda s: about("directions", partial(_Table.of, s), s))
        other._tables = table(tables)
        return other

    def place(self, index, p, d, active) -> Place:
        known = look_up(self._tables, index, active)
        flat = mi.warp.cosine_hemisphere_to_square(known.frame().to_local(d))
        curved = mi.warp.uniform_hemisphere_to_square(dr.mulsign(mi.Vector3f(d), d.z))
        return Place(mi.UInt32(0), dr.select(known.flat > 0, flat, curved))

    def factor(self, index, p, d, cos, side, active) -> Factor:
        flat = look_up(self._tables, index, active).flat > 0
        curved = (1 - PLAIN) / (2 * dr.maximum(cos, _LEAST_COS))
        return Factor(dr.select(flat, 1, curved), dr.select(flat, 0, mi.Float(PLAIN)))

    def _direction_pdf_w(self, index, cos, d, active):
        """Density (solid angle) of emission along ``d``; ``cos``: with the shading normal."""
        own, guide = dr.maximum(cos, 0) * dr.inv_pi, self.guide
        if guide is None:
            return own
        flat, plain = look_up(self._tables, index, active).flat > 0, self._plain(guide, index, active)
        density = guide.density(index, self.place(index, None, d, active), active)
        curved = plain * own + (1 - plain) * dr.select(cos > 0, density * dr.inv_two_pi, 0)
        return dr.select(flat, own * density, curved)

    def _plain(self, guide, index, active):
        return dr.select(guide.is_guided(index, active), PLAIN, 1)

    def _sample_direction(self, index, si, u, active):
        """Sample a direction from ``si``: world, local, density (solid angle)."""
        guide = self.guide
        if guide is None:
            local = mi.warp.square_to_cosine_hemisphere(u)
            return si.to_world(local), local, mi.warp.square_to_cosine_hemisphere_pdf(local)
        known = look_up(self._tables, index, active)
        flat, plain = known.flat > 0, self._plain(guide, index, active)
        by_table = u.x >= plain
        x = dr.select(by_table, (u.x - plain) / (1 - plain), u.x / plain)
        own = si.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(x, u.y)))
        u = mi.Point2f(dr.select(flat, u.x, x), u.y)
        warped, _ = guide.warp(index, mi.UInt32(0), u, active)
        turned = mi.warp.square_to_uniform_hemisphere(warped)
        turned = dr.mulsign(turned, dr.dot(si.sh_frame.n, turned))
        of_flat = known.frame().to_world(mi.warp.square_to_cosine_hemisphere(warped))
        d = dr.select(flat, of_flat, dr.select(by_table, turned, own))
        pdf_w = self._direction_pdf_w(index, dr.dot(si.sh_frame.n, d), d, active)
        return d, si.to_local(d), pdf_w

    def sample_emission(self, chosen: Chosen, u_point, u_direction, shared, active) -> Emission:
        ps, n = self._surfaces.sample(chosen, u_point, shared, active)
        si = mi.SurfaceInteraction3f(ps, shared.wavelengths)
        si.t = mi.Float(0)
        si.shape = chosen.emitter.get_shape()
        d, si.wi, pdf_w = self._sample_direction(chosen.index, si, u_direction, active)
        pdf_a = ps.pdf
        cos = dr.abs(dr.dot(n, d))
        radiance = chosen.emitter.eval(si, active)
        return Emission(
            # A NaN density keeps the weight NaN, to be counted.
            weight=dr.select(pdf_a * pdf_w == 0, 0, radiance * (cos / (pdf_a * pdf_w))),
            d=d,
            anchor=self._surfaces.anchor(chosen, ps.p, n, active),
            cos=cos,
            pdf_first=pdf_a,
            pdf_second=pdf_w,
            index=chosen.index,
            si=si,
        )

    def direction_density(self, chosen: Chosen, emission: Emission, p, d, active):
        return self._direction_pdf_w(chosen.index, dr.dot(emission.si.sh_frame.n, d), d, active)

    def connection_density(self, chosen: Chosen, emission: Emission, si, active):
        # Area measure times squared distance = solid-angle density at the hit times geometric cosine at y_0.
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p, ds.n, ds.uv = emission.si.p, emission.anchor.n, emission.si.uv
        ds.time, ds.d, ds.emitter = emission.si.time, -emission.d, chosen.emitter
        ds.dist = dr.norm(emission.si.p - si.p)
        pdf_w = self.direct_pdf_w(chosen.emitter, chosen.index, mi.Interaction3f(si), ds, active)
        return chosen.pmf * pdf_w * emission.cos

    def radiance_towards(self, chosen: Chosen, emission: Emission, d, active):
        si = mi.SurfaceInteraction3f(emission.si)
        si.wi = si.to_local(d)
        return chosen.emitter.eval(si, active)

    def complete_direct(self, chosen: Chosen, ds, weight, si, u, active) -> Direct:
        ds, shading_pdf_w, weight = self._corrected(chosen, ds, weight, si, u, active)
        n = self._surfaces.geometric_normal(ds, chosen.index, u, active)
        cos_shading, pmf = dr.dot(ds.n, -ds.d), chosen.pmf
        cos = dr.abs(dr.dot(n, ds.d))
        to_geometric = mi.Float(1)
        if self._surfaces.smooth:  # Mitsuba divides by the shading normal's cosine; the measure is geometric
            to_geometric = dr.select(cos != dr.abs(cos_shading), dr.abs(cos_shading) / cos, 1)
        pdf_w = shading_pdf_w * to_geometric * pmf
        pdf_a = self.pdf_a(chosen.emitter, chosen.index, ds, n, active)
        direction = self._direction_pdf_w(chosen.index, cos_shading, -ds.d, active)
        emitted = pmf * pdf_a * direction
        return Direct(
            weight=weight_over(to_geometric * pmf, weight, shading_pdf_w),
            pdf_w=pdf_w,
            d=ds.d,
            anchor=self._surfaces.anchor(chosen, ds.p, n, active),
            emission_ratio=emitted / (pdf_w * cos),
        )

    def _corrected(self, chosen, ds, weight, si, u, active):
        """Correct Mitsuba's sample: sample, density (solid angle, by the shading cosine) and weight."""
        emitter, index = chosen.emitter, chosen.index
        if self._redrawn.any:
            mask = self._redrawn.at(index, active)
            redrawn = _towards(emitter, self._surfaces.sample_own(index, si.time, u, mask), si, mask)
            its_weight = _radiance_over_density(emitter, redrawn, redrawn.pdf, si, mask)
            ds, weight = dr.select(mask, redrawn, ds), dr.select(mask, its_weight, weight)
        pdf_w = ds.pdf
        if self._any_cone:
            in_cone = self._cone_pdf_w(index, si.p, active)
            narrow = in_cone > 0
            pdf_w = dr.select(narrow, in_cone, pdf_w)
            weight = dr.select(narrow, _radiance_over_density(emitter, ds, pdf_w, si, narrow), weight)
        if self._lights_itself.any:
            own = self._lights_itself.at(index, active) & (si.shape == emitter.get_shape())
            weight = dr.select(own, 0, weight)
        return ds, pdf_w, weight

    def hit_densities(self, chosen: Chosen, si, previous, ds, active):
        ds = dr.copy(ds)
        ds.n = mi.Normal3f(si.n)
        pdf_w = chosen.pmf * self.direct_pdf_w(chosen.emitter, chosen.index, previous, ds, active)
        pdf_a = self.pdf_a(chosen.emitter, chosen.index, si, si.n, active)
        direction = self._direction_pdf_w(chosen.index, mi.Frame3f.cos_theta(si.wi), -ds.d, active)
        return pdf_w * to_area(si, ds), chosen.pmf * pdf_a, direction


def _towards(emitter, ps, si, active) -> mi.DirectionSample3f:
    """Sample of next-event estimation at the emitter point ``ps``; density as Mitsuba's, see `_corrected`."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.p, ds.n, ds.uv, ds.time, ds.emitter = ps.p, ps.n, ps.uv, si.time, emitter
    between = ps.p - si.p
    ds.dist = dr.norm(between)
    ds.d = between / ds.dist
    cos = dr.abs(dr.dot(ds.n, ds.d))
    ds.pdf = dr.select(active & (cos > 0), ps.pdf * dr.square(ds.dist) / cos, 0)
    return ds


def _radiance_over_density(emitter, ds, pdf_w, si, active):
    """Radiance of the emitter point ``ds`` towards ``si`` / ``pdf_w``."""
    there = mi.SurfaceInteraction3f(ds, si.wavelengths)
    there.wi = there.to_local(-ds.d)
    return dr.select(pdf_w == 0, 0, emitter.eval(there, active) / pdf_w)


def _sampled(emitter, by_shapes: bool) -> str:
    """How points of an area light are sampled: by Mitsuba ("uniformly", "texture"), or here ("map", "shape").

    "map": by the texture, in `TexturedPoints`; "shape": uniformly although textured.
    """
    if not is_textured(emitter):
        return "uniformly"
    if not is_sampled_by_texture(emitter):
        return "shape"
    if is_mapped(emitter.get_shape()):
        return "map"
    return "shape" if by_shapes else "texture"


def _samples_points(emitter) -> bool:
    """Whether the shape samples points with a density and a known radiance."""
    shape = emitter.get_shape()
    if shape is None:
        raise UnsupportedError(
            f"emitter {named(emitter)} is on a shape that Mitsuba does not name (an ellipsoidsmesh); "
            "use shape type ellipsoids, or a mesh"
        )
    if shape.shape_type() in _CURVES:
        raise UnsupportedError(
            f"emitter {named(emitter)} is on a curve ({named(shape)}), which Mitsuba's emitters cannot "
            "sample; use a cylinder or a mesh"
        )
    if shape.shape_type() not in _SAMPLED and number(shape.sample_position(0, mi.Point2f(0.5)).pdf) == 0:
        return False
    # By parameters: a shape that Python first met as an emitter's has no mesh methods.
    on_mesh = shape.shape_type() == mi.ShapeType.Mesh.value
    if is_textured(emitter) and on_mesh and not len(own_parameters(shape)["vertex_texcoords"]):
        raise UsageError(
            f"emitter {named(emitter)} has a textured radiance on a mesh without texture coordinates "
            f"({named(shape)}); make the radiance uniform, or give the mesh coordinates"
        )
    return "MeshAttribute" not in {part.class_name() for _, part in parts(emitter)}  # needs a face index
