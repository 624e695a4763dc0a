"""What plugins written in Python state about themselves, beside what they return."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from mitsuba_bdpt.scene import plugin_claims
from mitsuba_bdpt.scene.plugin_claims import check_plugins
from scene_parts import EMITTERS, T, register_plugins, room

FLAGS = mi.BSDFFlags


def text(self):
    return f"{type(self).__name__}[]"


class Halves(mi.Texture):
    """Bright on the left, dark on the right; sampled uniformly."""

    varying, density = True, 1.0

    def __init__(self, props):
        super().__init__(props)

    def eval(self, si, active=True):
        return mi.Spectrum(dr.select(si.uv.x < 0.5, 5.0, 1.0))

    def mean(self):
        return mi.Float(3)

    def is_spatially_varying(self):
        return self.varying

    def sample_position(self, sample, active=True):
        return mi.Point2f(sample), mi.Float(1)

    def pdf_position(self, uv, active=True):
        return mi.Float(self.density)

    to_string = text


class LeftHalf(Halves):
    """Sampled on the left alone."""

    def sample_position(self, sample, active=True):
        return mi.Point2f(sample.x / 2, sample.y), mi.Float(2)

    def pdf_position(self, uv, active=True):
        return dr.select(uv.x < 0.5, mi.Float(2), 0)


class Unsampled(mi.Texture):
    """Sampled uniformly, as Mitsuba's base class does."""

    def __init__(self, props):
        super().__init__(props)

    def eval(self, si, active=True):
        return mi.Spectrum(si.uv.x)

    def is_spatially_varying(self):
        return True

    to_string = text


class Matte(mi.BSDF):
    """White and matte from both sides, or what ``stated``, ``drawn`` and ``through`` make of it."""

    stated = FLAGS.DiffuseReflection | FLAGS.FrontSide | FLAGS.BackSide
    drawn, through, nothing = FLAGS.DiffuseReflection, False, False

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = int(self.stated)
        self.m_components = [int(self.stated)]

    def sample(self, ctx, si, u1, u2, active=True):
        wo = mi.warp.square_to_cosine_hemisphere(u2)
        pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        wo.z = dr.mulsign(wo.z, -si.wi.z if self.through else si.wi.z)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(wo))
        bs.wo, bs.pdf, bs.eta = wo, pdf, mi.Float(1)
        bs.sampled_type, bs.sampled_component = mi.UInt32(int(self.drawn)), mi.UInt32(0)
        return bs, dr.select(active, mi.Spectrum(0.5), 0)

    def eval(self, ctx, si, wo, active=True):
        return 0.5 * mi.Spectrum(self.pdf(ctx, si, wo, active))

    def pdf(self, ctx, si, wo, active=True):
        side = (wo.z * si.wi.z < 0) == mi.Bool(self.through)
        return dr.select(side & mi.Bool(not self.nothing), dr.abs(wo.z) * dr.inv_pi, mi.Float(0))

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

    to_string = text


class Sky(mi.Emitter):
    """Even surroundings."""

    stated, delta, density, seen = mi.EmitterFlags.Infinite, False, 1.0, 1.0

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = int(self.stated)

    def sample_direction(self, it, sample, active=True):
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
        ds.d, ds.dist, ds.time = mi.warp.square_to_uniform_sphere(sample), mi.Float(100), it.time
        ds.p, ds.n = it.p + 100 * ds.d, -ds.d
        ds.pdf, ds.delta = mi.Float(dr.inv_four_pi), mi.Bool(self.delta)
        ds.emitter = mi.EmitterPtr(self)
        return ds, mi.Spectrum(4 * dr.pi)

    def pdf_direction(self, it, ds, active=True):
        return mi.Float(self.density * dr.inv_four_pi)

    def eval(self, si, active=True):
        return mi.Spectrum(self.seen)

    def bbox(self):
        return mi.ScalarBoundingBox3f()

    to_string = text


