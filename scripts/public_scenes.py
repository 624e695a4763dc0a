"""Scenes of other people at equal time: `path`, path tracing alone, everything switched on, and the default.

    python scripts/public_scenes.py ~/scenes -o results/public
    python scripts/public_scenes.py ~/scenes --scenes veach-bidir --reference veach-bidir=TungstenRender.exr

Scenes are FOLDER/NAME.xml, and FOLDER/NAME/ with scene_v3.xml, scene.xml, NAME.xml or one XML file alone (the
first of these that is there). Rendered are their first sensor, its whole film and no crop window, at the
`max_depth` of the file's integrator, of which nothing else is taken. The reference of a scene is NAME.exr
beside its file, or reference.exr in a folder of its own, in any case of letters, unless the file names that
as a texture; no other image is taken but by --reference. Where there is none `bdpt` makes one, with every
strategy; a further run goes on with it.

OUTPUT gets table.md and summary.md after each scene and page.html at the end, beside all that a sweep
leaves; finished renders are kept, and --scenes keeps what the texts say of the others. What cannot be
rendered is named with the reason and left out. The exit status is 1 if a scene was left out, if a check finds
that this package renders one wrongly, or if a given image and the checks do not agree about that.
"""

from __future__ import annotations

import argparse
import sys
from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import command_line
import mitsuba_bdpt  # noqa: F401 (before mitsuba: it chooses the LLVM library)
import numpy as np
from mitsuba_bdpt.cli.mistakes import answered
from mitsuba_bdpt.cli.values import definition, number
from mitsuba_bdpt.errors import CommandError, did_you_mean, message
from mitsuba_bdpt.files.images import read_layers
from mitsuba_bdpt.files.loading import named_files, parsed, searching
from mitsuba_bdpt.measure import agreement, analysis, given, making, page, showing
from mitsuba_bdpt.measure.making import Job
from mitsuba_bdpt.measure.preset import Method, Preset, Subject
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.reference import Reference
from mitsuba_bdpt.measure.scenes import SceneFile
from mitsuba_bdpt.measure.sweep import Sweep
from mitsuba_bdpt.run.rendering import raise_interrupt
from public_checks import DEFAULT
from public_table import Findings
from public_texts import Texts, check_folder
from repository import ROOT

import mitsuba as mi  # isort: skip

DEPTH = 16
"""The ``max_depth`` of scenes whose file has no integrator, or one that has none."""

FILES = ("scene_v3.xml", "scene.xml")
"""Names of scene files in folders of their own, beside that of the folder."""


def _ways() -> tuple[Method, ...]:
    """What renders: the default, whose seconds the others have, and Mitsuba's path tracers."""
    ours = {
        DEFAULT: {},
        analysis.NONE: {"skip": "none"},
        analysis.ALONE: {"light_paths": 0},
    }
    ways = [(name, {"type": "bdpt"} | more, None) for name, more in ours.items()]
    ways += [("path", {"type": "path"}, False), ("volpath", {"type": "volpath"}, True)]
    return tuple(
        Method(
            name=name,
            parameters=tuple(sorted(parameters.items())),
            sampler="independent",
            match="spp" if name == DEFAULT else "seconds",
            scenes=None,
            media=media,
            seeds=None,
        )
        for name, parameters, media in ways
    )


@dataclass(frozen=True)
class Found:
    """A scene of the folder.

    Its file; the image that is taken for its reference, if there is one; whether --reference ``told`` it;
    names of EXRs beside it that are not taken.
    """

    scene: SceneFile
    reference: Path | None
    told: bool
    others: tuple[str, ...] = ()


