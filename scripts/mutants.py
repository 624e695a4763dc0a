"""Plants bugs in a copy of the package, one at a time, and checks that the tests see them.

    python scripts/mutants.py                  # all, an hour
    python scripts/mutants.py hidden adjoint   # those with such a word in their name
    python scripts/mutants.py --list           # what is replaced by what
    python scripts/mutants.py --unchanged      # the same tests on a copy without bugs: they have to pass

Each test that is named beside a mutant runs against the copy, in a process of its own, and has to fail by an
assertion: one that fails by anything else shows that the bug is not the one that was meant. The exit status
is 1 if a test did not do what it should, and 2 if the text to replace is not in the module once (the code has
changed: plant the bug anew).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import command_line
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.errors import CommandError

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "integrators" / "mitsuba_bdpt"
ASSERTION = re.compile(r"^E +(assert |AssertionError|Failed: DID NOT)", re.MULTILINE)
PASSED, FAILED = 0, 1  # exit statuses of pytest


@dataclass(frozen=True)
class Mutant:
    """A planted bug.

    ``old`` stands exactly once in the module ``file``; with ``new`` in its place each of ``tests`` (names
    that pytest takes) must fail.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTANTS = (
    Mutant(
        "path layers: a merge forgets the events of the photon's subpath",
        "merging/merging.py",
        "path_layers.joined(of_camera, y.layer)",
        "of_camera",
        ("tests/transport/test_oracle.py::test_strategies_agree_on_path_layers[merging]",),
    ),
    Mutant(
        "path layers: near-specular events of a connection are rough",
        "transport/path_layers.py",
        "else _after(layer, is_narrow(f), adjoint)",
        "else _after(layer, mi.Bool(False), adjoint)",
        ("tests/transport/test_oracle.py::test_strategies_agree_on_path_layers[alone]",),
    ),
    Mutant(
        "path layers: a polished object decides about all others",
        "transport/inputs.py",
        "replace(self.traits, reverse=True)",
        "replace(self.traits, reverse=self.near_specular)",
        ("tests/images/test_path_layers.py::test_other_objects_do_not_change_layers",),
    ),
    Mutant(
        "path layers: a splat by a specular event first has no layer",
        "transport/techniques.py",
        "path_layers.joined(path_layers.EMISSION, of_light)",
        "of_light",
        ("tests/transport/test_oracle.py::test_strategies_agree_on_path_layers[alone]",),
    ),
    Mutant(
        "path layers: lanes share the layer of the first",
        "transport/walk.py",
        "dr.full(mi.UInt32, path_layers.EMISSION, dr.width(pi))",
        "mi.UInt32(path_layers.EMISSION)",
        ("tests/images/test_path_layers.py::test_layers_are_those_of_paths_by_bsdf_sampling[glass]",),
    ),
    Mutant(
        "path layers: null events are rough",
        "transport/path_layers.py",
        "dr.select(step.null, layer, ",
        "dr.select(mi.Bool(False), layer, ",
        ("tests/images/test_path_layers.py::test_layers_are_those_of_paths_by_bsdf_sampling[null]",),
    ),
    Mutant(
        "path layers: guided light is that of its vertex's subpath",
        "transport/photons/guided_hits.py",
        "layer=path_layers.evaluated(z.layer, f, adjoint=False)",
        "layer=z.layer",
        ("tests/images/test_path_layers.py::test_layers_are_those_of_paths_by_bsdf_sampling[guiding]",),
    ),
    Mutant(
        "path layers: the splats of both partitions are the image's",
        "image/accumulator.py",
        "zip(*each[: c.splats_of_image], strict=True)",
        "zip(*each, strict=True)",
        ("tests/images/test_path_layers.py::test_layers_change_nothing_else[all]",),
    ),
    Mutant(
        "light groups: a merge's group is that of the camera's side",
        "merging/merging.py",
        "kernel.light_group(y.emitter,",
        "kernel.light_group(mi.UInt32(0),",
        ("tests/images/test_light_groups.py::test_a_merge_knows_its_emitter[dielectric]",),
    ),
    Mutant(
        "light groups: connections are of the newest light subpath",
        "transport/light_path.py",
        'e.get("light_group", path.light_group)',
        "path.light_group",
        ("tests/images/test_light_groups.py::test_connections_to_several_light_subpaths_know_their_emitter",),
    ),
    Mutant(
        "light groups: a mix takes the first weight for all colours",
        "files/mixing.py",
        "factor * layers[layer]",
        "factor[0] * layers[layer]",
        ("tests/cli/test_mix.py::test_the_command_scales_the_layers[False]",),
    ),
    Mutant(
        "light groups: a made name wins over an id",
        "emitters/light_groups.py",
        "own = [i for i, ids in enumerate(real) if pattern in ids]",
        "own = [i for i, ids in enumerate(known) if pattern in map(layer_name, ids)]",
        ("tests/images/test_light_groups.py::test_an_id_wins_over_a_made_name",),
    ),
    Mutant(
        "light groups: names of layers go to ids that become them",
        "emitters/light_groups.py",
        "if ids[i] and _layer_name(ids[i][0]) == ids[i][0] != REST:",
        "if ids[i] and _layer_name(ids[i][0]) != REST:",
        ("tests/images/test_light_groups.py::test_an_id_wins_over_a_made_name",),
    ),
    Mutant(
        "light groups: emitters are in Mitsuba's order",
        "emitters/light_groups.py",
        "emitters = in_order(scene)",
        "emitters = scene.emitters()",
        ("tests/emitters/test_order.py::test_light_groups_are_those_of_the_tables",),
    ),
    Mutant(
        "frames: two share a seed",
        "cli/render.py",
        "(options.seed + number) % 2**32",
        "(options.seed + number // 2) % 2**32",
        ("tests/cli/test_farm.py::test_frames_have_seeds_of_their_own",),
    ),
    Mutant(
        "light groups: splats have none",
        "image/accumulator.py",
        "[layer * self._down for layer in self.indices(c.layers)]",
        "[layer * 0 for layer in self.indices(c.layers)]",
        ("tests/images/test_light_groups.py::test_a_layer_is_the_image_of_its_emitters_alone[one]",),
    ),
    Mutant(
        "light groups: inner connections have none",
        "image/sink.py",
        "c.layers), c.counted",
        "[layer & 0 for layer in c.layers]), c.counted",
        ("tests/images/test_light_groups.py::test_a_layer_is_the_image_of_its_emitters_alone[one]",),
    ),
    Mutant(
        "features: normals of maps are flipped without being asked",
        "image/mapped_normals.py",
        "        if self._flips:",
        "        if True:",
        ("tests/image/test_aovs.py::test_features_are_those_of_aov[plain]",),
    ),
    Mutant(
        "features: the normals of a bump map are the surface's",
        "image/mapped_normals.py",
        "here = active & (bsdf == mi.BSDFPtr(one.bsdf))",
        "here = mi.Bool(False)",
        ("tests/image/test_aovs.py::test_features_are_those_of_aov[plain]",),
    ),
    Mutant(
        "near-specular lobes: a nested BSDF has none",
        "transport/near_specular.py",
        "if id(inner) in own",
        "if False",
        ("tests/transport/test_near_specular.py::test_sharp_lobes_are_near_specular[twosided]",),
    ),
    Mutant(
        "near-specular lobes: the mean of a texture",
        "transport/near_specular.py",
        "dr.min(values) if sign > 0",
        "dr.mean(values) if sign > 0",
        ("tests/transport/test_near_specular.py::test_sharp_lobes_are_near_specular[textured metal]",),
    ),
    Mutant(
        "near-specular lobes: refraction is as broad as reflection",
        "transport/near_specular.py",
        "return _microfacets(alpha) * (max(eta, 1.0)",
        "return _microfacets(alpha) / 4  # (max(eta, 1.0)",
        ("tests/transport/test_near_specular.py::test_sharp_lobes_are_near_specular[frosted glass]",),
    ),
    Mutant(
        "undersampled light: the connection of the photon's edge is left out",
        "merging/undersampled.py",
        "area = photon.connection + photon.older",
        "area = photon.older",
        ("tests/planning/test_undersampled.py::test_light_that_next_event_estimation_finds_is_not_missing",),
    ),
    Mutant(
        "undersampled light: the connection of the camera's edge is left out",
        "merging/undersampled.py",
        "camera = h.combine(newest, h.scale(",
        "camera = h.combine(0, h.scale(",
        ("tests/planning/test_undersampled.py::test_light_that_light_tracing_finds_is_not_missing",),
    ),
    Mutant(
        "undersampled light: merged at every vertex",
        "merging/undersampled.py",
        "active = found.active & ~is_narrow(found.f)",
        "active = found.active",
        ("tests/planning/test_undersampled.py::test_a_path_is_merged_once",),
    ),
    Mutant(
        "undersampled light: lamps behind smooth glass do not count",
        "planning/unsampled_light.py",
        "sharp = prepared.narrowest >= NARROW or",
        "sharp = prepared.narrowest >= NARROW and",
        ("tests/planning/test_undersampled.py::test_small_lamps_behind_smooth_glass",),
    ),
    Mutant(
        "guiding: samples of s = 0 are predicted without their number",
        "merging/undersampled.py",
        "light * self.samples / expected",
        "light / expected",
        ("tests/images/test_guided_hits.py::test_the_variance_without_guiding_is_predicted",),
    ),
    Mutant(
        "undersampled light: hits of the lamp do not count",
        "merging/undersampled.py",
        "area = photon.connection + photon.older * f.pdf_fwd_w",
        "area = photon.connection",
        ("tests/planning/test_undersampled.py::test_small_lamps_are_hit_too_rarely",),
    ),
    Mutant(
        "undersampled light: the density of aimed photons",
        "merging/undersampled.py",
        "(found.number * photon.aim / merging",
        "(found.number / merging",
        ("tests/planning/test_undersampled.py::test_the_aim_of_photons_changes_nothing",),
    ),
    Mutant(
        "undersampled light: of one sample per pixel",
        "merging/undersampled.py",
        "return self.samples * area",
        "return area",
        ("tests/planning/test_undersampled.py::test_more_samples_find_it",),
    ),
    Mutant(
        "unsampled light: lamps that rays hit lack light",
        "merging/unsampled.py",
        "active=walk.active & e.delta)",
        "active=walk.active)",
        ("tests/planning/test_unsampled_light.py::test_only_lamps_that_no_ray_hits_lack_light",),
    ),
    Mutant(
        "unsampled light: photons have no emitter",
        "transport/photons/photon_pass.py",
        "emitter=e.index,",
        "emitter=mi.UInt32(0),",
        ("tests/planning/test_unsampled_light.py::test_lamps_of_several_colours_are_lost_together",),
    ),
    Mutant(
        "emitters: the pointer of a single one is part of the kernel",
        "emitters/emitters.py",
        "self._inverse, self._pointers)",
        "self._inverse)",
        ("tests/test_properties.py::test_no_recompilation[spp = 20_000]",),
    ),
    Mutant(
        "emitters: lamps on meshes are in Mitsuba's order",
        "emitters/order.py",
        "sorted(slots, key=key)",
        "slots",
        ("tests/emitters/test_order.py::test_a_seed_has_one_image_in_every_load",),
    ),
    Mutant(
        "unsampled light: said after the last pass",
        "run/rendering.py",
        "messages.warn_of_unsampled_light(self.prepared, self.plan, self.missing())",
        "pass",
        ("tests/planning/test_unsampled_light.py::test_it_is_said_before_the_samples_are_traced[pilot]",),
    ),
    Mutant(
        "sensors: views of a batch are not checked",
        "sensors/checks.py",
        "            check_sensor(view, of_scene)",
        "            pass",
        ("tests/sensors/test_checks.py::test_what_a_sensor_lacks_is_said[batch of a distant]",),
    ),
    Mutant(
        "Mitsuba 3.10: the first key frame stands for all",
        "host/renamed.py",
        "if value.is_animated():",
        "if False:",
        ("tests/host/test_renamed.py::test_what_is_animated_is_refused",),
    ),
    Mutant(
        "small arrays are not kept",
        "host/notices.py",
        "kept.append(dr.copy(value))",
        "pass",
        ("tests/host/test_edits.py::test_two_edits_in_between_are_seen",),
    ),
    Mutant(
        "scenes that are gone are remembered",
        "host/notices.py",
        "        del _scenes[number]  # its scene is gone",
        "        pass",
        ("tests/host/test_edits.py::test_scenes_that_are_gone_are_forgotten",),
    ),
    Mutant(
        "contents of large arrays do not count",
        "host/notices.py",
        "zlib.crc32(data.view(np.uint8))",
        "0",
        (
            "tests/host/test_edits.py::test_two_edits_in_between_are_seen",
            "tests/host/test_edits.py::test_each_entry_counts",
        ),
    ),
    Mutant(
        "pilots of an edited scene",
        "planning/findings.py",
        "        key = self._state, key\n",
        "",
        ("tests/host/test_edits.py::test_edits_are_seen",),
    ),
    Mutant(
        "edits during a render are not seen",
        "run/rendering.py",
        "                    self.findings.expire()\n",
        "",
        ("tests/host/test_edits.py::test_edits_during_a_render_are_seen",),
    ),
    Mutant(
        "splats on hidden emitters",
        "transport/techniques.py",
        "        active &= ~on_emitter\n",
        "        pass\n",
        ("tests/images/test_plausible_bugs.py::test_light_on_a_hidden_lamp_is_not_splatted",),
    ),
    Mutant(
        "what is in front of a lens",
        "sensors/cameras.py",
        "active=towards & on_lens & unhidden & within & inside",
        "active=towards & on_lens & within & inside",
        ("tests/images/test_plausible_bugs.py::test_what_is_in_front_of_a_lens_hides_the_light_from_it",),
    ),
    Mutant(
        "count of light subpaths",
        "transport/kernel.py",
        "kernel.bound(points, count_light, observer)",
        "kernel.bound(points, 1 / kernel.plan.camera_paths_per_light_path, observer)",
        ("tests/images/test_plausible_bugs.py::test_splats_of_few_pixels_count_once[3-1]",),
    ),
    Mutant(
        "one seed for both subpaths",
        "sampling/points.py",
        'mi.UInt32(1 if side == "light" else 2)',
        "mi.UInt32(1)",
        (
            "tests/images/test_plausible_bugs.py::test_no_number_decides_two_things[sobol]",
            "tests/images/test_plausible_bugs.py::test_no_number_decides_two_things[independent]",
        ),
    ),
    Mutant(
        "two purposes of one dimension",
        "sampling/points.py",
        "    ROULETTE = 9\n",
        "    ROULETTE = 6\n",
        (
            "tests/images/test_plausible_bugs.py::test_no_number_decides_two_things[sobol]",
            "tests/images/test_known_answers.py::test_lobes_and_roulette_are_independent[camera]",
            "tests/images/test_known_answers.py::test_lobes_and_roulette_are_independent[light]",
        ),
    ),
    Mutant(
        "roulette by the number of the lobe",
        "transport/walk.py",
        "Purpose.ROULETTE",
        "Purpose.LOBE",
        (
            "tests/images/test_plausible_bugs.py::test_each_purpose_is_drawn_for_at_one_place",
            "tests/images/test_known_answers.py::test_lobes_and_roulette_are_independent[camera]",
            "tests/images/test_known_answers.py::test_lobes_and_roulette_are_independent[light]",
        ),
    ),
    Mutant(
        "numbers of the light subpath for the camera's",
        "transport/subpaths.py",
        'points.stream("camera", place.index(slot))',
        'points.stream("light", place.index(slot))',
        ("tests/images/test_plausible_bugs.py::test_subpaths_draw_from_their_own_streams",),
    ),
    Mutant(
        "what is between a lens and its near plane",
        "sensors/cameras.py",
        "(walk.pi.t >= (o.z - view.near) / slope)",
        "(walk.pi.t >= o.z / slope)",
        ("tests/images/test_known_answers.py::test_a_near_plane_hides_what_stands_before_it_from_light",),
    ),
    Mutant(
        "camera rays past hidden lamps keep their start",  # as in `path`
        "transport/subpaths.py",
        "        pi, ray = rays.intersect_past_emitters(",
        "        pi, _ = rays.intersect_past_emitters(",
        ("tests/images/test_plausible_bugs.py::test_a_ball_is_seen_as_it_is_through_a_hidden_lamp",),
    ),
    Mutant(
        "weights: the newest alternative is forgotten",
        "transport/mis.py",
        "older = alternatives(h, partial, coefficient, step.pdf_rev_w)",
        "older = alternatives(h, partial, 0, step.pdf_rev_w)",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[odd-balance]",),
    ),
    Mutant(
        "weights: no squared distance in the area measure",
        "transport/mis.py",
        "h.scale(partial.d_vcm, dist2 / (cos if tr is None else cos * tr))",
        "h.scale(partial.d_vcm, dr.rcp(cos))",
        ("tests/transport/test_oracle.py::test_kernel_agrees_with_explicit_densities[pinhole-balance-odd]",),
    ),
    Mutant(
        "weights: delta events keep a density",
        "transport/mis.py",
        "dr.select(step.delta, 0.0, h.start(dr.rcp(step.pdf_fwd_w)))",
        "h.start(dr.rcp(step.pdf_fwd_w))",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[odd-balance]",),
    ),
    Mutant(
        "weights: power with exponent 1",
        "transport/mis.py",
        '(dr.square(ratio) if self.name == "power" else ratio)',
        "ratio",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[n1c1-power]",),
    ),
    Mutant(
        "densities: forward and reverse swapped on light subpaths",
        "transport/bsdf.py",
        "        return value, pdf_fwd_w, pdf_rev_w\n\n",
        "        return value, pdf_rev_w, pdf_fwd_w\n\n",
        ("tests/transport/test_oracle.py::test_kernel_agrees_with_explicit_densities[pinhole-balance-n1c1]",),
    ),
    Mutant(
        "densities: camera rays without the cubed cosine",
        "sensors/cameras.py",
        "return dr.rcp(self.area * cos * cos * cos)",
        "return dr.rcp(self.area * cos * cos)",
        ("tests/sensors/test_sensor_densities.py::test_importance_integrates_to_the_weight[plain]",),
    ),
    Mutant(
        "adjoint: no ratio of geometric cosines in the walk",
        "transport/bsdf.py",
        "dr.select(is_zero(weight), 0, weight * cos_ratio)",
        "dr.select(is_zero(weight), 0, weight)",
        ("tests/images/test_known_failures.py::test_no_spikes_inside_a_bumpy_sphere",),
    ),
    Mutant(
        "adjoint: no ratio of geometric cosines at joins",
        "transport/bsdf.py",
        "value if cos_ratio is None else value * cos_ratio",
        "value",
        ("tests/images/test_known_failures.py::test_shading_normals_of_a_coarse_mesh",),
    ),
    Mutant(
        "adjoint: eta squared stays in what light carries through glass",
        "transport/bsdf.py",
        "weight * eta2 if drawn.back is None else drawn.back / eta2",
        "weight if drawn.back is None else drawn.back",
        ("tests/images/test_known_answers.py::test_a_lamp_in_glass_reaches_the_meter_around_it",),
    ),
    Mutant(
        "film: splats a pixel off",
        "image/accumulator.py",
        "self.light.splat(c.position, [*colours, *polarized], active, u, row)",
        "self.light.splat(c.position + 1, [*colours, *polarized], active, u, row)",
        ("tests/images/test_known_failures.py::test_borders_of_a_uniform_furnace",),
    ),
    Mutant(
        "throughput: light roulette is not divided by",
        "transport/walk.py",
        "return dr.select(playing, throughput / survive, throughput), ",
        "return dr.select(playing & (not side.adjoint), throughput / survive, throughput), ",
        (
            "tests/images/test_known_answers.py::test_all_bounces_in_the_unit_sphere_add_up_to_one[skip=none-point]",
        ),
    ),
    Mutant(
        "connections: no cosine at the light vertex",
        "transport/connections.py",
        "f_z.pdf_fwd_w * cos_y * inverse\n",
        "f_z.pdf_fwd_w * inverse\n",
        ("tests/transport/test_oracle.py::test_kernel_agrees_with_explicit_densities[pinhole-balance-n1c1]",),
    ),
    Mutant(
        "roulette: splats are not divided by",
        "transport/techniques.py",
        "replace(c, value=value / survival, active=active",
        "replace(c, value=value, active=active",
        ("tests/images/test_plausible_bugs.py::test_what_plays_roulette_is_made_up_for",),
    ),
    Mutant(
        "roulette: drawn connections are not divided by",
        "transport/connections.py",
        "value / survival",
        "value",
        ("tests/images/test_plausible_bugs.py::test_what_plays_roulette_is_made_up_for",),
    ),
    Mutant(
        "emission: start of a light subpath lacks its density",
        "transport/subpaths.py",
        "partial = mis.Partial(h.start(inverse_pdf), h.present(hit))",
        "partial = mis.Partial(h.start(dr.rcp(e.pdf_second)), h.present(hit))",
        ("tests/transport/test_oracle.py::test_kernel_agrees_with_explicit_densities[pinhole-balance-n1c1]",),
    ),
    Mutant(
        "points: the second coordinate lacks a step",
        "sampling/sobol.py",
        "return digits ^ ((digits >> 1) & 0x55555555)",
        "return digits",
        ("tests/sampling/test_sobol.py::test_unscrambled_equals_scipy",),
    ),
    Mutant(
        "points: both coordinates from one digit word",
        "sampling/sobol.py",
        "_unit(_scramble(_second(digits), seed_y))",
        "_unit(_scramble(digits, seed_y))",
        ("tests/sampling/test_sobol.py::test_aligned_blocks_are_nets[2-0]",),
    ),
    Mutant(
        "points: long sequences begin again",
        "sampling/sobol.py",
        "mi.UInt32(seed) ^ mix(high)",
        "mi.UInt32(seed)",
        ("tests/sampling/test_sobol.py::test_split_index",),
    ),
    Mutant(
        "points: the light sample goes with the wrong direction",
        "sampling/points.py",
        "later = 1 if purpose is Purpose.EMITTER else 0",
        "later = 0",
        ("tests/sampling/test_points.py::test_draws_of_one_contribution_are_joint[camera-first4-second4]",),
    ),
    Mutant(
        "points: pairs share their seed with single numbers",
        "sampling/points.py",
        "return mi.Point2f(_to_unit(word), _to_unit(sobol.mix(word ^ _SECOND)))",
        "return mi.Point2f(_to_unit(word), _to_unit(word))",
        (
            "tests/images/test_known_answers.py::test_all_bounces_in_the_unit_sphere_add_up_to_one[points=independent-point]",
        ),
    ),
    Mutant(
        "reservoir: what is left of the random number is not uniform",
        "sampling/reservoir.py",
        "rest = dr.select(take, u_total, u_total - size)",
        "rest = u_total",
        ("tests/sampling/test_reservoir.py::test_candidates_are_drawn_in_proportion_to_their_size",),
    ),
    Mutant(
        "sharing: rows are not dealt",
        "transport/batch.py",
        "turned = _turned(row, self._rows, sobol.mix(column ^ keys[0]))",
        "turned = row",
        ("tests/transport/test_sharing.py::test_every_sample_has_one_lane[2]",),
    ),
    Mutant(
        "sensors: a lens looks past its plane in focus",
        "sensors/cameras.py",
        "x, y = x + lens.x / view.focus, y + lens.y / view.focus",
        "x, y = x - lens.x / view.focus, y - lens.y / view.focus",
        ("tests/sensors/test_sensor_densities.py::test_a_join_is_the_ray_back[thinlens]",),
    ),
    Mutant(
        "sensors: t = 0 lacks the cosine at the lens",
        "sensors/cameras.py",
        "else cos * view.lens_area() / dist2",
        "else view.lens_area() / dist2",
        ("tests/sensors/test_sensor_densities.py::test_an_arrival_is_a_start_in_reverse[thinlens]",),
    ),
    Mutant(
        "sensors: a lens is hit off its optical axis",
        "sensors/cameras.py",
        "        distance = o.z / slope\n",
        "        distance = o.z\n",
        ("tests/sensors/test_sensor_densities.py::test_an_arrival_is_a_start_in_reverse[thinlens]",),
    ),
    Mutant(
        "sensors: a border does not widen the film",
        "sensors/cameras.py",
        "area = 1 / abs(np.linalg.det(to_film)) * share",
        "area = 1 / abs(np.linalg.det(to_film))",
        ("tests/sensors/test_sensor_densities.py::test_importance_integrates_to_the_weight[sample_border]",),
    ),
    Mutant(
        "sensors: orthographic rays without an end",
        "sensors/others.py",
        "& (depth >= 0) & (depth <= self._reach)",
        "& (depth >= 0)",
        (
            "tests/sensors/test_sensor_densities.py::test_nothing_is_joined_beyond_the_far_plane[orthographic]",
        ),
    ),
    Mutant(
        "sensors: a meter is lit from behind",
        "sensors/others.py",
        "        cos = dr.dot(n, -d)\n",
        "        cos = dr.abs(dr.dot(n, -d))\n",
        (
            "tests/sensors/test_sensor_densities.py::test_importance_integrates_to_the_weight[irradiancemeter]",
        ),
    ),
    Mutant(
        "sensors: light hits a meter that is not in the scene",
        "sensors/others.py",
        "        if not in_scene:\n",
        "        if False:\n",
        ("tests/images/test_coverage.py::test_meter_of_another_scene",),
    ),
    Mutant(
        "film: sums of a pixel lie side by side",
        "image/accumulator.py",
        "self._strips, self._down = parts.strips, dr.opaque(mi.UInt32, self._stride)",
        "self._strips, self._down = parts.strips, dr.opaque(mi.UInt32, self._stride - 1)",
        ("tests/image/test_splat_filters.py::test_strips_of_camera_samples_are_apart",),
    ),
    Mutant(
        "film: the filter's taps begin a pixel early",
        "image/accumulator.py",
        "first, taps = mi.Point2i(dr.ceil(at - radius))",
        "first, taps = mi.Point2i(dr.floor(at - radius))",
        ("tests/image/test_splat_filters.py::test_the_mean_over_all_numbers_is_the_filter[gaussian]",),
    ),
    Mutant(
        "film: weights of the filter in one direction",
        "image/accumulator.py",
        "return pixel, self._rfilter.eval(distance.x) * self._rfilter.eval(distance.y)",
        "return pixel, self._rfilter.eval(distance.x)",
        ("tests/image/test_splat_filters.py::test_the_mean_over_all_numbers_is_the_filter[gaussian]",),
    ),
    Mutant(
        "film: the filter's radius is rounded down for splats",
        "image/taps.py",
        "ceil(rfilter.radius())",
        "int(rfilter.radius())",
        ("tests/image/test_splat_filters.py::test_weights_add_up_to_those_of_all_pixels[between]",),
    ),
    Mutant(
        "film: strips do not overlap by the filter",
        "image/accumulator.py",
        "2 * (self.rfilter.border_size() + border)",
        "2 * border",
        ("tests/image/test_splat_filters.py::test_strips_of_camera_samples_are_apart",),
    ),
    Mutant(
        "film: drawn pixels of splats without the sign of the filter",
        "image/taps.py",
        "dr.mulsign(dr.mulsign(below[-1] / draws, weight_x), weight_y)",
        "below[-1] / draws",
        ("tests/image/test_splat_filters.py::test_the_mean_over_all_numbers_is_the_filter[lanczos]",),
    ),
    Mutant(
        "film: the inner corner of splats is not among the pixels drawn",
        "image/taps.py",
        "[2 * outside + 1]",
        "[2 * outside]",
        ("tests/image/test_splat_filters.py::test_the_mean_over_all_numbers_is_the_filter[gaussian]",),
    ),
    Mutant(
        "film: all splats draw their pixels with the same numbers",
        "image/sink.py",
        "kernel.points.series(stream, Purpose.FILM, c.s, mi.UInt32(1))",
        "mi.UInt32(1)",
        ("tests/image/test_splat_filters.py::test_numbers_of_the_filter_are_uniform_and_independent",),
    ),
    Mutant(
        "film: images of strategies draw other pixels than the image",
        "image/sink.py",
        "self._put_strategy(c, c.position, shared, u)",
        "self._put_strategy(c, c.position, shared, mi.Point2f(u.y, u.x))",
        ("tests/image/test_splat_filters.py::test_images_of_strategies_add_up",),
    ),
    Mutant(
        "adjoint: refraction under a bump map",
        "transport/bsdf.py",
        "return dr.select(refracted, ratio, 1)",
        "return mi.Float(1)",
        ("tests/transport/test_bsdf.py::test_both_sides_carry_the_same[dielectric-0.0]",),
    ),
    Mutant(
        "weights: the power heuristic adds up",
        "transport/mis.py",
        "total = dr.hypot(a, b)",
        "total = a + b",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[n1c1-power]",),
    ),
    Mutant(
        "weights: no density from the other side",
        "transport/mis.py",
        "    return h.scale(total, pdf_a)\n",
        "    return total\n",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[n1c1-balance]",),
    ),
    Mutant(
        "weights: of the edge's cosine not",
        "transport/mis.py",
        "h.scale(older, step.cos_out / step.pdf_fwd_w)",
        "h.scale(older, dr.rcp(step.pdf_fwd_w))",
        ("tests/transport/test_oracle.py::test_recursion_agrees_with_explicit_densities[n1c1-balance]",),
    ),
    Mutant(
        "weights: no bound",
        "transport/mis.py",
        "return dr.minimum(x * dr.minimum(factor, SATURATION), SATURATION)",
        "return x * factor",
        ("tests/transport/test_oracle.py::test_recursion_extreme_densities[n1c1-balance]",),
    ),
    Mutant(
        "pilots: all connections are with one light subpath",
        "planning/moments.py",
        "found[:, [candidate]] -= (1 - several",
        "found[:, [candidate]] -= 0 * (1 - several",
        ("tests/planning/test_pilot.py::test_predicted_variance[cornell-four per lane]",),
    ),
    Mutant(
        "pilots: what is rare in one sample per pixel is hidden",
        "planning/moments.py",
        "fourth)[order]) * spp < TRIMMED",
        "fourth)[order]) < TRIMMED",
        ("tests/planning/test_pilot.py::test_rare_contributions_are_hidden",),
    ),
    Mutant(
        "pilots: a typical render lacks no light",
        "planning/moments.py",
        "whole - hidden + spp * np.mean(missed**2)",
        "whole - hidden",
        ("tests/planning/test_pilot.py::test_predicted_error_of_a_typical_render",),
    ),
    Mutant(
        "pilots: the mean error alone decides",
        "planning/choice.py",
        "float(left.prod()) ** 0.5",
        "float(left[0])",
        ("tests/planning/test_pilot.py::test_both_errors_count_alike",),
    ),
    Mutant(
        "pilot: points stratify the mean of direct illumination too",
        "planning/pilot.py",
        "                    estimate *= dr.sqrt(gain)\n",
        "                    pass\n",
        ("tests/planning/test_pilot.py::test_points_stratify_direct_illumination",),
    ),
    Mutant(
        "pilot: shared light subpaths cost nothing",
        "planning/configuration.py",
        '"light": self.light_paths, "inner"',
        '"light": 1.0, "inner"',
        ("tests/planning/test_pilot.py::test_small_caustics_get_their_light[point_cube]",),
    ),
    Mutant(
        "pilot: the squared mean stays in",
        "planning/pilot.py",
        "                    moment -= dr.square(estimate) / counts[c.kind]\n",
        "                    pass\n",
        ("tests/planning/test_pilot.py::test_predicted_variance[cornell-n0c0]",),
    ),
    Mutant(
        "pilot: connections are drawn as if fog let their light pass or not",
        "planning/pilot.py",
        'found.pop("drawn", seen)',
        '(found.pop("drawn", None), seen)[1]',
        ("tests/planning/test_pilot.py::test_predicted_variance[fog-n1c1, one]",),
    ),
    Mutant(
        "pilot: a variance below 0 is believed",
        "planning/choice.py",
        "np.maximum(moments.errors[:, :, CANDIDATES.index(way)], 0)",
        "moments.errors[:, :, CANDIDATES.index(way)]",
        ("tests/planning/test_pilot.py::test_no_group_has_less_than_no_variance",),
    ),
    Mutant(
        "pilot: rays of light subpaths by camera samples",
        "planning/pilot.py",
        "count / (lanes if name in of_light else size)",
        "count / size",
        ("tests/planning/test_pilot.py::test_rays_of_light_subpaths_are_counted_for_each",),
    ),
    Mutant(
        "pilot: paths that could be guided stay in where their gain is not predicted",
        "planning/pilot.py",
        "prepared.delta if guidable is None else",
        "False if guidable is None else",
        ("tests/images/test_guided_hits.py::test_paths_that_can_be_guided_are_in_no_sample_of_a_pilot",),
    ),
    Mutant(
        "pilot: one runs after each edit of a small render",
        "planning/budget.py",
        "LEAST_SAMPLES, CHEAP_SAMPLES = 1 << 16, 1 << 18,",
        "LEAST_SAMPLES, CHEAP_SAMPLES = 1 << 16, 1 << 14,",
        ("tests/run/test_first_image.py::test_an_edit_of_a_small_render_asks_no_pilot",),
    ),
    Mutant(
        "passes: a short render records its kernel twice",
        "run/rendering.py",
        ">= TWO_PASSES",
        ">= 0",
        ("tests/run/test_first_image.py::test_a_short_render_has_one_pass",),
    ),
    Mutant(
        "light subpaths: few without a decision, also where glass focuses light",
        "planning/budget.py",
        "return prepared.specular or bool(",
        "return bool(",
        ("tests/run/test_first_image.py::test_light_subpaths_without_a_decision",),
    ),
    Mutant(
        "light subpaths: few without a decision, also where rough glass focuses light",
        "planning/budget.py",
        "or bool(prepared.near_specular) or",
        "or",
        ("tests/run/test_first_image.py::test_light_subpaths_without_a_decision",),
    ),
    Mutant(
        "rounding: rays start on the surface",
        "geometry/rounding.py",
        "OFFSET_ULPS = 32\n",
        "OFFSET_ULPS = 1\n",
        ("tests/geometry/test_rays.py::test_no_ray_finds_its_own_start[sphere]",),
    ),
    Mutant(
        "rounding: balls block what is aimed at them",
        "geometry/rounding.py",
        "QUADRIC_ULPS = 8\n",
        "QUADRIC_ULPS = 0\n",
        ("tests/geometry/test_rays.py::test_far_ends_do_not_block[sphere-30.0]",),
    ),
    Mutant(
        "rounding: visibility rays end where what found their end would",
        "geometry/rays.py",
        "dr.maximum(b.offset, offset_at(dr.norm(b.p - a.p)))",
        "b.offset",
        (
            "tests/geometry/test_rays.py::test_what_was_found_from_near_by_is_seen_from_afar[rectangle-False]",
            "tests/geometry/test_rays.py::test_the_image_does_not_depend_on_where_the_origin_is[cube]",
            "tests/geometry/test_rays.py::test_lamps_at_the_origin_are_seen_from_afar_in_fog[rectangle]",
        ),
    ),
    Mutant(
        "rounding: so do those that ask what they meet",
        "geometry/rays.py",
        "    end = _before(a, b)\n    ray",
        "    end = b.towards(a.p - b.p)\n    ray",
        ("tests/geometry/test_rays.py::test_what_was_found_from_near_by_is_seen_from_afar[rectangle-True]",),
    ),
    Mutant(
        "media: T~ of one side of the weights",
        "transport/mis.py",
        "light_side, camera_side = self.scale(light_side, tr), self.scale(camera_side, tr)",
        "light_side = self.scale(light_side, tr)",
        ("tests/transport/test_media_oracle.py::test_recursion_with_transmittances[n1c1-balance]",),
    ),
    Mutant(
        "media: T~ in one class only",
        "media/space.py",
        "of_depth(crossing.depth)",
        'of_depth(crossing.depth) if c.kind == "inner" else None',
        (
            "tests/transport/test_media_oracle.py::test_kernel_in_fog_agrees_with_explicit_densities[point-balance]",
        ),
    ),
    Mutant(
        "media: no T~ on arrival",
        "transport/walk.py",
        "edge.weight_transmittance()",
        "mi.Float(1)",
        (
            "tests/transport/test_media_oracle.py::test_kernel_in_fog_agrees_with_explicit_densities[point-balance]",
        ),
    ),
    Mutant(
        "media: estimates of T in weights",
        "media/space.py",
        "of_depth(crossing.depth)",
        "dr.mean(crossing.transmittance)",
        ("tests/images/test_media.py::test_weighted_strategies_add_up_to_volpath[grid]",),
    ),
    Mutant(
        "media: sigma_t does not cancel",
        "media/flight.py",
        "albedo = sigma_s / dr.mean(sigma_t)",
        "albedo = sigma_s",
        (
            "tests/images/test_media_known_answers.py::test_slab_under_the_sun[gray-camera]",
            "tests/images/test_media_known_answers.py::test_white_furnace[gray-camera]",
        ),
    ),
    Mutant(
        "media: the near side's medium where a connection starts",
        "media/space.py",
        "self.media.beyond(z.si, shadow_ray.d, z.medium)",
        "self.media.beyond(z.si, -shadow_ray.d, z.medium)",
        ("tests/images/test_media_identities.py::test_joins_start_on_the_right_side_of_a_boundary",),
    ),
    Mutant(
        "media: the near side's medium beyond a null surface",
        "media/transmittance.py",
        "media.beyond(si, ray.d, medium)",
        "media.beyond(si, -ray.d, medium)",
        ("tests/images/test_media_known_answers.py::test_fog_between_a_lamp_and_a_matte_wall[gray-camera]",),
    ),
    Mutant(
        "media: null events are edges",
        "transport/walk.py",
        "edges=walk.edges + dr.select(passes, mi.UInt32(0), 1)",
        "edges=walk.edges + 1",
        ("tests/images/test_media.py::test_weighted_strategies_add_up_to_volpath[mask]",),
    ),
    Mutant(
        "polarized: matrices of light subpaths in the order of camera subpaths",
        "geometry/polarization.py",
        "return event * throughput if adjoint and mi.is_polarized else throughput * event",
        "return throughput * event",
        ("tests/images/test_polarized.py::test_strategies_agree_in_every_component",),
    ),
    Mutant(
        "polarized: evaluations in the frames of the way back",
        "transport/bsdf.py",
        "polarization.in_world(si, value, -wo, si.wi)",
        "polarization.in_world(si, value, -si.wi, wo)",
        (
            "tests/transport/test_bsdf_polarized.py::test_evaluations_are_of_light_from_either_side[roughconductor]",
        ),
    ),
    Mutant(
        "polarized: matrices of delta events are those of the way back",
        "transport/bsdf.py",
        "traits.round_trip or (adjoint and bool(mi.is_polarized))",
        "traits.round_trip",
        (
            "tests/transport/test_bsdf_polarized.py::test_delta_events_are_of_light_from_either_side[retarder]",
        ),
    ),
    Mutant(
        "polarized: merged photons are not",
        "merging/merging.py",
        "value = z.throughput * f.value * estimate",
        "value = z.throughput * f.value * mi.Spectrum(mi.unpolarized_spectrum(estimate))",
        ("tests/images/test_polarized.py::test_isolated_paths_are_polarized",),
    ),
    Mutant(
        "polarized: splats arrive from where they go",
        "transport/techniques.py",
        "sides=sides, towards=connection.d)",
        "sides=sides, towards=-connection.d)",
        ("tests/images/test_polarized.py::test_strategies_agree_in_every_component",),
    ),
    Mutant(
        "polarized: Stokes vectors of an upright sensor",
        "image/colour.py",
        "world_transform(sensor) @ mi.Vector3f(0, 1, 0)",
        "mi.Vector3f(0, 1, 0)",
        ("tests/images/test_polarized.py::test_stokes_vectors_are_mitsubas[rough metal and plastic]",),
    ),
    Mutant(
        "media: one channel's density",
        "media/flight.py",
        "mean = dr.mean(densities)",
        "mean = sum(dr.select(self.channel == i, x, 0) for i, x in enumerate(densities))",
        ("tests/images/test_media_identities.py::test_flights_by_all_channels",),
    ),
    Mutant(
        "media: thinned vertices stand for themselves only",
        "transport/light_path.py",
        "throughput, keep = throughput / probability, keep & kept",
        "keep &= kept",
        ("tests/images/test_media.py::test_thinned_light_subpaths",),
    ),
    Mutant(
        "media: the last volume vertex is not joined",
        "media/phase.py",
        "queried = active | evaluated",
        "queried = active",
        ("tests/images/test_media.py::test_weighted_strategies_add_up_to_volpath[nested]",),
    ),
    Mutant(
        "media: Mitsuba's frames for microflakes",
        "media/media.py",
        "mei.sh_frame = p, -d, symmetric_frame(-d)",
        "mei.sh_frame = p, -d, mi.Frame3f(-d)",
        ("tests/images/test_media.py::test_our_frames_make_microflakes_sample_their_density",),
    ),
    Mutant(
        "media: joins grow beyond their ends",
        "media/transmittance.py",
        "left - onwards",
        "left - length",
        ("tests/images/test_media_identities.py::test_a_null_shell_without_medium_is_nothing",),
    ),
    Mutant(
        "media: lamps start outside",
        "media/light_media.py",
        "dr.select(found, near, unless_found)",
        "unless_found",
        ("tests/images/test_media.py::test_unweighted_strategies_agree[lamp in milk]",),
    ),
    Mutant(
        "media: null collisions are alike in all channels",
        "media/tracking.py",
        "polarization.scaled(throughput, (majorant - sigma_t) / null)",
        "throughput",
        ("tests/images/test_media_identities.py::test_null_collisions_by_channel",),
    ),
    Mutant(
        "media: grids have no end",
        "media/tracking.py",
        "inside = active & meets & (low < high)",
        "low, high, inside = low * 0, mi.Float(end), active",
        ("tests/images/test_media_identities.py::test_nothing_is_lost_outside_of_a_dense_grid",),
    ),
    Mutant(
        "media: lamps are in no medium",
        "media/light_media.py",
        "if len(numbers) else space.media.sensor",
        "if len(numbers) else 0",
        ("tests/images/test_media_identities.py::test_spots_in_fog[spot]",),
    ),
    Mutant(
        "media: t = 0 has the colour of its start",
        "media/transmittance.py",
        "edge.without_collision(walk.throughput, depth)",
        "walk.throughput",
        ("tests/images/test_media_known_answers.py::test_meter_in_fog[chromatic, absorbing-all]",),
    ),
    Mutant(
        "media: light from infinity arrives before its flight ends",
        "media/transmittance.py",
        "return (length > 0) & before_end,",
        "return length > 0,",
        (
            "tests/images/test_media_edges.py::test_light_from_infinity_hits_a_lens[null-sky]",
            "tests/images/test_media_edges.py::test_light_from_infinity_hits_a_lens[mask-sun]",
        ),
    ),
    Mutant(
        "media: the back of a shell is sampled from outside",
        "emitters/area.py",
        "~inside & beyond, 0, pdf_w)",
        "~inside & beyond, pdf_w, pdf_w)",
        ("tests/images/test_media_edges.py::test_a_glowing_shell_seen_from_outside",),
    ),
    Mutant(
        "media: grids without boundary go unnoticed",
        "media/light_media.py",
        'if emitters.at_infinity else ""',
        'if False else ""',
        ("tests/images/test_media_edges.py::test_a_grid_without_boundary[sky]",),
    ),
    Mutant(
        "media: the sky is seen through fog up to the far plane",
        "media/flight.py",
        "    if space.clipped:\n",
        "    if False:\n",
        ("tests/images/test_media_edges.py::test_the_far_plane_in_fog[False-sky]",),
    ),
    Mutant(
        "media: light from infinity comes through what lies behind the far plane",
        "planning/possible.py",
        "emitters.at_infinity and _reaches_behind(prepared, camera.sensor)",
        "False",
        ("tests/images/test_media_edges.py::test_fog_behind_the_far_plane[sun]",),
    ),
    Mutant(
        "media: hidden lamps block splats",
        "transport/techniques.py",
        "hidden=kernel.plan.hide_emitters)",
        "hidden=False)",
        (
            "tests/images/test_media_plausible_bugs.py::test_light_behind_a_hidden_lamp_in_fog[null]",
            "tests/images/test_media_plausible_bugs.py::test_light_behind_a_hidden_lamp_in_fog[mask]",
        ),
    ),
    Mutant(
        "media: lamps are hidden at the first event only",
        "media/flight.py",
        "hidden = walk.edges == 1",
        "hidden = walk.event == 1",
        ("tests/images/test_media_plausible_bugs.py::test_a_hidden_lamp_in_fog_is_passed[mask]",),
    ),
    Mutant(
        "media: hidden lamps are not passed",
        "media/flight.py",
        "hidden = walk.edges == 1",
        "hidden = None",
        ("tests/images/test_media_plausible_bugs.py::test_a_hidden_lamp_in_fog_is_passed[null]",),
    ),
    Mutant(
        "media: front and back of a lamp are exchanged",
        "media/light_media.py",
        "outwards = dr.dot(e.anchor.n, e.d) >= 0",
        "outwards = dr.dot(e.anchor.n, e.d) < 0",
        (
            "tests/images/test_media_plausible_bugs.py::test_a_lamp_between_two_media",
            "tests/images/test_media_known_answers.py::test_glowing_walls_that_bound_fog[cube]",
        ),
    ),
    Mutant(
        "media: lamps shine to the front alone",
        "media/light_media.py",
        "outwards = dr.dot(e.anchor.n, e.d) >= 0",
        "outwards = mi.Bool(True)",
        ("tests/images/test_media_plausible_bugs.py::test_a_lamp_between_two_media",),
    ),
    Mutant(
        "media: t = 0 counts what lies before a mask twice",
        "media/transmittance.py",
        "length = distance - dr.norm(walk.o - walk.previous)",
        "length = distance",
        ("tests/images/test_media_plausible_bugs.py::test_a_lens_behind_a_mask_in_fog",),
    ),
    Mutant(
        "media: t = 0 has T~ of what lies behind a mask",
        "media/transmittance.py",
        "edge.weight_transmittance(depth)",
        "edge.weight_transmittance(depth - edge.depth)",
        ("tests/images/test_media_plausible_bugs.py::test_a_meter_behind_a_mask_in_fog",),
    ),
    Mutant(
        "media: flights in grids begin at the shape",
        "media/tracking.py",
        "t, met = mi.Float(low), mi.Float(dr.inf)",
        "t, met = mi.Float(0), mi.Float(dr.inf)",
        ("tests/images/test_media_plausible_bugs.py::test_a_grid_smaller_than_its_shape",),
    ),
    Mutant(
        "media: T~ of flights in grids begins at the shape",
        "media/tracking.py",
        "travelled = dr.maximum(dr.minimum(met, high) - low, 0)",
        "travelled = dr.maximum(dr.minimum(met, high), 0)",
        ("tests/images/test_media_plausible_bugs.py::test_a_grid_smaller_than_its_shape",),
    ),
    Mutant(
        "boxes: rectangles merged with a cube have its size",
        "geometry/boxes.py",
        'shape.class_name() == "Mesh" or ',
        "",
        (
            "tests/emitters/test_emission_densities.py::test_the_size_of_a_scene_with_rectangles_merged_with_a_cube",
        ),
    ),
    Mutant(
        "media: rays of lamps leave through walls",
        "media/light_media.py",
        "opaque = hit & ~bounds & ~transmits",
        "opaque = mi.Bool(False)",
        ("tests/images/test_media_boundaries.py::test_fog_between_opaque_walls[each-plain-apart]",),
    ),
    Mutant(
        "media: objects are told apart",
        "media/equal.py",
        "return keys[i] == keys[j] and",
        "return False and",
        (
            "tests/images/test_media_boundaries.py::test_fog_between_opaque_walls[each-tagged-apart]",
            "tests/images/test_media_boundaries.py::test_media_are_told_apart_by_what_they_are[llvm_ad_rgb]",
        ),
    ),
    Mutant(
        "media: tables do not count",
        "media/equal.py",
        "yield name, np.array(value).tobytes()",
        "yield name",
        ("tests/images/test_media_boundaries.py::test_media_are_told_apart_by_what_they_are[llvm_ad_rgb]",),
    ),
    Mutant(
        "media: flipped meshes have the sides of others",
        "geometry/smooth_meshes.py",
        "return -cross if shape.has_flipped_normals() else cross",
        "return cross",
        ("tests/emitters/test_lamps.py::test_normals_have_the_sign_of_hits[mesh, rotated, flipped]",),
    ),
    Mutant(
        "media: mirrored rectangles have the sides of others",
        "emitters/surfaces.py",
        "dr.select(self._reversed.at(index, active), -n, n)",
        "n",
        (
            "tests/images/test_media_known_answers.py::test_glowing_walls_that_bound_fog[rectangles]",
            "tests/emitters/test_lamps.py::test_normals_have_the_sign_of_hits[rectangle, mirrored]",
        ),
    ),
    Mutant(
        "guided s = 0: s = 0 does not know of it",
        "transport/techniques.py",
        "(0, h.combine(sides[1], guided)), sds.counts",
        "sides, sds.counts",
        ("tests/images/test_guided_hits.py::test_large_lamps_look_as_without[diffuse-1]",),
    ),
    Mutant(
        "guided s = 0: several samples count as one",
        "transport/photons/guided_hits.py",
        "    return kernel.plan.guided * photon_guide",
        "    return photon_guide",
        ("tests/images/test_guided_hits.py::test_large_lamps_look_as_without[diffuse-4]",),
    ),
    Mutant(
        "guided s = 0: t = 0 does not know of it",
        "transport/walk.py",
        "guided = h.scale(vertex.partial.d_vc, vertex.advice.other)",
        "guided = h.scale(vertex.partial.d_vc, mi.Float(0))",
        ("tests/images/test_guided_hits.py::test_a_wide_lens",),
    ),
    Mutant(
        "guided s = 0: the density's normalisation",
        "transport/photons/photon_guide.py",
        "return total / (4 * dr.pi * len(WINDOW))",
        "return total / (2 * dr.pi * len(WINDOW))",
        ("tests/images/test_guided_hits.py::test_directions_follow_the_density[50]",),
    ),
    Mutant(
        "guided s = 0: photons of one place stay in the order of threads",
        "transport/photons/photon_guide.py",
        "(place << _LANE_BITS) | mi.UInt64(found.lane)",
        "place << _LANE_BITS",
        ("tests/images/test_guided_hits.py::test_the_guide_is_the_same_in_any_order",),
    ),
    Mutant(
        "guided s = 0: connectible paths in place of the others",
        "transport/photons/guided_hits.py",
        "return active & on_sds_path",
        "return active & ~on_sds_path",
        ("tests/images/test_guided_hits.py::test_large_lamps_look_as_without[diffuse-1]",),
    ),
    Mutant(
        "near-specular guiding: events are judged from one side",
        "transport/near_specular.py",
        "dr.minimum(f.pdf_fwd_w, f.pdf_rev_w) >=",
        "f.pdf_fwd_w >=",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: guided s = 1 is in no weight",
        "transport/techniques.py",
        "h.scale(h.combine(alone, own), guided)",
        "h.scale(own, guided)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: t = 1 goes on",
        "transport/techniques.py",
        "active &= ~connects_sds_path(y.edges + 1, (y.sds, f, 0))",
        "active &= mi.Bool(True)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: t = 0 goes on",
        "transport/techniques.py",
        "active &= ~walk.sds.is_sds_path(walk.edges, newest)",
        "active &= mi.Bool(True)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: inner connections go on",
        "transport/connections.py",
        "active &= ~connects_sds_path(k, (y.sds, f_y, newest_y), (z.sds, f_z, newest_z))",
        "active &= mi.Bool(True)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: connections take no notice of earlier edges",
        "transport/sds.py",
        "possible & state.scattered(event, coefficient).isolated",
        "possible",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: specular vertices behind a diffuse one guide too",
        "transport/photons/guided_hits.py",
        "active &= ~(specular & z.sds.diffuse)",
        "active &= mi.Bool(True)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n0c0-False]",
        ),
    ),
    Mutant(
        "near-specular guiding: light that rays cannot hit is left out",
        "transport/sds.py",
        "possible = mis.is_used(walk.partial.d_vc)",
        "possible = mi.Bool(True)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: one specular vertex guides",
        "transport/sds.py",
        "guided = dr.select(specular, self.guided_before_last(heuristic), 0)",
        "guided = dr.select(specular, self.guided, 0)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: guided subpaths know of no later vertex that guides",
        "transport/photons/guided_hits.py",
        "possible &= is_specular(step) & ~vertex.sds.diffuse",
        "possible = mi.Bool(False)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[balance-n1c1-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: estimates have the weight of others under the power heuristic",
        "transport/mis.py",
        'return ratio if self.name == "power" else mi.Float(1)',
        "return mi.Float(1)",
        (
            "tests/transport/test_oracle.py::test_kernel_guides_through_near_specular_events[power-quarter-True]",
        ),
    ),
    Mutant(
        "near-specular guiding: no pilot has the light where it is not guided",
        "planning/planner.py",
        "MATTERS = 0.1",
        "MATTERS = 1e9",
        ("tests/images/test_near_specular_guiding.py::test_light_that_is_not_guided_is_in_a_second_pilot",),
    ),
    Mutant(
        "near-specular guiding: guided light counts as undersampled",
        "merging/undersampled.py",
        "if kernel.plan.guided else walk",
        "if False else walk",
        ("tests/images/test_near_specular_guiding.py::test_guided_light_is_not_undersampled",),
    ),
    Mutant(
        "guiding: delta events leave d_vm as it is",
        "transport/mis.py",
        "_folded(h, step, partial.d_vm, total)",
        "_folded(h, step, partial.d_vm / step.cos_out, total)",
        ("tests/transport/test_oracle.py::test_sums_of_guiding_pass_delta_events",),
    ),
    Mutant(
        "guiding: a path is isolated again after an edge that is connectible",
        "transport/sds.py",
        "isolated = self.isolated & (step.delta",
        "isolated = (step.delta",
        ("tests/images/test_guided_hits.py::test_glass_caustics[guided]",),
    ),
    Mutant(
        "merging: walks compare merges with the coefficient of t = 1, merges with its count",
        "transport/walk.py",
        "rival = newest_coefficient(kernel, vertex, side.adjoint, beside_merges=True)",
        "rival = coefficient",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[power-quarter-True-1.0]",),
    ),
    Mutant(
        "merging: the count of t = 1 is its coefficient in the weight of a merge",
        "merging/merging.py",
        "connections = h.combine(y.connection, newest_connection(kernel, z, adjoint=False))",
        "connections = h.combine(y.connection, _rival(kernel, z))",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[power-quarter-True-1.0]",),
    ),
    Mutant(
        "merging: flux for irradiance",
        "merging/merging.py",
        "(total / (eta * dr.abs(dr.dot(z.si.n, photon.d))))",
        "(total / eta)",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[balance-n0c0-True-1.0]",),
    ),
    Mutant(
        "merging: only merges know which they are",
        "transport/mis.py",
        "dr.select(exceeds(merges, others), merges, 0)",
        "merges",
        ("tests/transport/test_oracle.py::test_recursion_with_merges[n1c1-balance-1.0]",),
    ),
    Mutant(
        "merging: connections take merges at other vertices alone",
        "transport/mis.py",
        "there = h.scale(ratio, pdf_a)",
        "there = h.scale(0.0 * ratio, pdf_a)",
        ("tests/transport/test_oracle.py::test_recursion_with_merges[n1c1-balance-1.0]",),
    ),
    Mutant(
        "merging: the newest merge counts beside any connection",
        "transport/mis.py",
        "dr.select(exceeds(newest, connection), newest, 0)",
        "newest",
        ("tests/transport/test_oracle.py::test_recursion_with_merges[n1c1-balance-1.0]",),
    ),
    Mutant(
        "merging: delta events forget the newest merge",
        "transport/mis.py",
        "h.combine(partial.d_vm, partial.d_vm_newest)",
        "partial.d_vm",
        ("tests/transport/test_oracle.py::test_recursion_with_merges[n1c1-balance-0.0]",),
    ),
    Mutant(
        "merging: merges without their coefficient in the sums of subpaths",
        "transport/walk.py",
        "ratio = side.sds.ratio(vertex.si.p)",
        "ratio = side.sds.ratio(vertex.si.p) / side.sds.kappa",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[balance-odd-True-1.0]",),
    ),
    Mutant(
        "merging: t = 1 does not know of merges",
        "transport/techniques.py",
        "light_side, merges = side_of(kernel, y, True, *densities, kernel.kappa.splat_count)",
        "light_side, merges = side_of(kernel, y, True, *densities, kernel.kappa.splat_count)[0], 0",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[balance-odd-True-1.0]",),
    ),
    Mutant(
        "merging: s = 1 does not know of merges",
        "transport/techniques.py",
        "camera_side, merges = side_of(kernel, z, False, *densities, kernel.kappa.direct)",
        "camera_side, merges = side_of(kernel, z, False, *densities, kernel.kappa.direct)[0], 0",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[balance-n0c0-True-1.0]",),
    ),
    Mutant(
        "merging: only t = 0 knows of merges on the light's side",
        "transport/kernel.py",
        "sds = kernel.sds if plan.arrival or near_specular else PhotonStrategy()",
        "sds = kernel.sds if plan.arrival else PhotonStrategy()",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[power-n1c1-False-0.0]",),
    ),
    Mutant(
        "merging: stored vertices lose the newest merge",
        "transport/light_path.py",
        "**vars(vertex.partial),",
        "**vars(replace(vertex.partial, d_vm_newest=mi.Float(0))),",
        ("tests/images/test_near_specular_merging.py::test_stored_vertices_keep_their_merges",),
    ),
    Mutant(
        "merging: photons start with the density of their aim",
        "transport/photons/aim.py",
        "pdf_second=mixed * ratio)",
        "pdf_second=mixed)",
        ("tests/images/test_near_specular_merging.py::test_images_are_those_without_merging[bumpy]",),
    ),
    Mutant(
        "merging: longer than stored for s = 0 alone",
        "transport/techniques.py",
        "mis.choose(z.edges <= kernel.last_merged, merges, 0)",
        "mis.choose(z.edges <= kernel.max_depth, merges, 0)",
        (
            (
                "tests/images/test_near_specular_merging.py::test_any_choice_of_strategies_has_the_same_mean"
                "[{'skip': 'none', 'stored_vertices': 3}]"
            ),
        ),
    ),
    Mutant(
        "merging: photon subpaths without much use end",
        "merging/merging.py",
        "return survived / state.survived, State(survived=survived)",
        "return dr.select(survived < 1, 1e-9, 1.0), state",
        ("tests/images/test_near_specular_merging.py::test_bounds_lose_no_light[near_pane-0.2-True]",),
    ),
    Mutant(
        "merging: photons are not divided by the probability of being kept",
        "transport/photons/photon_pass.py",
        "flux=y.throughput / probability",
        "flux=y.throughput",
        ("tests/images/test_near_specular_merging.py::test_bounds_lose_no_light[near_pane-0.2-False]",),
    ),
    Mutant(
        "merging: queries are not divided by the probability of asking",
        "merging/merging.py",
        "value = drawn.value / self.kept(kernel, z)",
        "value = drawn.value",
        ("tests/images/test_near_specular_merging.py::test_bounds_lose_no_light[through_a_lens-0.05-True]",),
    ),
    Mutant(
        "merging: photons of other cells in the same bucket count",
        "merging/merging.py",
        "(dr.gather(mi.UInt64, photons.cell, place, tried) == cell)",
        "True",
        ("tests/images/test_merging.py::test_cells_may_share_a_bucket",),
    ),
    Mutant(
        "merging: the radius begins anew in each part of an average",
        "run/rendering.py",
        "earlier = self.part * self.spp + sum(self.passes)",
        "earlier = sum(self.passes)",
        ("tests/images/test_merging.py::test_the_radius_goes_on_from_part_to_part[]",),
    ),
    Mutant(
        "merging: photons of other wavelengths count",
        "merging/merging.py",
        "index += wavelength_set << (_CELL_BITS - SET_BITS)",
        "index += 0",
        ("tests/images/test_merging.py::test_spectral",),
    ),
    Mutant(
        "merging: normals are not compared",
        "merging/merging.py",
        "(beyond_rounding < _FLAT * r) & (dr.dot(photon.n, z.si.n) > _SAME_SURFACE)",
        "(beyond_rounding < _FLAT * r)",
        ("tests/images/test_merging.py::test_which_photons_are_near",),
    ),
    Mutant(
        "merging: rounding errors of hits are heights",
        "merging/merging.py",
        "dr.maximum(height - 2 * z.anchor.offset, 0)",
        "height",
        ("tests/images/test_merging.py::test_which_photons_are_near",),
    ),
    Mutant(
        "merging: discs are smaller than the rounding error of positions",
        "merging/radius.py",
        "return dr.maximum(of_pixels, offset_at(dr.max(dr.abs(p))))",
        "return of_pixels",
        ("tests/images/test_merging.py::test_far_from_the_origin",),
    ),
    Mutant(
        "merging: discs of another pass",
        "merging/merging.py",
        "    eta = merging.eta(z.si.p)",
        "    eta = merging.eta(z.si.p) / 2",
        ("tests/images/test_merging.py::test_floor_under_glass[sun]",),
    ),
    Mutant(
        "merging: the camera's density for the light's",
        "merging/merging.py",
        "light = mis.Partial(0, y.older, y.d_vm, y.d_vm_newest), y.connection, f.pdf_fwd_w",
        "light = mis.Partial(0, y.older, y.d_vm, y.d_vm_newest), y.connection, f.pdf_rev_w",
        ("tests/transport/test_oracle.py::test_kernel_with_merges[balance-n0c0-True-1.0]",),
    ),
    Mutant(
        "merging: merges count as independent",
        "merging/merging.py",
        "return min(1.0, 1 / (samples * math.pi * radius**2))",
        "return 1.0",
        ("tests/images/test_merging.py::test_merges_do_not_outweigh_what_is_better",),
    ),
    Mutant(
        "merging: what merging finds is called lost",
        "planning/unsampled_light.py",
        "    if plan.merging or ",
        "    if ",
        (
            "tests/images/test_merging.py::test_no_light_is_called_lost_that_merging_finds[perspective]",
            "tests/images/test_merging.py::test_no_light_is_called_lost_that_merging_finds[thinlens]",
        ),
    ),
    Mutant(
        "guiding: t = 0 does not know of it",
        "transport/techniques.py",
        "dr.select(mis.is_connectible(partial, newest), 0, merges))",
        "0)",
        ("tests/images/test_guided_hits.py::test_a_wide_lens",),
    ),
    Mutant(
        "merging: photons stay in the order of threads",
        "merging/passes.py",
        "order = dr.argsort(key |",
        "order = dr.argsort(mi.UInt64(bucket) |",
        ("tests/images/test_merging.py::test_photons_are_the_same_in_any_order",),
    ),
    Mutant(
        "merging: paths an edge longer than max_depth",
        "merging/merging.py",
        "kernel.last_merged - z.edges, word",
        "kernel.last_merged - z.edges + 1, word",
        (
            "tests/images/test_sds_paths.py::test_no_path_is_longer_than_max_depth[plate-merging]",
            "tests/images/test_sds_paths.py::test_no_path_is_longer_than_max_depth[mirror-merging]",
        ),
    ),
    Mutant(
        "merging: photons of the coarsest grid of a disc alone",
        "merging/merging.py",
        "lowest = level_of(radius, r * (1 - 1.01 * radius.steepest))",
        "lowest = level_of(radius, r * (1 + 1.01 * radius.steepest))",
        ("tests/images/test_sds_paths.py::test_all_photons_of_a_disc_are_found",),
    ),
    Mutant(
        "merging: photons of the finest grid of a disc alone",
        "merging/merging.py",
        "corners = (level_of(radius, r * (1 + 1.01 * radius.steepest)) - lowest + 1) * 8",
        "corners = mi.UInt32(8)",
        ("tests/images/test_sds_paths.py::test_all_photons_of_a_disc_are_found",),
    ),
    Mutant(
        "guided s = 0: paths an edge longer than max_depth",
        "transport/photons/guided_hits.py",
        "        kernel.max_depth,\n",
        "        kernel.max_depth + 1,\n",
        (
            "tests/images/test_sds_paths.py::test_no_path_is_longer_than_max_depth[plate-guided]",
            "tests/images/test_sds_paths.py::test_no_path_is_longer_than_max_depth[mirror-guided]",
        ),
    ),
    Mutant(
        "guided s = 0: t = 0 counts it at all diffuse vertices of a light subpath",
        "transport/photons/guided_hits.py",
        "vertex, adjoint) & vertex.sds.only_delta",
        "vertex, adjoint)",
        ("tests/images/test_sds_paths.py::test_light_subpaths_with_two_diffuse_vertices",),
    ),
    Mutant(
        "guided s = 0: hidden surroundings are hidden from guided subpaths too",
        "transport/photons/guided_hits.py",
        "techniques.sees_emitter(kernel, vertex) & (vertex.edges > first),",
        "techniques.sees_emitter(kernel, vertex) & (vertex.hit | (not kernel.plan.hide_emitters)),",
        ("tests/images/test_sds_paths.py::test_a_sun_with_hide_emitters",),
    ),
    Mutant(
        "connections: none of the vertices beyond 40 is drawn",
        "transport/connections.py",
        'slot < candidates, label="draw an inner connection"',
        'slot < dr.minimum(candidates, 40), label="draw an inner connection"',
        ("tests/images/test_known_answers.py::test_many_stored_vertices[one]",),
    ),
    Mutant(
        "guided emission: the density is forgotten in emission",
        "emitters/area.py",
        "d, si.wi, pdf_w = self._sample_direction(chosen.index, si, u_direction, active)",
        "d, si.wi, pdf_w = self._sample_direction(chosen.index, si, u_direction, active)\n"
        "        pdf_w = dr.maximum(dr.dot(si.sh_frame.n, d), 0) * dr.inv_pi",
        ("tests/guided_emission/test_emission_tables.py::test_light_leaves_as_without_tables[rectangle]",),
    ),
    Mutant(
        "guided emission: s = 1 takes emission for not guided",
        "emitters/area.py",
        "direction = self._direction_pdf_w(chosen.index, cos_shading, -ds.d, active)",
        "direction = dr.maximum(cos_shading, 0) * dr.inv_pi",
        (
            "tests/images/test_guided_emission.py::test_weights_are_those_of_explicit_densities[rectangle-balance]",
        ),
    ),
    Mutant(
        "guided emission: s = 1 asks for the opposite direction",
        "emitters/infinite.py",
        "density = self.guide.density(index, self.place(index, p, d * sign, active), active)",
        "density = self.guide.density(index, self.place(index, p, d, active), active)",
        (
            "tests/guided_emission/test_emission_tables.py::test_next_event_estimation_and_hits_state_the_same[constant]",
        ),
    ),
    Mutant(
        "guided emission: a table is looked up mirrored",
        "emitters/area.py",
        "flat = mi.warp.cosine_hemisphere_to_square(known.frame().to_local(d))",
        "flat = mi.warp.cosine_hemisphere_to_square(known.frame().to_local(d) * mi.Vector3f(-1, 1, 1))",
        (
            "tests/images/test_guided_emission.py::test_weights_are_those_of_explicit_densities[rectangle-power]",
        ),
    ),
    Mutant(
        "guided emission: frames of disks depend on rounding",
        "emitters/disks.py",
        "turned = mi.Frame3f(mi.Vector3f(dr.dot(x, d), dr.dot(y, d), dr.dot(z, d)))\n    s, t",
        "return mi.Frame3f(d)\n    s, t",
        ("tests/guided_emission/test_emission_tables.py::test_frames_do_not_depend_on_who_asks[n3]",),
    ),
    Mutant(
        "guided emission: directions of curved lamps are not turned",
        "emitters/area.py",
        "turned = dr.mulsign(turned, dr.dot(si.sh_frame.n, turned))",
        "pass",
        ("tests/guided_emission/test_emission_tables.py::test_light_leaves_as_without_tables[sphere]",),
    ),
    Mutant(
        "guided emission: points on the details' disk have the density of another cell",
        "emitters/disks.py",
        "density = dr.select(aimed, density_at(p), density)",
        "pass",
        ("tests/guided_emission/test_emission_tables.py::test_details_beside_tables[middle-130-False]",),
    ),
    Mutant(
        "guided emission: what is learnt of curved lamps leaves out the cosine",
        "emitters/area.py",
        "curved = (1 - PLAIN) / (2 * dr.maximum(cos, _LEAST_COS))",
        "curved = (1 - PLAIN) / (2 * dr.maximum(cos * 0 + 1, _LEAST_COS))",
        ("tests/guided_emission/test_emission_tables.py::test_what_tables_change_of_a_density[sphere]",),
    ),
    Mutant(
        "guided emission: both halves of a pilot teach and judge",
        "guided_emission/learning.py",
        "halves = [_fitted(half, times) for half in statistics]",
        "halves = [_fitted(statistics[1 - i], times) for i in range(HALVES)]",
        ("tests/images/test_guided_emission.py::test_noise_teaches_nothing[24]",),
    ),
    Mutant(
        "guided emission: tables that are blurred more come first",
        "guided_emission/learning.py",
        "for times in BLURS[side]]",
        "for times in BLURS[side][::-1]]",
        ("tests/images/test_guided_emission.py::test_detail_is_kept_where_it_pays",),
    ),
    Mutant(
        "guided emission: tables that are blurred more are not tried",
        "guided_emission/learning.py",
        "for times in BLURS[side]]",
        "for times in BLURS[side][:1]]",
        ("tests/images/test_guided_emission.py::test_noise_is_blurred_where_it_would_not_pay",),
    ),
    Mutant(
        "guided emission: the last cell of a row is found in rows of a power of two alone",
        "guided_emission/tables.py",
        "cells -= step",
        "cells = step",
        (
            (
                "tests/guided_emission/test_emission_tables.py::"
                "test_warped_numbers_are_distributed_as_the_tables_say[24]"
            ),
        ),
    ),
    Mutant(
        "guided emission: what camera subpaths find is aimed at",
        "guided_emission/learning.py",
        "density = density * np.sqrt((squares * _SHARES / _totals(density) ** 2).sum(axis=-1))",
        "density = density * np.sqrt((squares / _totals(density) ** 2).sum(axis=-1))",
        ("tests/images/test_guided_emission.py::test_the_best_table_of_unequal_shares",),
    ),
    Mutant(
        "guided emission: splats teach as if each light subpath had a camera sample",
        "planning/pilot.py",
        "self._add_emission(c, size * np.sqrt(self.batch.size / lanes), c.position, c.active)",
        "self._add_emission(c, size, c.position, c.active)",
        ("tests/images/test_guided_emission.py::test_what_a_pilot_accumulates",),
    ),
    Mutant(
        "joined light subpaths: what is drawn evenly is forgotten",
        "transport/connections.py",
        "probability = dr.select(guessed, EVENLY / count + (1 - EVENLY) * size / total, 1 / count)",
        "probability = dr.select(guessed, (1 - EVENLY) * size / total, 1 / count)",
        ("tests/images/test_joined_light_paths.py::test_the_draw_is_unbiased_whatever_is_guessed[0.5-0.0]",),
    ),
    Mutant(
        "joined light subpaths: roulette has the number of the even draw",
        "transport/connections.py",
        "_Drawn(value, size_of(value), end, left, counted",
        "_Drawn(value, size_of(value), end, u_even, counted",
        ("tests/images/test_joined_light_paths.py::test_the_draw_is_unbiased_whatever_is_guessed[1.0-5.0]",),
    ),
    Mutant(
        "joined light subpaths: estimates are not over their number",
        "transport/connections.py",
        "value = value / kernel.plan.joined",
        "pass",
        ("tests/images/test_joined_light_paths.py::test_images_are_those_of_all_connections[diffuse]",),
    ),
    Mutant(
        "joined light subpaths: t <= 1 does not count them all",
        "transport/kernel.py",
        "1.0 if batch.spread else kernel.plan.joined * sharing.lanes / batch.size",
        "1.0 if batch.spread else sharing.lanes / batch.size",
        ("tests/images/test_joined_light_paths.py::test_images_are_those_of_all_connections[diffuse]",),
    ),
    Mutant(
        "joined light subpaths: all have the same random numbers",
        "transport/kernel.py",
        'kernel.points.stream("light", place * count + mi.UInt64(number))',
        'kernel.points.stream("light", place)',
        ("tests/images/test_joined_light_paths.py::test_a_cornell_box_is_joined_and_less_noisy",),
    ),
    Mutant(
        "joined light subpaths: guesses leave out the weight",
        "transport/proxy_vertices.py",
        "size = size_z * size_y * inverse / (kernel.kappa.inner + others * inverse)",
        "size = size_z * size_y * inverse",
        ("tests/images/test_joined_light_paths.py::test_guesses_are_about_right[diffuse-1.1]",),
    ),
    Mutant(
        "joined light subpaths: guesses leave out the lobe",
        "transport/proxy_vertices.py",
        "size + self.peak * shape,",
        "size,",
        ("tests/images/test_joined_light_paths.py::test_guesses_are_about_right[roughconductor-1.25]",),
    ),
    Mutant(
        "scene files: of the shapes of a group that have no id the last one is found alone",
        "host/introspection.py",
        "while name in self.found:",
        "while False:",
        ("tests/host/test_objects.py::test_shapes_of_a_group_need_no_ids",),
    ),
    Mutant(
        "scene files: points of all lamps are asked of the first one's shape",
        "emitters/tables.py",
        "return dr.switch(number, methods, *arguments)",
        "return methods[0](*arguments)",
        ("tests/emitters/test_lamps.py::test_textured_lamps_beside_shapes_without_points[None]",),
    ),
    Mutant(
        "scale: points of textured disks are found by Mitsuba's rays of one unit of length",
        "emitters/textured.py",
        "return shape.shape_type() != mi.ShapeType.Rectangle.value or shape.has_flipped_normals()",
        "return shape.shape_type() == mi.ShapeType.Sphere.value or shape.has_flipped_normals()",
        ("tests/emitters/test_scales.py::test_lamps_of_any_size[textured]",),
    ),
    Mutant(
        "scale: projectors are asked at one unit of length",
        "emitters/position.py",
        "far = (1 + np.abs(matrix[:3, 3]).max()) / np.linalg.norm(matrix[:3, 2])",
        "far = 1.0",
        ("tests/emitters/test_scales.py::test_lamps_of_any_size[at a point]",),
    ),
    Mutant(
        "objects: flipped spheres are hit on the wrong side",
        "geometry/hits.py",
        "dr.select(side < 0, -n, n)",
        "n",
        ("tests/geometry/test_hits.py::test_spheres_are_mitsubas[1]",),
    ),
    Mutant(
        "objects: shapes of one kind share no function",
        "geometry/hits.py",
        "si.shape = dr.select(active, shape, dr.zeros(mi.ShapePtr))",
        "si.shape = dr.select(active, dr.select(on_sphere, pi.shape, si.shape), dr.zeros(mi.ShapePtr))",
        ("tests/geometry/test_hits.py::test_kernels_do_not_grow[others]",),
    ),
    Mutant(
        "objects: facts about an edited shape are kept",
        "geometry/shape_facts.py",
        "if before._marks.get(index) == mark",
        "if index in before._marks",
        ("tests/geometry/test_shape_facts.py::test_edited_shapes_are_asked_again[ball.to_world]",),
    ),
    Mutant(
        "objects: an edited radiance is not checked again",
        "emitters/area.py",
        "State.of([emitter])",
        "None",
        (
            "tests/geometry/test_shape_facts.py::test_textured_lamps_are_checked_once[lamp0.emitter.radiance.to_uv]",
        ),
    ),
    Mutant(
        "scene files: inverses that are none are taken for right",
        "geometry/shape_facts.py",
        "partial(check_inverse, shape)",
        "lambda: None",
        ("tests/test_properties.py::test_endpoints_that_are_refused[instance turned about a long axis]",),
    ),
    Mutant(
        "scene files: rough conductors in a blend are seen from behind",
        "transport/draws.py",
        "return (mi.Frame3f.cos_theta(si.wi) <= 0) & dr.isnan(bs.wo.z)",
        "return False",
        ("tests/images/test_non_finite.py::test_a_blend_seen_from_behind_is_black[step by step]",),
    ),
    Mutant(
        "scene files: points of one plane see each other under a bump map",
        "transport/bsdf.py",
        "active = active & (dr.abs(mi.Frame3f.cos_theta(wo)) > _LEAST_COS)",
        "pass",
        ("tests/transport/test_bsdf.py::test_directions_within_the_surface",),
    ),
    Mutant(
        "blends: drawn by Mitsuba",
        "transport/draws.py",
        'return any(b.class_name() == "BlendBSDF" for b in nested([bsdf]))',
        "return False",
        (
            "tests/images/test_blends.py::test_a_mirror_in_a_blend[False]",
            "tests/transport/test_bsdf.py::test_delta_events_of_a_blend",
        ),
    ),
    Mutant(
        "blends: a part's directions on the wrong side are kept",
        "transport/draws.py",
        "(~is_zero(f) | (pdf == 0) | (bs.sampled_type == 0))",
        "False",
        (
            "tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf masked thin]",
            "tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf all normals]",
        ),
    ),
    Mutant(
        "blends: hair reflects to one side",
        "transport/draws.py",
        "((side > 0) & passes & ~reflects)",
        "((side > 0) & passes)",
        ("tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf hair]",),
    ),
    Mutant(
        "blends: a principled part draws from behind",
        "transport/draws.py",
        "return dr.select(mi.Frame3f.cos_theta(si.wi) > 0, pdf, 0)",
        "return pdf",
        ("tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf blind from behind]",),
    ),
    Mutant(
        "blends: a share that is not a number picks a part",
        "transport/draws.py",
        "bad = dr.isnan(share)",
        "bad = mi.Bool(False)",
        (
            "tests/transport/test_bsdf.py::test_what_is_not_a_number_in_a_blend_is_counted[mirrors]",
            "tests/transport/test_bsdf.py::test_what_is_not_a_number_in_a_blend_is_counted[opacity]",
        ),
    ),
    Mutant(
        "blends: black parts draw nothing",
        "transport/draws.py",
        "dr.select(smooth, rejected, found.rejected)",
        "found.rejected",
        (
            "tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf black]",
            "tests/transport/test_bsdf.py::test_steps_find_what_is_evaluated[blendbsdf black bumps]",
        ),
    ),
    Mutant(
        "errors: the renders that are judged divide their own errors",
        "measure/metrics.py",
        'weights = 1 / np.sqrt(image_of("reference", reference) ** 2 + rel_mse_epsilon(reference))',
        "weights = 1 / np.sqrt(centre**2 + rel_mse_epsilon(reference))",
        ("tests/measure/test_estimates.py::test_the_normaliser_is_not_of_the_renders_that_are_judged",),
    ),
    Mutant(
        "errors: light that was not met is in no error",
        "measure/analysis.py",
        "return bool(self.lacks(scene, method)) or mean_differs(rows, reference)",
        "return False",
        (
            "tests/measure/test_estimates.py::test_rare_light_that_was_not_met_is_a_lower_bound",
            "tests/measure/test_estimates.py::test_variance_and_bias_apart[5-0.01]",
        ),
    ),
    Mutant(
        "errors: the reference's own error counts",
        "measure/estimates.py",
        "found = measured - _column(rows, OWN[error])\n",
        "found = measured\n",
        ("tests/measure/test_estimates.py::test_the_variance_of_an_unbiased_integrator[0.05]",),
    ),
    Mutant(
        "errors: two renders, which no test can judge, leave out the bias",
        "measure/estimates.py",
        "return not differs and len(rows) >= FEWEST_TESTED and _has_variance(rows)",
        "return not differs and _has_variance(rows)",
        ("tests/measure/test_estimates.py::test_an_untested_error_has_the_bias[2]",),
    ),
    Mutant(
        "errors: the jackknife of the variance takes deviations from one mean for independent ones",
        "measure/estimates.py",
        "return ((n - 1) / n * spread.sum() - spread) / (n - 2)",
        "return (spread.sum() - spread) / (n - 1)",
        ("tests/measure/test_estimates.py::test_the_interval_of_the_variance_is_that_without_each_render",),
    ),
    Mutant(
        "sweeps: a time limit leaves no second render of the smallest budget",
        "measure/limited.py",
        "return is_least or (left > 0 and self._predicted(group) <= left)",
        "return left > 0 and self._predicted(group) <= left",
        ("tests/measure/test_sweep.py::test_what_time_does_not_allow_is_cut",),
    ),
    Mutant(
        "sweeps: renders that would end after the time limit begin",
        "measure/limited.py",
        "return is_least or (left > 0 and self._predicted(group) <= left)",
        "return is_least or left > 0",
        ("tests/measure/test_sweep.py::test_what_time_does_not_allow_is_cut",),
    ),
    Mutant(
        "sweeps: equal time is measured at the largest budget in spite of a time limit",
        "measure/sweep.py",
        "if self.seconds is None:",
        "if True:",
        ("tests/measure/test_sweep.py::test_equal_time_is_measured_at_a_budget_that_time_allows",),
    ),
    Mutant(
        "sweeps: scenes that are done take a share of the time limit",
        "measure/sweep.py",
        "sharing = sum(bool(other.late) for other in pending[i:])",
        "sharing = len(pending)",
        ("tests/measure/test_sweep.py::test_the_limit_is_shared_by_scenes_that_lack_renders",),
    ),
    Mutant(
        "sweeps: figures are of a budget that was cut after one render",
        "measure/analysis.py",
        "if all(of[n] > 1 for of in several)",
        "if all(of[n] > 0 for of in several)",
        ("tests/measure/test_analysis.py::test_a_sweep_that_was_cut_has_figures",),
    ),
    Mutant(
        "sweeps: time left counts renders, not their work",
        "measure/showing.py",
        "self._spent * (self._whole - self._work) / self._work",
        "self._spent * (self._total - self._done) / self._done",
        ("tests/measure/test_sweep.py::test_time_left_follows_from_work",),
    ),
    Mutant(
        "sweeps: processor seconds decide nothing",
        "measure/results.py",
        'return row["cpu_seconds"] if row.get("clock") == "processor" else row["seconds"]',
        'return row["seconds"]',
        ("tests/measure/test_sweep.py::test_first_images_are_rows_too",),
    ),
)


