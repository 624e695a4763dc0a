"""Guided s = 0: unbiased whatever the guide says, and where it pays."""

from __future__ import annotations

import mitsuba as mi
import pytest
import welch as st
from test_merging import ball, bumpy, glass, images, matte, mirror, under_glass

CASES = {
    "diffuse": {},
    "plastic": {"floor": {"type": "plastic"}},
    "rough metal": {"floor": {"type": "roughconductor", "alpha": 0.3}},
    "thin glass": {"plate": {"type": "thindielectric"}},
    "bumpy glass": {"plate": bumpy},
    "bumpy floor": {"floor": bumpy},
    "masked floor": {"floor": {"type": "mask", "opacity": 0.6, "bsdf": {"type": "diffuse"}}},
    "mirror": {"mirror": mirror},
    "lens": {"kind": "thinlens"},
}


def scene_of(case):
    more = {
        name: value(glass() if name == "plate" else matte()) if value is bumpy else value
        for name, value in CASES[case].items()
    }
    if "mirror" in more:
        more["mirror"] = mirror()
    return mi.load_dict(under_glass(ball(), **more))


@pytest.mark.parametrize("parameters", [{}, {"skip": "none"}], ids=["default", "all"])
@pytest.mark.parametrize("case", CASES)
def test_large_lamps_look_as_without(case, parameters):
    """Rationale: of a large lamp s = 0 finds everything. Expected: the same tiles, by Welch's test."""
    scene = scene_of(case)
    a = images(scene, 256, 8, photon_guiding="always", **parameters)
    b = images(scene, 256, 8, first=100, photon_guiding="never", **parameters)
    st.assert_agree(st.compare_images(st.tiles(a), st.tiles(b)), at_least=16)