def found_in(folder: Path) -> tuple[dict[str, Path], dict[str, str]]:
    """The scene files in a folder by name, and what is left out there, with the reason."""
    if not folder.is_dir():
        raise CommandError(f"folder={str(folder)!r} is no folder; give one that holds scene files")
    files, left_out = {}, {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.suffix.lower() == ".xml":
            files[path.stem] = path
    for path in sorted(folder.iterdir()):
        there = _with_suffix(path, ".xml") if path.is_dir() else []
        if not there:
            continue
        names = *FILES, f"{path.name}.xml"
        known = [path / name for name in names if path / name in there]
        if path.name in files:
            left_out[f"{path.name}/"] = f"{files[path.name].name} beside it has the same name; rename one"
        elif known or len(there) == 1:
            files[path.name] = (known or there)[0]
        else:
            listed = ", ".join(file.name for file in there)
            left_out[path.name] = f"several scene files: {listed}; call the one to render scene.xml"
    return files, left_out


def _with_suffix(folder: Path, suffix: str) -> list[Path]:
    """The files of a folder with that suffix, in any case of letters."""
    return sorted(path for path in folder.iterdir() if path.is_file() and path.suffix.lower() == suffix)


def references_beside(name: str, file: Path, folder: Path) -> tuple[Path | None, tuple[str, ...]]:
    """The image that is taken for the reference of a scene, None if there is none.

    Also the names of other EXRs in a folder of its own, which may be references under another name.
    """
    own = file.parent != folder
    wanted = [f"{name}.exr".lower(), *(["reference.exr"] if own else [])]
    there = [path for path in _with_suffix(file.parent, ".exr") if own or path.name.lower() in wanted]
    if not there:
        return None, ()
    with searching(file):
        textures = {path.resolve() for path in named_files(parsed(file, {}, strict=False)[1])}
    there = [path for path in there if path.resolve() not in textures]
    known = [path for path in there if path.name.lower() in wanted]
    taken = min(known, key=lambda path: wanted.index(path.name.lower()), default=None)
    return taken, tuple(path.name for path in there if path != taken)


def chosen(options: Namespace) -> tuple[dict[str, Path], dict[str, str]]:
    """`found_in` the folder, of these that the command line asks for."""
    files, left_out = found_in(options.folder)
    told = dict(options.reference)
    for option, names in (("--scenes", options.scenes or ()), ("--reference", told)):
        for name in names:
            if name not in files and name not in left_out:
                there = [*files, *left_out]
                raise CommandError(
                    f"{option} {name}: no scene of {str(options.folder)!r}, which has {', '.join(there)}; "
                    f"{did_you_mean(name, there)}".rstrip("; ")
                )
    for name, image in told.items():
        if name in files and not _told(files[name], image).is_file():
            raise CommandError(f"--reference {name}={image}: no such file, here or beside {files[name]}")
    if not files and not left_out:
        raise CommandError(
            f"folder={str(options.folder)!r} holds no scenes; they are NAME.xml or NAME/scene.xml in it"
        )
    if options.scenes:
        files, left_out = (
            {name: what for name, what in kept.items() if name in options.scenes}
            for kept in (files, left_out)
        )
    return files, left_out


def _told(file: Path, image: str) -> Path:
    """An image that --reference names, beside the scene's file or seen from here."""
    beside = file.parent / image
    return beside if beside.is_file() else Path(image)


def found(name: str, file: Path, options: Namespace) -> Found:
    """A scene with its reference as the command line ``options`` say."""
    told, scene = dict(options.reference), SceneFile(name, file)
    if name in told:
        return Found(scene, _told(file, told[name]), True)
    if options.own_references:
        return Found(scene, None, False)
    taken, others = references_beside(name, file, options.folder)
    return Found(scene, taken, False, () if taken else others)


def subject_of(scene: SceneFile, options: Namespace) -> tuple[Subject, int]:
    """A scene as it is rendered, and the width of its image."""
    width, height = scene.size()
    wanted = options.resolution * width / max(width, height)
    fitting = making.nearest_width(scene, wanted)
    if fitting is None:
        raise CommandError(
            f"no size near {options.resolution} divides its film of {width} x {height} into 4 x 4 tiles; "
            "take a larger --resolution"
        )
    depth = options.max_depth or (scene.max_depth if scene.tells_depth else DEPTH)
    return Subject(scene, depth, (options.spp,), (options.seeds,)), fitting


def referenced(job: Job, one: Found) -> tuple[Reference, list[str]]:
    """The reference of a scene: the image that is given, or one that is made, or gone on with, now.

    Also what there is to note about it. An image beside the scene that cannot serve is noted.
    """
    notes = []
    if one.others:
        (first, *more), name = one.others, job.scene.name
        others = f" (nor are {len(more)} others)" if more else ""
        notes.append(
            f"`{first}` beside it is not taken for its reference{others}; --reference {name}={first} takes it"
        )
    if one.reference is not None:
        try:
            return given.adopt(job, one.reference), notes
        except CommandError as error:
            if one.told:
                raise
            notes.append(f"`{one.reference.name}` beside it cannot be its reference, one was made: {error}")
    given.forget(job)
    print(f"{job.scene.name}: its reference, for at most about {job.seconds:g} s", flush=True)
    return making.make(job)[0], notes


def rows_of(one: Found, options: Namespace, project: Project) -> tuple[list[dict], list[str]]:
    """The rows of all renders of a scene, and notes on it; raises an error if one of them cannot be had."""
    subject, width = subject_of(one.scene, options)
    enough = agreement.FEWEST_RUNS // 2
    seconds = options.reference_seconds
    job = Job(project, one.scene, width, subject.max_depth, options.spp, seconds, by="bdpt", rounds=enough)
    reference, notes = referenced(job, one)
    preset = Preset((subject,), _ways(), width, None, {})
    sweep = Sweep(project, preset, project.root)
    print(f"{one.scene.name}: {width} wide, max_depth {subject.max_depth}", flush=True)
    with showing.bar() as progress:
        sweep.run(progress)
    found = sweep.rows()
    if sweep.failed:
        others = f" (and {len(sweep.failed) - 1} more like it)" if len(sweep.failed) > 1 else ""
        raise CommandError(f"{sweep.failed[0]}{others}")
    if reference.given:
        found = given.with_own_errors(found, given.own_errors(reference.image, _by_seed(project.root, found)))
    return found, notes


def _by_seed(output: Path, table: list[dict]) -> list[np.ndarray]:
    """The mean of our renders of each seed, which share random numbers, without path tracing alone."""
    found: dict[int, list[np.ndarray]] = {}
    for row in table:
        if row["method"] in (DEFAULT, analysis.NONE):
            (image,), _ = read_layers(output / "images" / row["scene"] / f"{row['key']}.exr", "")
            found.setdefault(row["seed"], []).append(image)
    return [np.mean(images, axis=0) for images in found.values()]


def measured(options: Namespace, folder: Path) -> tuple[Findings, bool]:
    """Render the scenes and write the texts after each; what they say, and whether all is well.

    It is where none of this run's scenes is left out, or rendered wrongly as far as checks tell.
    """
    everything = found_in(options.folder)
    files, lost = chosen(options)
    texts = Texts.of(folder, [*everything[0], *everything[1]], not options.scenes)
    for name in files:
        texts.left_out.pop(name, None)
    texts.left_out.update(lost)
    table = []
    for name, file in files.items():
        try:
            rows, texts.notes[name] = rows_of(found(name, file, options), options, Project(folder))
            table += rows
            texts.left_out.pop(name, None)
        except Exception as error:  # one scene must not cost the others
            raise_interrupt(error)
            lost[name] = texts.left_out[name] = " ".join(message(error).split())
            print(f"{name}: left out: {lost[name]}", flush=True)
        texts.write(table, is_over=False)
    findings = texts.write(table, is_over=True)
    return findings, not lost and files.keys().isdisjoint(findings.wrong())


def parser() -> argparse.ArgumentParser:
    """That of the command line."""
    made = command_line.parser(__doc__)
    add = made.add_argument
    add("folder", type=Path, metavar="FOLDER", help="folder with scenes")
    add("-o", "--output", type=Path, help="folder; default: results/public_FOLDER of the repository")
    add("--scenes", nargs="+", metavar="NAME", help="these alone")
    add("--spp", type=number(int, 1), default=64, help="of the default; default: %(default)s")
    text = "renders of each; bias is checked from 8 on; default: %(default)s"
    add("--seeds", type=number(int, 2), default=16, help=text)
    text = "the longer side of the images, about; default: %(default)s"
    add("--resolution", type=number(int, 8), default=256, metavar="PIXELS", help=text)
    text = f"of all scenes; default: that of a scene's file, {DEPTH} where it tells none"
    add("--max-depth", type=number(int, 1), help=text)
    text = "that making a reference may take, per scene; default: %(default)g"
    add("--reference-seconds", type=number(float, 0), default=600.0, metavar="SECONDS", help=text)
    text = "take this EXR for the reference of a scene (may be repeated)"
    add("--reference", type=definition, action="append", default=[], metavar="NAME=FILE", help=text)
    add("--own-references", action="store_true", help="take no image beside a scene: make all references")
    return made


def main(arguments=None) -> int:
    """Render what is missing, and write table, summary and page."""
    options = parser().parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    folder = options.output or ROOT / "results" / f"public_{options.folder.resolve().name}"
    check_folder(folder)
    findings, is_well = measured(options, folder)
    if findings.results.scenes:
        page.run(Namespace(project=folder, folder=str(folder), output=None))
    print(folder / "table.md", folder / "summary.md", sep="\n", end=f"\n\n{findings.words()}")
    return int(not is_well)


if __name__ == "__main__":
    sys.exit(answered(main))
