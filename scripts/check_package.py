"""Whether the built packages are fit for an index.

python scripts/check_package.py dist

In the metadata of each wheel and sdist: every link and image of the description leads somewhere from any
page, the version is that of the changes and the citation, and the command is there.
"""

from __future__ import annotations

import re
import sys
import tarfile
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import command_line

ROOT = Path(__file__).resolve().parents[1]

ENTRY_POINT = "[console_scripts]\nmitsuba-bdpt = mitsuba_bdpt.cli.arguments:main"


def metadata(path: Path) -> Message:
    """The metadata of a wheel or an sdist."""
    if path.suffix == ".whl":
        with zipfile.ZipFile(path) as wheel:
            name = next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))
            return message_from_bytes(wheel.read(name))
    with tarfile.open(path) as sdist:
        name = next(n for n in sdist.getnames() if n.count("/") == 1 and n.endswith("/PKG-INFO"))
        return message_from_bytes(sdist.extractfile(name).read())


def entry_points(path: Path) -> str:
    """The entry points of a wheel, as text."""
    with zipfile.ZipFile(path) as wheel:
        name = next(n for n in wheel.namelist() if n.endswith(".dist-info/entry_points.txt"))
        return wheel.read(name).decode()


def mistakes(path: Path) -> list[str]:
    """What is wrong with a package, in words."""
    about = metadata(path)
    text = about.get_payload(decode=True).decode()
    links = re.findall(r"\]\(([^)\s]+)", text)
    found = [f"the link {link} is relative" for link in links if not re.match(r"https?://|#", link)]
    if len(text) < 1000:
        found.append("there is no description")
    version = about["Version"]
    unnamed = [n for n in ("CITATION.cff", "CHANGELOG.md") if version not in (ROOT / n).read_text()]
    found += [f"{name} does not name version {version}" for name in unnamed]
    if len(about.get_all("Project-URL") or []) < 3:
        found.append("there are no URLs")
    if path.suffix == ".whl" and ENTRY_POINT not in entry_points(path):
        found.append(f"the entry point {ENTRY_POINT!r} is missing")
    return found


def main(arguments=None) -> int:
    """Print what is wrong, and return the exit status."""
    parser = command_line.parser(__doc__)
    parser.add_argument("folder", type=Path)
    paths = sorted(parser.parse_args(arguments).folder.glob("mitsuba_bdpt-*"))
    found = [f"{path.name}: {text}" for path in paths for text in mistakes(path)]
    if len(paths) != 2:
        found.append(f"there are {len(paths)} packages, not a wheel and an sdist")
    for text in found:
        print(f"error: {text}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
