"""Rows of sweeps, made by hand; projects and a scene file to measure."""

import json

import numpy as np
from mitsuba_bdpt.measure.agreement import Means, tile_columns
from mitsuba_bdpt.measure.figures import RAYS
from mitsuba_bdpt.measure.results import rel_mse_columns
from repository import ROOT

ROOM = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
            <string name="pixel_format" value="rgb"/><string name="component_format" value="float32"/>
            <rfilter type="box"/></film>
    </sensor>
    <shape type="sphere"><float name="radius" value="5"/><boolean name="flip_normals" value="true"/></shape>
    <shape type="sphere"><point name="center" x="0" y="0" z="3"/><float name="radius" value="0.3"/>
        <emitter type="area"><rgb name="radiance" value="3, 2, 1"/></emitter></shape>
</scene>"""


def new_project(path):
    """Make a folder a project with the repository's scenes and their recipes."""
    for name in ("presets", "references"):
        (path / name).mkdir()
    for name in ("scenes", "presets/benchmark.toml", "references/scenes.toml"):
        (path / name).symlink_to(ROOT / name)
    return path


TRUE = np.full(51, 2.0)
KNOWN = Means.known(np.full((4, 4, 3), 2.0))
"""Means of a reference of 2 everywhere."""


def row(method="bdpt", seed=1, **values):
    """A render of 64 samples in 1 second with relMSE 0.02, raw and trimmed."""
    plain = {
        "scene": "box",
        "method": method,
        "key": f"{method}{seed}",
        "first": "bdpt",
        "budget": 64,
        "spp": 64,
        "seed": seed,
        "seconds": 1.0,
        "rel_mse": 0.02,
        "rel_mse_trimmed": 0.02,
        "reference_rel_mse": 0.0,
        "reference_rel_mse_trimmed": 0.0,
        "reference_sha256": "",
        "resolution": 8,
        "width": 8,
        "height": 8,
        "max_depth": 3,
        "sampler": "independent",
        "machine": "a machine",
        "started": "2026-11-28T15:23:37+00:00",
        "versions": '{"mitsuba": "3.9.1", "source": "s"}',
        "tile_means": list(TRUE),
        "decisions": json.dumps([{"light_paths": 0.25, "connections": "one"}]),
        "statistics": "{}",
    }
    return plain | {f"rays_{kind}": 640 for kind in RAYS} | values


def judged(method, seed, image, reference, **values):
    """The row of an image with its errors against a reference."""
    means = {"tile_means": tile_columns(image).tolist(), "mean": float(image.mean())}
    return row(method, seed, **rel_mse_columns(image, reference), **means, **values)
