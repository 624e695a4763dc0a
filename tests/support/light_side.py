"""`bsdf.sample` and `bsdf.evaluate` as light subpaths call them."""

from functools import partial

from mitsuba_bdpt.transport import bsdf

sample_adjoint = partial(bsdf.sample, adjoint=True)


def evaluate_adjoint(plugin, si, wo, active, traits, cos_ratio=None):
    if cos_ratio is None:
        cos_ratio = bsdf.geometric_cos(si, wo) / bsdf.geometric_cos(si, si.wi)
    return bsdf.evaluate(plugin, si, wo, active, traits, cos_ratio)
