"""Writes the page of all commands from the dataclasses of their arguments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from options_reference import STAGES, default_text, field_docstrings, summary

from poet_loc.cli.main import COMMANDS

HEAD = """# Commands

Made from the dataclasses of their arguments when the documentation is built; `poet-loc COMMAND --help` says the same.
Exit status: 0; 1 after a user's mistake, told in one line (and for `check` where something was found).
"""

_PAGES = {name: title for title, _, name in STAGES} | {"SolverOptions": "localize"}
"""Which section of the options' page has a class of options."""


def write_commands_page(path: Path) -> None:
    """Write the page; the folder is made."""
    parts = [HEAD, *_sections("poet-loc", COMMANDS, "poet_loc.cli")]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(parts), encoding="utf-8")


def _sections(program: str, commands: Mapping[str, str], package: str) -> Iterator[str]:
    for name, what in commands.items():
        module = import_module(f"{package}.{name.replace('-', '_')}")
        if hasattr(module, "COMMANDS"):
            yield f"## {program} {name}\n\n{what.capitalize()}: one of the following.\n"
            yield from _sections(f"{program} {name}", module.COMMANDS, f"{package}.{name}_commands")
        else:
            level = "##" if program == "poet-loc" else "###"
            yield f"{level} {program} {name}\n\n{summary(module.Arguments)}\n\n{_table(module.Arguments)}\n"


def _table(kind: type) -> str:
    lines = ["| argument | default | what |", "|---|---|---|"]
    lines += [f"| {name} | {default} | {what} |" for name, default, what in _rows(kind, "")]
    return "\n".join(lines)


def _rows(kind: type, prefix: str) -> Iterator[tuple[str, str, str]]:
    explained, types = field_docstrings(kind), get_type_hints(kind, include_extras=True)
    for each in fields(kind):
        own, notes = _bare(types[each.name])
        if is_dataclass(own):
            flat = any(getattr(note, "name", None) == "" for note in notes)
            below = prefix if flat else f"{prefix}{each.name.replace('_', '-')}."
            if own.__name__ in _PAGES:
                page = _PAGES[own.__name__]
                anchor = page.replace(":", "").replace(" ", "-")
                yield f"`--{below}*`" if below else "also", "", f"[options of {page}](options.md#{anchor})"
            else:
                yield from _rows(own, below)
            continue
        metavar = next((note.metavar for note in notes if getattr(note, "metavar", None)), None)
        name = metavar or f"--{prefix}{each.name.replace('_', '-')}"
        what = explained.get(each.name) or _said_of(own, types[each.name])
        yield f"`{name}`".replace("|", r"\|"), default_text(each), what.replace("|", r"\|")


def _bare(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    return (
        (get_args(annotation)[0], get_args(annotation)[1:]) if get_origin(annotation) is Annotated else (annotation, ())
    )


def _said_of(own: Any, annotation: Any) -> str:
    """What is said where a kind of argument is defined."""
    from poet_loc.cli import arguments

    return {arguments.LogFolder: "The folder of a log.", arguments.OutFolder: "The folder to write."}.get(
        annotation, ""
    )
