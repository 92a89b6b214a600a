"""The OpenIGTLink options of ``rehearse``."""

from typing import TYPE_CHECKING

import click
from pydantic import Field

from rehearsal.commands.command_line import CommandError, CommandOptions

if TYPE_CHECKING:
    from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer

HOST, PORT = "127.0.0.1", 18944


class LinkOptions(CommandOptions):
    """The options of the link."""

    link: bool = False
    """Send the live image and the probe's pose over OpenIGTLink."""
    link_host: str | None = None
    """With --link: the address on which this machine listens [127.0.0.1]."""
    link_leads: bool = False
    """With --link: the probe follows the transform HandToReference that a client sends."""
    link_port: int | None = Field(None, ge=1, le=65535)
    """With --link: its port [18944]."""


def open_link(options: LinkOptions) -> "OpenIGTLinkServer | None":
    """Open the server that the options describe; it closes when the command ends. Raises CommandError."""
    if not options.link:
        for option in options.set_by_user("link_host", "link_port", "link_leads"):
            raise CommandError(f"{option}: the link is off; add --link, or leave {option} out")
        return None
    from rehearsal.tracking.openigtlink_server import OpenIGTLinkServer

    host, port = options.link_host or HOST, options.link_port or PORT
    try:
        server = OpenIGTLinkServer(host, port, click.echo)
    except (OSError, UnicodeError) as error:  # UnicodeError: a text that cannot be a host name
        reason = getattr(error, "strerror", None) or "not a host name"
        raise CommandError(
            f"--link: {host} port {port} cannot be opened ({reason}); end the program that uses it, or "
            "choose another --link-host or "
            "--link-port"
        ) from None
    click.get_current_context().with_resource(server)
    click.echo(f"The link is open: OpenIGTLink on {host}, port {port}.")
    if not server.is_private:
        steer = " and move the probe" if options.link_leads else ""
        click.echo(
            f"Warning: everyone who can reach this machine over the network can read the image{steer}."
        )
    return server
