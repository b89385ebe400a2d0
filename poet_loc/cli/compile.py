"""poet-loc compile: the estimators' kernels, once."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Arguments:
    """Compile the estimators once, so that the first run does not wait; what is compiled already is left as it is."""


def execute(arguments: Arguments) -> None:
    """Compile, and say in one line what was done."""
    from fusion.warm_up import compile_estimators

    compiled, seconds = compile_estimators()
    what = f"{compiled} kernels compiled" if compiled else "everything was compiled before"
    print(f"filter, smoother and graph: {what}, {seconds:.0f} s")
