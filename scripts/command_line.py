"""The parser of a script's command line."""

from argparse import ArgumentParser, RawDescriptionHelpFormatter


def parser(description: str | None) -> ArgumentParser:
    """A parser whose help begins with a script's docstring. Options are taken as whole words only."""
    return ArgumentParser(
        allow_abbrev=False, description=description, formatter_class=RawDescriptionHelpFormatter
    )
