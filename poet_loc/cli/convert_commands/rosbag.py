"""poet-loc convert rosbag."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from poet_loc.cli.arguments import Flat
from poet_loc.io.bag_messages import list_topics
from poet_loc.io.convert_rosbag import ConvertRosbagOptions, convert_rosbag


@dataclass(frozen=True)
class Arguments:
    """A ROS 1 bag, a ROS 2 bag or an MCAP file becomes a log, by header stamps; without OUT its topics are listed."""

    bag: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BAG")]
    """.bag, .db3, .mcap, or the folder of a ROS 2 bag."""
    out: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT]")] = None
    """The log folder to write."""
    options: Flat[ConvertRosbagOptions] = field(default_factory=ConvertRosbagOptions)


def execute(arguments: Arguments) -> None:
    """List the topics, or convert and say what became what."""
    if arguments.out is None:
        for there in list_topics(arguments.bag, arguments.options.typestore):
            print(f"{there.name}  {there.message_type}  {there.messages}")
        return
    with _bar() as progress:
        made = convert_rosbag(arguments.bag, arguments.out, arguments.options, progress)
    for role, topic in made.chosen.items():
        dropped = made.dropped.get(topic, 0)
        print(
            f"{role}: {topic}" + (f" ({dropped} messages left out: no rotation, or a stamp twice)" if dropped else "")
        )
    for unused in made.unused:
        print(f"not used: {unused.name} ({unused.message_type})")
    print(arguments.out)


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None] | None]:
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("messages")
        yield lambda done, total: bar.update(task, completed=done, total=total)
