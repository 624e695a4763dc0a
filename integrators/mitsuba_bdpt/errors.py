"""Errors that the user can mend, and what a mistyped name may have meant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator


class UsageError(ValueError):
    """A value that the user gave cannot be used. The message names it and says what to do instead."""

    prefix = "bdpt: "

    def __str__(self) -> str:
        return self.prefix + super().__str__()


class UsageTypeError(UsageError, TypeError):
    """A value that the user gave is of a type that cannot be used."""


class UnsupportedError(NotImplementedError):
    """The method does not support what was asked for; the message says what to use instead."""

    def __str__(self) -> str:
        return UsageError.prefix + super().__str__()


class CommandError(UsageError):
    """A mistake in the arguments of a command, or in a file that they name."""

    prefix = ""


class FailureError(RuntimeError):
    """A command or a measurement failed for a reason that is not in its arguments, such as a full disk."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The question for the most similar of the ``known`` names, and a space; empty if none is similar."""
    import difflib  # which takes 5 ms, and only mistakes need it

    by_case = {other.lower(): other for other in known}
    near = difflib.get_close_matches(name.lower(), by_case, 1)
    return f"did you mean {by_case[near[0]]}? " if near else ""


def behind(error: BaseException, *kinds: type[BaseException]) -> BaseException | None:
    """The exception of these ``kinds`` that ``error`` is, or that was wrapped into it; None if none was.

    Mitsuba and Dr.Jit make a ``RuntimeError`` of all that is raised while they render or record.
    """
    return next((found for found in chain(error) if isinstance(found, kinds)), None)


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield ``error`` and the exceptions that were wrapped into it, see `behind`."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = (found.__cause__ or found.__context__) if isinstance(found, RuntimeError) else None


def message(error: BaseException) -> str:
    """The text of `error`, or of the user's mistake that is behind it.

    Of a Python traceback that Mitsuba has put into it, the last line only.
    """
    error = behind(error, UsageError, UnsupportedError) or error
    before, traceback, rest = str(error).partition("Traceback (most recent call last):")
    return before + rest.strip().splitlines()[-1] if traceback else before
