"""What Mitsuba imports to find the plugin ``bdpt``: the entry point ``bdpt`` of the group ``mitsuba``.

Mitsuba does so for everybody who has the package, whichever variant they use. Where the package cannot be
used (no LLVM library, for example) that must not cost them Mitsuba: who loads the plugin is told why.
"""

from importlib import import_module
from typing import NoReturn

__all__ = ["register"]


def register() -> None:
    """Register ``bdpt``, or in its place what says why it cannot be used."""
    try:
        import mitsuba_bdpt  # noqa: F401
    except ImportError as error:
        _register_refusal(error)


def _register_refusal(error: ImportError) -> None:
    import mitsuba as mi

    def refuse(props: object) -> NoReturn:
        raise ImportError(f"bdpt: {error} (`python -m mitsuba_bdpt doctor` says more)") from error

    def register_variant(old: object = None, new: object = None) -> None:
        if mi.variant() is not None:
            mi.register_integrator("bdpt", refuse)

    # Mitsuba's parser queries the type of every plugin in this variant.
    import_module("mitsuba.scalar_rgb").register_integrator("bdpt", refuse)
    mi.detail.add_variant_callback(register_variant)
    register_variant()


register()