class Ahead(mi.PhaseFunction):
    """Scatters evenly."""

    density = 1.0

    def __init__(self, props):
        super().__init__(props)
        self.m_flags = mi.PhaseFunctionFlags.Isotropic

    def sample(self, ctx, mei, u1, u2, active=True):
        return mi.warp.square_to_uniform_sphere(u2), mi.Spectrum(1), mi.Float(dr.inv_four_pi)

    def eval_pdf(self, ctx, mei, wo, active=True):
        return mi.Spectrum(dr.inv_four_pi), mi.Float(self.density * dr.inv_four_pi)

    to_string = text


class Fog(mi.Medium):
    """Fog of extinction 1, or more to the right."""

    homogeneous, more, most = True, 0.0, 1.0

    def __init__(self, props):
        super().__init__(props)
        self.m_is_homogeneous = self.homogeneous
        self.m_has_spectral_extinction = False

    def intersect_aabb(self, ray):
        return mi.Bool(True), mi.Float(0), mi.Float(dr.inf)

    def get_majorant(self, mei, active=True):
        return mi.UnpolarizedSpectrum(self.most)

    def get_scattering_coefficients(self, mei, active=True):
        sigma_t = mi.UnpolarizedSpectrum(dr.select(mei.p.x > 0, 1 + self.more, 1.0))
        return sigma_t / 2, sigma_t * 0, sigma_t

    to_string = text


def lamp(texture):
    return EMITTERS["sphere"]() | {"emitter": {"type": "area", "radiance": texture}}


def thing(bsdf):
    return {"type": "sphere", "center": [0, 1, 0], "radius": 0.3, "bsdf": bsdf}


def cloud(medium=None, phase=None):
    inside = (medium or {"type": "homogeneous"}) | ({"phase": phase} if phase else {})
    return {
        "type": "cube",
        "to_world": T().translate([0, 1, 0]).scale(0.4),
        "bsdf": {"type": "null"},
        "interior": inside,
    }


# The entry of a scene, the base of the plugin's class, what is changed, and the method that is named; None
# where nothing is wrong.
CASES = {
    "texture": (lamp, Halves, {}, None),
    "varying texture": (lamp, Halves, {"varying": False}, r"is_spatially_varying\(\) returns False"),
    "texture's density": (lamp, Halves, {"density": 0.5}, r"pdf_position\(\) is not the density"),
    "texture's other half": (lamp, LeftHalf, {}, r"pdf_position\(\) is 0 on 50%"),
    "texture without samples": (lamp, Unsampled, {}, None),
    "texture of a bsdf": (
        lambda p: thing({"type": "diffuse", "reflectance": p}),
        Halves,
        {"varying": False, "density": 0.5},
        None,
    ),
    "bsdf": (thing, Matte, {}, None),
    "bsdf without flags": (thing, Matte, {"stated": FLAGS.Empty}, r"flags\(\) states no diffuse"),
    "bsdf that says delta": (
        thing,
        Matte,
        {"drawn": FLAGS.DeltaReflection},
        r"flags\(\) states no delta lobe",
    ),
    "bsdf that says smooth": (thing, Matte, {"nothing": True}, r"sample\(\) returns sampled_type"),
    "bsdf that transmits": (thing, Matte, {"through": True}, r"flags\(\) states no transmitting lobe"),
    "sky": (lambda p: p, Sky, {}, None),
    "sky that says delta": (
        lambda p: p,
        Sky,
        {"stated": mi.EmitterFlags.Infinite | mi.EmitterFlags.DeltaDirection},
        r"eval\(\) returns radiance for rays",
    ),
    "delta sky": (lambda p: p, Sky, {"delta": True}, r"samples that are delta"),
    "sky's density": (lambda p: p, Sky, {"density": 2.0}, r"pdf_direction\(\) is not the density"),
    "sky's radiance": (lambda p: p, Sky, {"seen": 0.5}, r"eval\(\) is not what sample_direction"),
    "phase": (lambda p: cloud(phase=p), Ahead, {}, None),
    "phase's density": (lambda p: cloud(phase=p), Ahead, {"density": 2.0}, r"eval_pdf\(\) is not what"),
    "fog": (cloud, Fog, {}, None),
    "fog that varies": (cloud, Fog, {"more": 1.0, "most": 2.0}, r"is_homogeneous\(\) returns True"),
    "fog's majorant": (cloud, Fog, {"homogeneous": False, "more": 1.0}, r"get_majorant\(\) is less"),
}
REGISTER = {
    mi.Texture: mi.register_texture,
    mi.BSDF: mi.register_bsdf,
    mi.Emitter: mi.register_emitter,
    mi.PhaseFunction: mi.register_phase,
    mi.Medium: mi.register_medium,
}


