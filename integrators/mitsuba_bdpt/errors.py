"""Errors that a user can fix, and suggestions for mistyped names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence


class UsageError(ValueError):
    """A value given by the user is invalid; the message names it and a remedy."""

    prefix = "bdpt: "

    def __str__(self) -> str:
        return self.prefix + super().__str__()


class UsageTypeError(UsageError, TypeError):
    """A value given by the user has an invalid type."""


class UnsupportedError(NotImplementedError):
    """The method does not support a request; the message names an alternative."""

    def __str__(self) -> str:
        return UsageError.prefix + super().__str__()


class CommandError(UsageError):
    """An invalid argument of a command, or an invalid file that it names."""

    prefix = ""


class FailureError(RuntimeError):
    """A command or measurement failed for other reasons than its arguments."""


def did_you_mean(name: str, known: Iterable[str], parts: bool = False) -> str:
    """Ask for the most similar ``known`` name, or with ``parts`` the shortest that contains it; or empty."""
    import difflib  # takes 5 ms, and is rarely needed

    by_case = {other.lower(): other for other in known}
    around = [other for other in by_case if parts and name and name.lower() in other]
    near = sorted(around, key=len) or difflib.get_close_matches(name.lower(), by_case, 1)
    return f"did you mean {by_case[near[0]]}? " if near else ""


def listed(names: Sequence[str], most: int) -> str:
    """Join the first ``most`` names, and say how many there are beside them."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def behind(error: BaseException, *kinds: type[BaseException]) -> BaseException | None:
    """Return the exception of these ``kinds`` that ``error`` is or wraps (as a ``RuntimeError``), or None."""
    return next((found for found in chain(error) if isinstance(found, kinds)), None)


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield ``error`` and the exceptions that it wraps, see `behind`."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = (found.__cause__ or found.__context__) if isinstance(found, RuntimeError) else None


def message(error: BaseException) -> str:
    """Return the text of ``error`` or the mistake it wraps; of a traceback the last line."""
    error = behind(error, UsageError, UnsupportedError) or error
    before, traceback, rest = str(error).partition("Traceback (most recent call last):")
    return before + rest.strip().splitlines()[-1] if traceback else before
