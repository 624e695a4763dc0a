"""The texts of `public_scenes` in a folder of results, and what one run keeps of those of another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mitsuba_bdpt.errors import CommandError
from mitsuba_bdpt.files.texts import read_json, write_json, write_text
from mitsuba_bdpt.files.whole import check_own
from mitsuba_bdpt.measure import page, results
from mitsuba_bdpt.measure.analysis import Results
from mitsuba_bdpt.measure.project import Project
from mitsuba_bdpt.measure.reference import reference_path
from mitsuba_bdpt.measure.scenes import digest
from public_table import MARK, Findings

SAID = "said.json"
"""The file of what is said of scenes beside their rows."""


def check_folder(folder: Path) -> None:
    """Raise ``CommandError`` for a folder of results with files that are not of this command."""
    remedy = "move it away, or name another folder by -o"
    for name, mark in (("table.md", MARK), ("summary.md", MARK), ("page.html", f"<title>{page.TITLE}")):
        check_own(folder / name, mark, remedy)
    if not (folder / "table.md").is_file():
        for name in ("rows.csv", "rows.json", "rows.parquet"):
            if (folder / name).exists():
                raise CommandError(f"{str(folder / name)!r} exists and is of another sweep; {remedy}")


@dataclass(frozen=True)
class Texts:
    """The folder of a run's results, ``order``: names of scenes of which they are, what is said beside rows.

    By name why scenes are ``left_out``, and ``notes`` on others; ``whole``: rows of another run do not stay.
    """

    folder: Path
    order: list[str]
    whole: bool
    left_out: dict[str, str]
    notes: dict[str, list[str]]

    @staticmethod
    def of(folder: Path, order: list[str], whole: bool) -> Texts:
        """With what another run said, unless this one is of the ``whole`` folder."""
        file = folder / SAID
        kept = read_json(file, "delete it") if file.is_file() and not whole else {}
        left_out, notes = (
            {name: what for name, what in kept.get(key, {}).items() if name in order}
            for key in ("left_out", "notes")
        )
        return Texts(folder, order, whole, left_out, notes)

    def _current(self, table: list[dict]) -> list[dict]:
        """Rows whose errors were taken against the references that there are; other scenes are left out."""
        own = ("scene", "resolution", "max_depth", "reference_sha256")
        for scene, *where, sha256 in dict.fromkeys(tuple(row[key] for key in own) for row in table):
            file = reference_path(Project(self.folder), scene, *where)
            if not file.is_file() or digest(file) != sha256:
                self.left_out[scene] = "its reference is another one now; run again, with this scene"
        return [row for row in table if row["scene"] not in self.left_out]

    def write(self, table: list[dict], is_over: bool) -> Findings:
        """Write the rows ``table`` of this run, and the texts about them and what else there is.

        Rows of other runs stay, until one of the whole folder ``is_over``.
        """
        if not (self.whole and is_over):
            table = self._current(results.beside(table, self.order, self.folder))
        write_json(self.folder / SAID, {"left_out": self.left_out, "notes": self.notes})
        if table:
            results.write_tables(table, self.folder)
            loaded = results.load(Project(self.folder), self.folder)
        else:
            for name in ("rows.csv", "rows.json", "rows.parquet", "page.html"):
                (self.folder / name).unlink(missing_ok=True)
            loaded = Results([], {}, {}), {}
        findings = Findings(*loaded, self.left_out, self.notes)
        write_text(self.folder / "table.md", findings.tables())
        write_text(self.folder / "summary.md", findings.summary())
        return findings
