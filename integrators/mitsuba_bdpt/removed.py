"""What the plugin and its command had in earlier versions, and what to use instead.

The errors of the parameters' reader and of the command line are made from this table.
"""

from __future__ import annotations

# By name: a parameter, "parameter=value", a command, an option, "--option value".
REMOVED = {
    "heuristic=maximum": "use balance, whose variance is lower (E. Veach's thesis, section 9.2)",
    "heuristic=uniform": "use balance; for unweighted estimates of all strategies set layers=strategies",
    "merging_radius": "leave it out: the radius is about a pixel and shrinks from pass to pass; for a "
    "smaller one render more samples, or a larger film",
    "stored_vertices": "leave it out; for path tracing alone set light_paths=0",
    "decisions": "set light_paths and connections; checkpoints and clusters hand over what was decided",
    "points=sampler": "use sobol, which is as good as Mitsuba's best sampler; the scene's sampler gives the "
    "number of samples alone",
    "photon_guiding": "use guiding: always (which leaves emission to the pilot), never, or emission to guide "
    "emission alone",
    "emission_guiding": "use guiding: never, or photons to guide BSDF sampling alone",
    "strategy_images": "use layers=strategies",
    "variance": "use layers=variance",
    "denoise": "use layers=denoised",
    "stokes": "use layers=stokes",
    "until_error": "use target_error",
    "--until-error": "use --target-error",
    "--keep-checkpoint": "a finished render cannot be continued; for more samples render with another --seed "
    "and combine both (mitsuba_bdpt.Snapshot.joined)",
    "--progress deadline": "use --progress lines, whose lines on standard error have the percentage",
    "--tev": "use --preview SECONDS, which rewrites the PNG, and a viewer that watches files",
    "fireflies": "render with layers=strategies, whose images show the strategies that they are of",
    "completion": "generate completions from --help with a tool such as shtab or your shell's own",
}


def remedy(name: str) -> str:
    """What to use instead of ``name``, a key of `REMOVED`; empty if it never existed."""
    return f"was removed; {REMOVED[name]}" if name in REMOVED else ""
