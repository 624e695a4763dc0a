"""Scripts in processes of their own."""

import os
import subprocess
import sys


def run(script, *arguments, **environment):
    """Output of a process of its own."""
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout
