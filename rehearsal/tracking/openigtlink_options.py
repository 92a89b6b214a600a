"""The options of ``rehearse`` that open the link, and the link that they open."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from rehearsal.commands.command_line import CommandError, WholeRange

if TYPE_CHECKING:
    from rehearsal.tracking.openigtlink_server import Server

HOST, PORT = "127.0.0.1", 18944
OPTIONS = (
    click.option("--link", is_flag=True, help="Send the live picture and the probe's pose over OpenIGTLink."),
    click.option("--link-host", help=f"With --link: the address of this machine to be reached at [{HOST}]."),
    click.option(
        "--link-leads",
        is_flag=True,
        help="With --link: the probe goes where a client says that it is, by the transform HandToReference.",
    ),
    click.option("--link-port", type=WholeRange(1, 65535), help=f"With --link: its port [{PORT}]."),
)


def link_options(command: Callable) -> Callable:
    """Give a command --link, --link-host, --link-leads and --link-port."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


def opened_link(link: bool, host: str | None, port: int | None, leads: bool = False) -> "Server | None":
    """The server that the options ask for, which closes when the command ends. Raises CommandError."""
    if not link:
        for option, value in {
            "--link-host": host,
            "--link-port": port,
            "--link-leads": leads or None,
        }.items():
            if value is not None:
                raise CommandError(f"{option}: is about the link, which is off; add --link, or leave it out")
        return None
    from rehearsal.tracking.openigtlink_server import Server

    host, port = host or HOST, port or PORT
    try:
        server = Server(host, port, click.echo)
    except (OSError, TypeError) as error:  # TypeError: a text that no name of a machine can be
        reason = getattr(error, "strerror", None) or "no name of a machine"
        raise CommandError(
            f"--link: {host} port {port} cannot be opened ({reason}); end the program that has it, or choose another --link-host or "
            "--link-port"
        ) from None
    click.get_current_context().with_resource(server)
    click.echo(f"The link is open: OpenIGTLink on {host}, port {port}.")
    if not server.is_private:
        click.echo("Mind: whoever reaches this machine over the network can read the picture.")
    return server
