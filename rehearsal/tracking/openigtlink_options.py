"""The OpenIGTLink options of ``rehearse``."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import click

from rehearsal.commands.command_line import CommandError, WholeRange

if TYPE_CHECKING:
    from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer

HOST, PORT = "127.0.0.1", 18944
OPTIONS = (
    click.option("--link", is_flag=True, help="Send the live image and the probe's pose over OpenIGTLink."),
    click.option("--link-host", help=f"With --link: the address on which this machine listens [{HOST}]."),
    click.option(
        "--link-leads",
        is_flag=True,
        help="With --link: the probe follows the transform HandToReference that a client sends.",
    ),
    click.option("--link-port", type=WholeRange(1, 65535), help=f"With --link: its port [{PORT}]."),
)


def link_options(command: Callable) -> Callable:
    """Give a command --link, --link-host, --link-leads and --link-port."""
    for option in reversed(OPTIONS):
        command = option(command)
    return command


def open_link(
    link: bool, host: str | None, port: int | None, leads: bool = False
) -> "OpenIGTLinkServer | None":
    """Open the server that the options describe; it closes when the command ends. Raises CommandError."""
    if not link:
        given = {"--link-host": host, "--link-port": port, "--link-leads": leads or None}
        for option, value in given.items():
            if value is not None:
                raise CommandError(f"{option}: the link is off; add --link, or leave {option} out")
        return None
    from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer

    host, port = host or HOST, port or PORT
    try:
        server = OpenIGTLinkServer(host, port, click.echo)
    except (OSError, UnicodeError) as error:  # UnicodeError: a text that cannot be a host name
        reason = getattr(error, "strerror", None) or "not a host name"
        raise CommandError(
            f"--link: {host} port {port} cannot be opened ({reason}); end the program that uses it, or choose another --link-host or "
            "--link-port"
        ) from None
    click.get_current_context().with_resource(server)
    click.echo(f"The link is open: OpenIGTLink on {host}, port {port}.")
    if not server.is_private:
        click.echo("Warning: everyone who can reach this machine over the network can read the image.")
    return server
