"""``graspdb mcp``."""

from __future__ import annotations

from typing import Annotated

import typer

from graspdb.agents.server import build_server
from graspdb.cli.common import ERRORS, State
from graspdb.transport import Transport


def mcp(
    state: State,
    http: Annotated[
        bool,
        typer.Option("--http", help="Serve on this machine over HTTP instead of standard input and output."),
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65_535, help="The port of --http.")] = 8765,
    write: Annotated[
        bool,
        typer.Option("--write", help="Let agents store trials and start sweeps, too; by default they read."),
    ] = False,
) -> None:
    """Let an agent ask: a server of the Model Context Protocol, with the key of --api-key.

    An agent's program usually starts it by itself: its configuration names the command `graspdb mcp`. Over
    HTTP only this machine is served, for whoever reaches it asks with your key.
    """
    # Asked by a program that waits in front of a person, as the command line is.
    with Transport(state.url, api_key=state.api_key, retries=2, user_agent="graspdb-mcp") as transport:
        server = build_server(transport, write=write)
        if http:
            ERRORS.print(f"Serving http://127.0.0.1:{port}/mcp, asking {transport.url}.", soft_wrap=True)
            server.run("streamable-http", host="127.0.0.1", port=port)
        else:
            server.run("stdio")
