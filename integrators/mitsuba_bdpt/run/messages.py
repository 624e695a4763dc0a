"""Log messages of a render: statistics, and warnings about scene parameters."""

from __future__ import annotations

import json
import math

import mitsuba as mi

from ..errors import listed
from ..host.notices import warn_once
from ..planning.possible import unsampled_at_sensor
from ..planning.unsampled_light import WARN_SHARE, Missing
from ..scene.diagnostics import NAMED, not_finite, spoilt
from ..sensors.checks import called


def log(statistics: dict):
    """Log the statistics of a render, and warn if its error is unknown."""
    mi.Log(mi.LogLevel.Info, f"bdpt: {json.dumps(statistics)}")
    if statistics.get("error") == math.inf:
        mi.Log(
            mi.LogLevel.Warn,
            "bdpt: the error is not known, since the render ended before four of its eight replicates were "
            "whole; ask for no more samples per pixel than timeout allows",
        )


def warn_of_scene(prepared, findings, settings):
    """Warn once about parameters that spoil images, and media that are ignored or contradictory."""
    found, _ = findings.find("flaws", settings, lambda: spoilt(prepared, settings))
    texts, media = list(found), prepared.light_media
    if media is not None:
        texts += [p.strange for p in prepared.space.media.properties]
        if media.contradiction:
            texts.append(
                f"{media.contradiction}; light subpaths would see another scene than the camera, so there "
                "are none: the image is that of `volpath`"
            )
        if media.hides_infinity and prepared.emitters.at_infinity:
            texts.append(
                "the medium that the sensor declares has no end, and no light from infinity (sky, sun) "
                "arrives through it; put a shape with a null BSDF around it"
            )
    for text in filter(None, texts):
        warn_once(prepared.scene, prepared.sensor, f"bdpt: {text}")


def warn_of_unsampled_light(prepared, plan, missing: Missing | None):
    """Warn once per scene and ``plan`` of unsampled light, unless it is little."""
    if missing and missing.share >= WARN_SHARE:
        text = f"bdpt: {missing.cause}; {missing.remedy}"
        warn_once(prepared.scene, prepared.camera.sensor, text, ("unsampled light", plan.splat, plan.direct))


def warn_of_missing_direct(prepared, plan, settings):
    """Warn once of light on a meter that no strategy samples; cameras lack the lamp's image alone."""
    if isinstance(prepared.camera.sensor, mi.ProjectiveCamera):
        return
    for paths in unsampled_at_sensor(prepared, plan, settings):
        text = (
            f"bdpt: not sampled: {paths}: light on {called(prepared.camera.sensor)} itself is missing; leave "
            "light_paths at auto, render views of a batch one by one, or use an area light"
        )
        warn_once(prepared.scene, prepared.camera.sensor, text)


def warn_of_non_finite(statistics: dict, scene):
    """Warn of non-finite values in a render, and name scene parameters that hold some."""
    lost, in_pilot = statistics["non_finite"], statistics["non_finite_in_pilot"]
    if not (lost or in_pilot):
        return
    counts = {"of the image": lost, "of the pilot, which decided from the rest": in_pilot}
    some = " and ".join(f"{count} {where}" for where, count in counts.items() if count)
    held = "no parameter of the scene holds NaN or infinity: look into its plugins, your own first"
    if names := not_finite(scene):
        held = f"NaN or infinity is in {listed(names, NAMED)}"
    mi.Log(mi.LogLevel.Warn, f"bdpt: invalid samples (NaN or infinite) count as zero: {some}; {held}")
