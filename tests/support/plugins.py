"""Plugins in Python that stand for those of users: classes that the package does not know."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

_registered = set()


def register_plugins():
    """Register the plugins for the current variant, once."""
    if mi.variant() in _registered:
        return
    _registered.add(mi.variant())
    for register in (_emitters, _sensor, _media):
        register()


def _emitters():
    class OwnEmitter(mi.Emitter):
        """What both emitters share: no more than `path` calls."""

        def __init__(self, props):
            super().__init__(props)
            self.radiance = mi.Float(props.get("radiance", 1.0))

        def traverse(self, callback):
            callback.put("radiance", self.radiance, mi.ParamFlags.Differentiable)
            callback.put("name", "a text", mi.ParamFlags.NonDifferentiable)

        def sample_wavelengths(self, si, sample, active=True):
            raise NotImplementedError

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return f"{type(self).__name__}[]"

    class OwnLamp(OwnEmitter):
        """A point light; ``radiance`` is its intensity."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.DeltaPosition)

        def sample_direction(self, it, sample, active=True):
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p = self.world_transform() @ mi.Point3f(0)
            away = ds.p - it.p
            ds.dist = dr.norm(away)
            ds.d = away / ds.dist
            ds.time = it.time
            ds.pdf = dr.select(active, mi.Float(1), 0)
            ds.delta = mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            return ds, dr.select(active, mi.Spectrum(self.radiance / dr.square(ds.dist)), 0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval(self, si, active=True):
            return mi.Spectrum(0)

    class OwnSky(OwnEmitter):
        """Surroundings that are brighter above; directions are chosen uniformly."""

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.Infinite)

        def seen(self, d, active):
            return dr.select(active, mi.Spectrum(self.radiance * (1 + 0.5 * d.y)), 0)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist = mi.Float(100)
            ds.p = it.p + d * ds.dist
            ds.d, ds.n, ds.uv, ds.time = d, -d, mi.Point2f(sample), it.time
            ds.pdf = dr.select(active, mi.Float(dr.inv_four_pi), 0)
            ds.delta = mi.Bool(False)
            ds.emitter = mi.EmitterPtr(self)
            return ds, self.seen(d, active) * (4 * dr.pi)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(active, mi.Float(dr.inv_four_pi), 0)

        def eval(self, si, active=True):
            return self.seen(-si.wi, active)

    class RayleighSky(OwnSky):
        """Light that air scatters once, polarized across the sun's plane (in polarized variants)."""

        def seen(self, d, active):
            sun = dr.normalize(mi.Vector3f(0.5, 0.7, 0.4))
            cos, across = dr.dot(d, sun), dr.normalize(dr.cross(d, sun))
            turned = mi.mueller.rotate_stokes_basis(-d, across, mi.mueller.stokes_basis(-d))
            vector = 1 + dr.square(cos), 1 - dr.square(cos), 0, 0  # in the frame whose x axis is ``across``
            value = dr.zeros(mi.Spectrum)
            for i in range(4):
                value[i, 0] = mi.UnpolarizedSpectrum(sum(turned[i, j] * vector[j] for j in range(4)))
            return dr.select(active, value, 0)

    mi.register_emitter("own_lamp", OwnLamp)
    mi.register_emitter("own_sky", OwnSky)
    mi.register_emitter("rayleigh_sky", RayleighSky)


def _sensor():
    class OwnFisheye(mi.Sensor):
        """A camera whose directions bend outwards."""

        def __init__(self, props):
            super().__init__(props)
            self.m_needs_sample_3 = False

        def sample_ray(self, time, sample1, sample2, sample3, active=True):
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
            x, y = 1 - 2 * sample2.x, 1 - 2 * sample2.y
            d = dr.normalize(mi.Vector3f(x, y, 2.5 - 0.4 * (x * x + y * y)))
            to_world = self.world_transform()
            return mi.Ray3f(to_world @ mi.Point3f(0), to_world @ d, time, wavelengths), weight

        def sample_ray_differential(self, time, sample1, sample2, sample3, active=True):
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "OwnFisheye[]"

    mi.register_sensor("own_fisheye", OwnFisheye)


def _media():
    class OwnPhase(mi.PhaseFunction):
        """(1 + a cos) / 4 pi, cos of the angle that light is turned by."""

        def __init__(self, props):
            super().__init__(props)
            self.a = mi.Float(props.get("a", 0.8))
            self.m_flags = mi.PhaseFunctionFlags.Anisotropic

        def eval_pdf(self, ctx, mei, wo, active=True):
            density = (1 - self.a * dr.dot(mei.wi, wo)) / (4 * dr.pi)
            return mi.Spectrum(density), density

        def sample(self, ctx, mei, sample1, sample2, active=True):
            cos = (dr.sqrt(dr.square(1 - self.a) + 4 * self.a * sample2.x) - 1) / self.a
            sin, phi = dr.safe_sqrt(1 - cos * cos), 2 * dr.pi * sample2.y
            d = mi.Vector3f(sin * dr.cos(phi), sin * dr.sin(phi), cos)
            wo = mi.Frame3f(-mei.wi).to_world(d)
            return wo, mi.Spectrum(1), (1 + self.a * cos) / (4 * dr.pi)

    class OwnFog(mi.Medium):
        """Gray and homogeneous, by the calls that ``volpath`` makes."""

        def __init__(self, props):
            super().__init__(props)
            self.extinction, self.albedo = (mi.Float(props.get(name)) for name in ("extinction", "albedo"))
            self.m_is_homogeneous, self.m_has_spectral_extinction = True, False
            self.m_sample_emitters = True

        def intersect_aabb(self, ray):
            return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

        def get_majorant(self, mei, active=True):
            return mi.Spectrum(self.extinction)

        def get_scattering_coefficients(self, mei, active=True):
            sigma_t = mi.Spectrum(self.extinction)
            return sigma_t * self.albedo, mi.Spectrum(0), sigma_t

    mi.register_phase("own_phase", OwnPhase)
    mi.register_medium("own_fog", OwnFog)
