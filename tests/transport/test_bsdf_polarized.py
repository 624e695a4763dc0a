"""Mueller matrices of Mitsuba's BSDFs from either side, in polarized variants."""

import tempfile
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import variants
from bsdf_parts import bumps, tilted
from light_side import evaluate_adjoint, sample_adjoint
from mitsuba.python import tensor_io
from mitsuba_bdpt.transport import bsdf

COUNT = 4096

METAL = {"eta": 0.5, "k": 2.0}
GLASS = {"type": "dielectric", "int_ior": 1.5}
MIRROR = {"type": "conductor", **METAL}
ROUGH = {"type": "roughconductor", "alpha": 0.3, **METAL}
PLASTIC = {"type": "pplastic", "alpha": 0.3, "diffuse_reflectance": 0.5}


@cache
def measured():
    """A file for ``measured_polarized``: made-up matrices by half and difference angles and wavelengths."""
    angles = {
        "phi_d": np.linspace(0, 2 * np.pi, 9),
        "theta_d": np.linspace(0, np.pi / 2, 5),
        "theta_h": np.linspace(0, np.pi / 2, 6),
    }
    rng = np.random.default_rng(7)
    matrices = np.zeros((9, 5, 6, 5, 4, 4))
    matrices[..., 0, 0] = 0.2 + 0.5 * np.cos(angles["theta_h"])[None, None, :, None] ** 8
    matrices += 0.1 * rng.random((1, 5, 6, 1, 4, 4)) * matrices[..., :1, :1]
    fields = {name: values[None].astype(np.float32) for name, values in angles.items()}
    fields |= {"wvls": np.arange(450, 700, 50, dtype=np.uint16), "M": matrices.astype(np.float32)}
    file = Path(tempfile.mkdtemp()) / "made_up.pbsdf"
    tensor_io.write(file, **fields)
    return str(file)


# What scatters by evaluations, and what by delta events; by name.
SMOOTH = {
    "roughconductor": lambda: ROUGH,
    "pplastic": lambda: PLASTIC,
    "mask": lambda: {"type": "mask", "opacity": 0.4, "nested": PLASTIC},
    "twosided": lambda: {"type": "twosided", "nested": ROUGH},
    "blend": lambda: {"type": "blendbsdf", "weight": 0.3, "a": ROUGH, "b": PLASTIC},
    "bumpmap": lambda: bumps(ROUGH),
    "measured_polarized": lambda: {
        "type": "measured_polarized",
        "filename": measured(),
        "wavelength": 550.0,
        "alpha_sample": 0.5,
    },
}
DELTA = {
    "dielectric": lambda: GLASS,
    "thindielectric": lambda: {"type": "thindielectric"},
    "conductor": lambda: MIRROR,
    "polarizer": lambda: {"type": "polarizer", "theta": 33.0},
    "retarder": lambda: {"type": "retarder", "theta": 20.0, "delta": 70.0},
    "circular": lambda: {"type": "circular"},
    "mask": SMOOTH["mask"],
    "twosided mirror": lambda: {"type": "twosided", "nested": MIRROR},
    "bumpy mirror": lambda: bumps(MIRROR),
    "bumpy glass": lambda: tilted(GLASS),
}


@pytest.fixture(autouse=True)
def _polarized():
    mi.set_variant(variants.of("mono_polarized"))


def surface(make):
    """A BSDF's traits, and points of a rectangle seen from directions all around."""
    shape = mi.load_dict(
        {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([0.3, 0.2, 0.1], [1, 2, 0.5], [0, 0, 1]),
            "bsdf": make(),
        }
    )
    rng = np.random.default_rng(3)
    uv = mi.Point2f(rng.random((2, COUNT)).astype(np.float32))
    found = shape.eval_parameterization(uv, mi.RayFlags.All)
    found.initialize_sh_frame()
    found.wi = directions(rng)
    return bsdf.Traits.of([shape.bsdf()]), shape, found


def directions(rng):
    d = rng.standard_normal((3, COUNT))
    return mi.Vector3f((d / np.linalg.norm(d, axis=0)).astype(np.float32))


def matrices(value):
    """(lanes, 4, 4) of a spectrum of one entry."""
    entries = [[np.broadcast_to(np.array(value[i, j]).ravel(), COUNT) for j in range(4)] for i in range(4)]
    return np.moveaxis(np.array(entries, dtype=np.float64), -1, 0)


def difference(a, b):
    """Largest difference of the entries, each over its intensity."""
    a, b = (m / m[:, :1, :1] for m in (a, b))
    return np.abs(a - b).max((1, 2))


def drawn(make, sample):
    """What ``sample`` draws at a surface, and the surface, its points, and the numbers that drew it."""
    traits, shape, si = surface(make)
    rng = np.random.default_rng(5)
    u1 = mi.Float(rng.random(COUNT).astype(np.float32))
    u2 = mi.Point2f(rng.random((2, COUNT)).astype(np.float32))
    step, _ = sample(shape.bsdf(), si, u1, u2, mi.Bool(True), traits)
    return step, shape, si, (u1, u2)


@pytest.mark.parametrize("name", SMOOTH)
def test_evaluations_are_of_light_from_either_side(name):
    """Expected: the matrix that light subpaths evaluate is that of a camera vertex with the directions
    swapped, times the adjoint factor, to rounding."""
    traits, shape, si = surface(SMOOTH[name])
    other = directions(np.random.default_rng(4))
    ours = evaluate_adjoint(shape.bsdf(), si, other, mi.Bool(True), traits)
    theirs = shape.bsdf().eval(mi.BSDFContext(), bsdf.with_wi(si, other), si.wi)
    theirs = si.to_world_mueller(theirs, -si.wi, other)
    ratio = np.array(bsdf.geometric_cos(si, other) / bsdf.geometric_cos(si, si.wi))
    ours, theirs = matrices(ours.value), matrices(theirs)
    lit = theirs[:, 0, 0] > 0
    assert lit.sum() > COUNT / 20
    assert difference(ours[lit], theirs[lit]).max() < 1e-3
    np.testing.assert_allclose(ours[lit, 0, 0], (theirs[:, 0, 0] * ratio)[lit], rtol=1e-4)


@pytest.mark.parametrize("name", DELTA)
def test_delta_events_are_of_light_from_either_side(name):
    """Expected: the matrix of a light subpath's event, made at l towards c, is in proportion to that of
    Mitsuba's ``sample`` from c to l, to rounding (events that the latter does not make are left out); the
    intensity is that of the variant that is not polarized."""
    step, shape, si, numbers = drawn(DELTA[name], sample_adjoint)
    back = bsdf.with_wi(si, step.wo)
    bs, weight = shape.bsdf().sample(mi.BSDFContext(), back, *numbers)
    theirs = matrices(si.to_world_mueller(weight, -bs.wo, back.wi))
    ours = matrices(step.weight)
    same = np.abs(np.array(bs.wo) - np.array(si.wi)).max(0) < 1e-3
    used = np.array(step.delta) & same & (ours[:, 0, 0] > 0) & (theirs[:, 0, 0] > 0)
    assert used.sum() > COUNT / 20
    assert difference(ours[used], theirs[used]).max() < 2e-3
    mi.set_variant(variants.of("mono"))
    plain, *_ = drawn(DELTA[name], sample_adjoint)
    weight = np.broadcast_to(np.array(plain.weight).ravel(), COUNT)
    np.testing.assert_allclose(ours[used, 0, 0], weight[used], rtol=2e-3)
