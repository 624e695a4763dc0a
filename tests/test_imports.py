"""Imports inside the package go one way: the rooms of pyproject.toml."""

from pathlib import Path

from importlinter import cli

ROOT = Path(__file__).resolve().parents[1]


def test_imports_go_one_way(capsys):
    """Expected: every room is in the contract, which is exhaustive, and imports from later rooms."""
    done = cli.lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert done == cli.EXIT_STATUS_SUCCESS, capsys.readouterr().out
