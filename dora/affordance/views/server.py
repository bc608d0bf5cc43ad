"""Parts that every web page of viser has: the server on exactly one port, the light, the legend of colours."""

from __future__ import annotations

import html
import importlib
import socket
from collections.abc import Mapping
from typing import Any

from dora.errors import InputError, shown

LAST_PORT = 65_535
"""Largest number of a TCP port."""
AMBIENT = 1.5
"""Intensity of the ambient light; with viser's own lights alone dark links are black [1]."""


def start_server(host: str, port: int, label: str) -> Any:
    """Start viser's server on exactly this port, with z upwards, enough light, and no button that shares the page.

    Raises:
        InputError: viser is not installed, the port is in use or none, or there is no such address.
    """
    if not 1 <= port <= LAST_PORT:
        raise InputError(f"--port is {port} and has to be from 1 to {LAST_PORT}.")
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:  # viser would wait for ever
            trial.bind(place)
    except (OSError, UnicodeError) as error:
        raise InputError(f"--host is {shown(host)}, which is no address of this machine ({error}).") from error
    try:
        viser = importlib.import_module("viser")
    except ImportError as error:
        raise InputError("The page needs viser, which is not installed: pip install 'viser>=1.1'.") from error
    server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise InputError(f"Port {port} is in use: choose another one with --port.")
    server.gui.configure_theme(show_share_button=False)  # it would send the page through a server of others
    server.scene.set_up_direction("+z")
    server.scene.add_light_ambient("/ambient", intensity=AMBIENT)
    return server


def address(server: Any) -> str:
    """Address of the page of a running server."""
    host = server.get_host()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def legend_html(title: str, table: Mapping[str, tuple[int, int, int]]) -> str:
    """HTML of a line of names, which may hold any characters, on their colours (red, green, blue, 0 to 255)."""
    boxes = " ".join(
        f'<span style="background: rgb{rgb}; border-radius: 3px; padding: 0 0.5em">{html.escape(name)}</span>'
        for name, rgb in table.items()
    )
    return f'<div style="padding: 0.3em 1em; line-height: 1.8">{html.escape(title)}: {boxes}</div>'
