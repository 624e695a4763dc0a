"""Render a scene file: the same as ``python -m mitsuba_bdpt render``."""

import sys

try:
    from mitsuba_bdpt.cli.arguments import main
except ImportError as error:
    sys.exit(f"error: {error}\n(`make render` sets up a Python environment that has all it needs.)")

if __name__ == "__main__":
    sys.exit(main(["render", *sys.argv[1:]]))
