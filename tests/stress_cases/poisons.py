"""Plugins and textures with numbers that are not finite, and rooms to put them in."""

from __future__ import annotations

from functools import cache

import drjit as dr
import numpy as np

import mitsuba as mi  # isort: skip

NAN, INF = float("nan"), float("inf")

# Of the film, along each side.
SIZE = 16


class Scales:
    """The numbers that a poisoned plugin multiplies with, by what they multiply; 1 where none is given."""

    def __init__(self, props, *names):
        self._factors = {name: dr.opaque(mi.Float, props.get(name, 1.0)) for name in names}

    def of(self, name, where):
        """The factor of ``name`` at the places in ``where``, else 1."""
        return dr.select(where, self._factors[name], 1)


def poison():
    """The class of the BSDF ``poison``. (Mitsuba's classes exist once a variant is chosen.)"""

    class Poison(mi.BSDF):
        """Diffuse; where u > 0.5, the scales multiply what it answers.

        The sampled weight, the direction, eta, the value, the density.
        """

        def __init__(self, props):
            super().__init__(props)
            self.inner = mi.load_dict({"type": "diffuse", "reflectance": 0.6})
            self.m_flags = self.inner.flags()
            self.m_components = [self.m_flags]
            self.scales = Scales(props, "weight", "direction", "eta", "eval", "pdf")

        def scale(self, name, si):
            return self.scales.of(name, si.uv.x > 0.5)

        def sample(self, ctx, si, u1, u2, active=True):
            bs, weight = self.inner.sample(ctx, si, u1, u2, active)
            bs.wo *= self.scale("direction", si)
            bs.pdf *= self.scale("pdf", si)
            bs.eta *= self.scale("eta", si)
            return bs, weight * self.scale("weight", si)

        def eval(self, ctx, si, wo, active=True):
            return self.inner.eval(ctx, si, wo, active) * self.scale("eval", si)

        def pdf(self, ctx, si, wo, active=True):
            return self.inner.pdf(ctx, si, wo, active) * self.scale("pdf", si)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return "Poison[]"

    return Poison


def poison_lamp():
    """The class of the emitter ``poison_lamp``."""

    class PoisonLamp(mi.Emitter):
        """Surroundings of radiance 1; in half of all directions the scales multiply radiance and density.

        The half is x > 0. The weight of a sampled direction is what a sound density would make it.
        """

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.Infinite)
            self.scales = Scales(props, "eval", "pdf")

        def scale(self, name, d):
            return self.scales.of(name, d.x > 0)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist = mi.Float(100)
            ds.p, ds.d, ds.n, ds.uv, ds.time = it.p + d * ds.dist, d, -d, mi.Point2f(sample), it.time
            ds.pdf = dr.select(active, dr.inv_four_pi * self.scale("pdf", d), 0)
            ds.delta, ds.emitter = mi.Bool(False), mi.EmitterPtr(self)
            return ds, dr.select(active, mi.Spectrum(4 * dr.pi * self.scale("eval", d)), 0)

        def pdf_direction(self, it, ds, active=True):
            return dr.select(active, dr.inv_four_pi * self.scale("pdf", ds.d), 0)

        def eval(self, si, active=True):
            return dr.select(active, mi.Spectrum(self.scale("eval", -si.wi)), 0)

        def sample_wavelengths(self, si, sample, active=True):
            raise NotImplementedError

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return "PoisonLamp[]"

    return PoisonLamp


def register():
    """Register the plugins ``poison`` (a BSDF) and ``poison_lamp`` (an emitter) for the variant in use."""
    _register(mi.variant())


@cache
def _register(variant: str):
    mi.register_bsdf("poison", poison())
    mi.register_emitter("poison_lamp", poison_lamp())


def texture(bad, base=0.6):
    """4 x 4 texels of which three are ``bad``, a number or one per colour; no texel spreads into others."""
    data = np.full((4, 4, 3), base, dtype=np.float32)
    data[0, 1] = data[2, 2] = data[3, 0] = bad
    # Raw colours are no spectra.
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": not mi.is_spectral, "filter_type": "nearest"}


BAD_TEXELS, TEXELS = 3, 16


def brightness(value):
    """Of a lamp. (A spectral variant scales a number by daylight, and refuses such a spectrum that is 0.)"""
    return {"type": "uniform", "value": value} if mi.is_spectral else value


def to_world():
    """The plate of `room` in its place."""
    return mi.ScalarTransform4f().translate([0, -0.3, -0.2]).rotate([1, 0, 0], -50).scale(0.45)


def down():
    """From above onto the plate of `room`."""
    return mi.ScalarTransform4f().look_at([0, 0.5, 0.3], [0, -0.3, -0.2], [0, 0, 1])


def diffuse(reflectance: float):
    """A number may be above 1, which a colour may not."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def area(radiance):
    return {"type": "area", "radiance": radiance}


def camera(**keys):
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    placed = mi.ScalarTransform4f().look_at([0, 0.1, 0.8], [0, -0.1, -1], [0, 1, 0])
    return {
        "type": "perspective",
        "fov": 70,
        "near_clip": 1e-3,
        "to_world": placed,
        "film": film | {"rfilter": {"type": "box"}},
    } | keys


def room(bsdf=None, **parts):
    """A closed sphere with a plate of the ``bsdf`` that fills a part of the view, and a lamp.

    Or other ``parts`` in their place.
    """
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    lamp_at = mi.ScalarTransform4f().translate([0.3, 0.8, 0]).rotate([1, 0, 0], 90).scale(0.2)
    inside = {
        "wall": {"type": "sphere", "bsdf": grey},
        "plate": {"type": "rectangle", "to_world": to_world(), "bsdf": bsdf or grey},
        "lamp": {"type": "rectangle", "to_world": lamp_at, "emitter": {"type": "area", "radiance": 4.0}},
    }
    parts = {name: part for name, part in (inside | parts).items() if part is not None}
    return mi.load_dict({"type": "scene", "sensor": camera(), **parts})


def filled(bsdf, **parts):
    """A plate that fills the film, lit by a point above all of it, which each of its points sees.

    Each texel covers 4 x 4 pixels.
    """
    fov = float(np.rad2deg(2 * np.arctan(0.25)))
    facing = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = {
        "type": "scene",
        "sensor": camera(fov=fov, to_world=facing),
        "plate": {"type": "rectangle", "bsdf": bsdf},
        "lamp": {"type": "point", "position": [0, 0, 3.0], "intensity": 5.0},
    }
    return mi.load_dict({name: part for name, part in (scene | parts).items() if part is not None})


def painted(bad):
    return {"type": "diffuse", "reflectance": texture(bad)}
