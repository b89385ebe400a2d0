"""Options that nothing reads: where other choices leave one without effect, it is told, not ignored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from fnmatch import fnmatch
from typing import Generic, TypeVar

from poet_loc.core.input_error import InputError

Reader = TypeVar("Reader")
"""One thing that is to be made with the options, and what of it decides which of them it reads."""


@dataclass(frozen=True)
class Rule(Generic[Reader]):
    """Options by their dotted names, with * for any, and who reads them."""

    names: str
    by: str
    read: Callable[[Reader], bool]

    def covers(self, name: str) -> bool:
        """Tell whether the rule is about an option."""
        return any(fnmatch(name, each) for each in self.names.split())


def refuse_unread(
    options: object, default: object, readers: Sequence[Reader], rules: Sequence[Rule[Reader]], nothing: str = ""
) -> None:
    """Raise InputError for an option that is not at its default although none of the readers reads it.

    A reader reads what all rules about an option let it read, all where there is no rule. nothing: what to say where
    there is no reader.
    """
    for name in changed(options, default):
        about = [rule for rule in rules if rule.covers(name)]
        unmet = [[rule for rule in about if not rule.read(reader)] for reader in readers]
        if not all(unmet):
            continue
        typed = name.replace("_", "-")
        if not readers:
            raise InputError(f"{typed} changes nothing: {nothing}", fix="leave it out")
        by = min(unmet, key=len)[0].by
        raise InputError(f"{typed} changes nothing here", fix=f"it goes with {by}: choose that, or leave it out")


def changed(options: object, default: object) -> Iterator[str]:
    """Yield the dotted names of what is not at its default in a record of options and in the records inside it."""
    for each in fields(options):  # type: ignore[arg-type]
        value, usual = getattr(options, each.name), getattr(default, each.name)
        if is_dataclass(value):
            yield from (f"{each.name}.{name}" for name in changed(value, usual))
        elif value != usual:
            yield each.name
