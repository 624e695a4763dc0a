"""The tutorial runs, and what it asserts holds."""

import subprocess
import sys
from pathlib import Path

TUTORIAL = Path(__file__).parents[2] / "docs" / "user" / "tutorial.py"


def test_tutorial_runs():
    """Expected: every cell runs at a small size and its assertions hold; it prints what it explains."""
    done = subprocess.run(
        [sys.executable, str(TUTORIAL), "--size", "16"], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for words in ("pilot: time to the same error", "estimated relMSE", "error of path over ours"):
        assert words in done.stdout
