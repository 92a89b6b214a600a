"""A group of commands of which only the one that is called is imported: the others' libraries take seconds
to load.
"""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click


class LazyGroup(click.Group):
    """``commands_at``: a command's name -> where it is ("module:function"), and its help in one line, for
    the group's own help.
    """

    def __init__(self, *args: Any, commands_at: Mapping[str, tuple[str, str]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.commands_at = commands_at

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands_at)

    def get_command(self, ctx: click.Context, name: str) -> click.Command:
        if name not in self.commands_at:
            # click's own error suggests only commands that the group already holds, and this one holds none.
            raise click.NoSuchCommand(name, possibilities=self.commands_at, ctx=ctx)
        module, command = self.commands_at[name][0].split(":")
        return getattr(import_module(module), command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in self.commands_at.items()])
