"""Tables of scenes by ways to render them, as parameters of one test."""

from functools import partial

import pytest


class Table:
    """Rows are functions, called when they are rendered; each has a case for each of its ways."""

    def __init__(self):
        self.cases = []

    def __call__(self, *ways, of=((),)):
        """Add a function's row for each of the arguments ``of``."""

        def add(make):
            for arguments in of:
                arguments = arguments if isinstance(arguments, tuple) else (arguments,)
                name = " ".join([make.__name__, *map(str, arguments)]).replace("_", " ")
                made = partial(make, *arguments)
                self.cases += [pytest.param(made, way, id=f"{name}-{way}") for way in ways]
            return make

        return add

    def test(self, function):
        """Parametrize a test of ``make`` and ``way``."""
        return pytest.mark.parametrize("make, way", self.cases)(function)
