"""Plugins and textures with numbers that are not finite, and rooms with them."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np

from .rooms import filled, room

NAN, INF = float("nan"), float("inf")


def factors(props, *names):
    """What a poisoned plugin multiplies with, by what it multiplies; 1 where nothing is given."""
    return {name: dr.opaque(mi.Float, props.get(name, 1.0)) for name in names}


@cache
def register(variant: str):
    """Register the plugins ``poison`` (a BSDF) and ``poison_lamp`` (an emitter) for a variant."""

    class Poison(mi.BSDF):
        """Diffuse; where u > 0.5, factors multiply what it answers.

        The sampled weight, the direction, eta, the value, the density.
        """

        def __init__(self, props):
            super().__init__(props)
            self.inner = mi.load_dict({"type": "diffuse", "reflectance": 0.6})
            self.m_flags = self.inner.flags()
            self.m_components = [self.m_flags]
            self.factors = factors(props, "weight", "direction", "eta", "eval", "pdf")

        def scale(self, name, si):
            return dr.select(si.uv.x > 0.5, self.factors[name], 1)

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

    class PoisonLamp(mi.Emitter):
        """Surroundings of radiance 1; in half of all directions factors multiply radiance and density.

        The half is x > 0. The weight of a sampled direction is what a sound density would make it.
        """

        def __init__(self, props):
            super().__init__(props)
            self.m_flags = int(mi.EmitterFlags.Infinite)
            self.factors = factors(props, "eval", "pdf")

        def scale(self, name, d):
            return dr.select(d.x > 0, self.factors[name], 1)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.dist = mi.Float(100)
            ds.p, ds.d, ds.n, ds.uv, ds.time = it.p + d * ds.dist, d, -d, mi.Point2f(sample), it.time
            ds.pdf = self.pdf_direction(it, ds, active)
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

    mi.register_bsdf("poison", Poison)
    mi.register_emitter("poison_lamp", PoisonLamp)


def poisoned(name, *zero, **more):
    """Rooms by a value: of a plate on half of which that ``name`` of its BSDF has it, or ``zero`` are 0."""

    def make(value):
        register(mi.variant())
        names = [name] if value != 0 else zero
        return room({"type": "poison"} | dict.fromkeys(names, value), **more)

    return make


# Nobody asks for the index of refraction in a scene that refracts nothing.
GLASS = {"type": "sphere", "radius": 0.1, "bsdf": {"type": "dielectric"}}
BSDFS = {
    "weight": poisoned("weight", "weight"),
    "direction": poisoned("direction", "weight"),
    "eta": poisoned("eta", "weight", other=GLASS),
    "eval": poisoned("eval", "eval"),
    "pdf": poisoned("pdf", "weight", "eval"),
}


def sky_of(name):
    """Rooms by a value: under a user's environment, half of whose values of that ``name`` have it."""

    def make(value):
        register(mi.variant())
        # Where the density is 0, so is what is sampled there: the twin's other half is black.
        return room(wall=None, sky={"type": "poison_lamp", (name if value != 0 else "eval"): value})

    return make


BAD_TEXELS = 3 / 16


def texture(bad, base=0.6):
    """4 x 4 texels of which three are ``bad``, a number or one per colour; no texel spreads into others."""
    data = np.full((4, 4, 3), base, dtype=np.float32)
    data[0, 1] = data[2, 2] = data[3, 0] = bad
    # Raw colours are no spectra.
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": not mi.is_spectral, "filter_type": "nearest"}


def brightness(value):
    """Of a lamp. (A spectral variant scales a number by daylight, and refuses such a spectrum that is 0.)"""
    return {"type": "uniform", "value": value} if mi.is_spectral else value


def painted(bad):
    return {"type": "diffuse", "reflectance": texture(bad)}


def reflecting(bad):
    """A plate that fills the film, with bad texels."""
    return filled(painted(bad))
