"""The options that open the link: off, private, and refused in words where they cannot be."""

import socket

import click
import pytest
from click.testing import CliRunner
from test_openigtlink import SOON_S, joined, said, server  # noqa: F401 fixtures

from rehearsal.commands.command_line import command
from rehearsal.tracking.openigtlink_options import LinkOptions, open_link


@command(LinkOptions)
def linking(asked: LinkOptions) -> None:
    server = open_link(asked)
    if server is not None:
        joined(server).close()
        click.echo(f"on {' '.join(server.addresses)}")


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return listening.getsockname()[1]


def test_the_link_is_off_unless_asked_for_private_unless_told_and_ends_with_its_command():
    assert CliRunner().invoke(linking, []).output == ""
    port = free_port()
    done = CliRunner().invoke(linking, ["--link", "--link-port", str(port)])
    assert done.exit_code == 0 and f"127.0.0.1, port {port}" in done.output and "Warning" not in done.output
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), SOON_S)
    done = CliRunner().invoke(linking, ["--link", "--link-host", "0.0.0.0", "--link-port", str(port)])
    assert done.exit_code == 0 and done.output.count("over the network can read the image.") == 1
    # A client that leads moves the probe.
    leads = ["--link", "--link-leads", "--link-host", "0.0.0.0", "--link-port", str(port)]
    assert "can read the image and move the probe." in CliRunner().invoke(linking, leads).output


@pytest.mark.parametrize("hosts, is_private", [(["127.0.0.1"], True), (["127.0.0.1", "0.0.0.0"], False)])
def test_a_link_is_private_if_all_its_addresses_are(server, monkeypatch, hosts, is_private):
    """A name may have several, of which the first is this machine alone."""
    monkeypatch.setattr(server, "addresses", hosts)
    assert server.is_private == is_private


def test_a_link_that_cannot_be_is_refused_in_words(server):
    for option, value in (("--link-host", "127.0.0.1"), ("--link-port", "18944")):
        done = CliRunner().invoke(linking, [option, value])
        assert done.exit_code == 1 and f"{option}: " in done.output and "add --link" in done.output
    done = CliRunner().invoke(linking, ["--link-leads"])
    assert done.exit_code == 1 and "--link-leads: " in done.output and "add --link" in done.output
    taken = CliRunner().invoke(linking, ["--link", "--link-port", str(server.port)])
    assert taken.exit_code == 1 and f"port {server.port} cannot be opened" in taken.output
    for host in ("no such machine", "203.0.113.7", "ä" * 70):
        done = CliRunner().invoke(linking, ["--link", "--link-host", host])
        assert done.exit_code == 1 and "choose another --link-host" in done.output, done.output
    assert CliRunner().invoke(linking, ["--link", "--link-port", "0"]).exit_code == 2