def planted(folder: Path, mutant: Mutant | None) -> Path:
    """Copy the package into ``folder``, with the bug if there is one; return what PYTHONPATH begins with.

    Raises ``CommandError`` if the text to replace is not there once.
    """
    package = folder / PACKAGE.name
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    if mutant is not None:
        file = package / mutant.file
        text = file.read_text()
        if (count := text.count(mutant.old)) != 1:
            raise CommandError(
                f"mutant {mutant.name}: {mutant.old!r} stands {count} times in {mutant.file}, not once; "
                "plant it anew"
            )
        file.write_text(text.replace(mutant.old, mutant.new))
    return folder


def outcome(folder: Path, test: str) -> tuple[int, str]:
    """Exit status and words of pytest on ``test`` with the package in ``folder``."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "scripts")])}
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-p", "no:cacheprovider", "-m", "", test]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def judged(status: int, output: str, bug: bool) -> str:
    """What is wrong with this outcome of a test, empty if nothing is; ``bug``: there is one to be seen."""
    if status not in (PASSED, FAILED):
        return "not run:\n" + output[-1500:]
    if not bug:
        return "" if status == PASSED else "fails without the bug:\n" + output[-1500:]
    if status == PASSED:
        return "does not see the bug"
    return "" if ASSERTION.search(output) else "fails by something else:\n" + output[-1500:]


def chosen(words: list[str]) -> list[Mutant]:
    """Mutants with one of these words in their name, all of them if there is no word."""
    for word in words:
        if not any(word in mutant.name for mutant in MUTANTS):
            raise CommandError(
                f"no mutant has {word!r} in its name; there are {'; '.join(m.name for m in MUTANTS)}"
            )
    return [mutant for mutant in MUTANTS if not words or any(word in mutant.name for word in words)]


def run(mutants: list[Mutant], bug: bool) -> int:
    """Print a line for each test; the number of those that did not do what they should."""
    wrong = 0
    for mutant in mutants:
        for test in mutant.tests:
            with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
                where = planted(Path(folder), mutant if bug else None)
                fault = judged(*outcome(where, test), bug)
            wrong += bool(fault)
            seen = "sees it" if bug else "passes without it"
            print(f"{mutant.name}: {test} {fault or seen}", flush=True)
    return wrong


def main(arguments=None) -> int:
    """Run the tests of the mutants, or print these."""
    parser = command_line.parser(__doc__)
    parser.add_argument("words", nargs="*", help="only mutants with one of these words in their name")
    parser.add_argument("--list", action="store_true", help="print names and what is replaced, run nothing")
    parser.add_argument("--unchanged", action="store_true", help="run the same tests without the bugs")
    options = parser.parse_args(arguments)
    mutants = chosen(options.words)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.name}: {mutant.file}: {mutant.old!r} -> {mutant.new!r}")
        return 0
    wrong = run(mutants, not options.unchanged)
    tests = sum(len(mutant.tests) for mutant in mutants)
    print(f"{len(mutants)} mutants, {tests} tests: {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(answered(main))
