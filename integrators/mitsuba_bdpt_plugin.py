"""Entry point ``bdpt`` of the group ``mitsuba``: Mitsuba finds the plugin by it.

Mitsuba imports it in every variant. If the package cannot be used (no LLVM library, for example), the import
succeeds, and loading the plugin raises the error.
"""

from importlib import import_module
from typing import NoReturn

__all__ = ["register"]


def register() -> None:
    """Register ``bdpt``, or a plugin that raises the error of the failed import."""
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