@pytest.mark.parametrize("name", CASES)
def test_statements_are_compared_with_answers(name):
    """Rationale: a texture whose `is_spatially_varying` was left at its default made `default` and
    `skip=none` 18 % apart, both wrong, without a word.

    Expected: an error that names the plugin's class and the method, before a sample is taken, again in the
    next render; none for plugins whose statements hold.
    """
    entry, base, changes, message = CASES[name]
    own = type(f"Own{base.__name__}", (base,), changes)
    key = f"stated_{name.replace(' ', '_').replace(chr(39), '')}"
    REGISTER[next(kind for kind in REGISTER if issubclass(base, kind))](key, own)
    scene = mi.load_dict(room(thing=entry({"type": key})))
    if message is None:
        check_plugins(scene, scene.sensors()[0])
        return
    bdpt = mi.load_dict({"type": "bdpt"})
    for _ in range(2):
        with pytest.raises(ValueError, match=rf"of the Python class Own{base.__name__} .*: .*{message}"):
            bdpt.render(scene, spp=1)


class Mistyped(Halves):
    """Lacks the parameter ``active`` of Mitsuba's method."""

    def eval(self, si):
        return mi.Spectrum(si.uv.x)


class Buggy(Halves):
    """Fails in `eval`."""

    def eval(self, si, active=True):
        raise RuntimeError("a bug")


@pytest.mark.parametrize(("kind", "words"), [(Mistyped, r"takes 2 positional"), (Buggy, "a bug")])
def test_a_method_that_fails_is_not_taken_for_one_that_is_not_there(kind, words):
    """Rationale: a wrong signature went without a check, and without a word. Expected: its error."""
    mi.register_texture(f"stated_{kind.__name__}", kind)
    scene = mi.load_dict(room(thing=lamp({"type": f"stated_{kind.__name__}"})))
    with pytest.raises((TypeError, RuntimeError), match=words):
        check_plugins(scene, scene.sensors()[0])


def test_mitsubas_own_plugins_are_not_asked(monkeypatch):
    """Expected: nothing is asked in a scene of Mitsuba's plugins, though the process knows others; one of the
    user's is asked once for all renders, and again after an edit."""
    register_plugins()
    asked = []
    spied = {base: lambda owner, *_: asked.append(owner) or () for base in plugin_claims._CHECKS}
    monkeypatch.setattr(plugin_claims, "_CHECKS", spied)
    scene = mi.load_dict(room(lamp=EMITTERS["textured"]()))
    check_plugins(scene, scene.sensors()[0])
    assert not asked
    scene = mi.load_dict(room(lamp=EMITTERS["own sky"]()))
    for _ in range(2):
        check_plugins(scene, scene.sensors()[0])
    assert len(asked) == 1
    params = mi.traverse(scene)
    params["lamp.radiance"] = mi.Float(2)
    params.update()
    check_plugins(scene, scene.sensors()[0])
    assert len(asked) == 2
    assert np.isfinite(dr.slice(asked[0].radiance))
